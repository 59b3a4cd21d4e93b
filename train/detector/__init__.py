"""A detector of vehicles on bird's-eye features, and its gain from the camera's pose."""
