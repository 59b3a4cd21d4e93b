"""Both calibrators as the argument of tests."""

import pytest

from lanebev import JointCalibrator, TwoStageCalibrator

CALIBRATORS = pytest.mark.parametrize(
    "calibrator", [JointCalibrator(), TwoStageCalibrator()], ids=["joint", "two-stage"]
)
QUICK_CALIBRATORS = pytest.mark.parametrize(
    "calibrator",
    [JointCalibrator(iterations=1, start_iterations=1), TwoStageCalibrator(num_hypotheses=20)],
    ids=["joint", "two-stage"],
)
