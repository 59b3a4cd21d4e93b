"""The camera's mount in the vehicle: a slow estimate from the poses of frames, axis by axis.

The ``estimator`` averages the poses in ``blocks``. ``config`` has its settings,
``results`` its state, results and their description in words.
"""

from lanebev.estimation.mount.config import MountConfig
from lanebev.estimation.mount.estimator import MountEstimator
from lanebev.estimation.mount.results import (
    MountCalibration,
    MountReason,
    MountState,
    MountStatus,
    describe_mount,
)

__all__ = [
    "MountCalibration",
    "MountConfig",
    "MountEstimator",
    "MountReason",
    "MountState",
    "MountStatus",
    "describe_mount",
]
