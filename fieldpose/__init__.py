"""Where a camera is relative to an object or scene known only from posed photographs."""
