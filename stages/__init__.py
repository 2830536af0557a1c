"""The mathematics, one folder a stage, plus the geometry and the radiance field that the stages share."""
