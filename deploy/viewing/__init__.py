"""A page that shows a pipeline at work, live or from its recording."""
