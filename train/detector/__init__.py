"""A detector of vehicles on bird's-eye features, and what the camera's pose is worth to it."""
