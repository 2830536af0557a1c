"""Following: the pose of every camera frame, at once, from points of views that were rendered before."""
