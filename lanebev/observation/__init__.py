"""Probability maps from images, and line segments from probability maps."""
