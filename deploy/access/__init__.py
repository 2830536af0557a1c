"""Who is let onto the bus of a pipeline: roles, certificates, the keys of a run, joining."""
