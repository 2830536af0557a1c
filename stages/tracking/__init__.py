"""Which pose to render next, which frames to let in, and how far the result is to be trusted."""
