"""The default calibrator: one filter over pose, lane position, curvature and lane widths."""
