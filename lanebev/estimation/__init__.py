"""Vanishing direction, lane width, the filter, the calibrators and the mount."""
