"""The surface that a field has learnt: as a mesh, and as points."""
