"""The bird's-eye grid, its homography and the resampling."""
