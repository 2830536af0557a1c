"""Structure from motion: what photographs tell of their own cameras by the points that they share."""
