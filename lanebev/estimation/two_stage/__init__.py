"""The paper's calibrator: vanishing direction, then lane width."""
