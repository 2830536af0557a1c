"""Finding points of views in camera frames by the patches around them, and the pose that they give."""
