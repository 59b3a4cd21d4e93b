"""Lenses and rays, angles and matrices, great circles, the road plane and points on it."""
