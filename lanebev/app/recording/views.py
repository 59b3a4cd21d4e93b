"""Bird's-eye views of a run, with a fixed pose and with the estimated one."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.types import Calibration, Extrinsics, Status
from lanebev.view.frame import remap_frame
from lanebev.view.grid import BEVGrid

_NOMINAL_HEIGHT = 1.5  # m, of the fixed pose of single images


class FixedPose:
    """The fixed pose of the view for comparison: level for stills, in a drive the first one that was tracked.

    Args:
        alone: single images, not frames of a drive.
    """

    def __init__(self, alone: bool) -> None:
        self.pose = Extrinsics.from_values(0.0, 0.0, 0.0, _NOMINAL_HEIGHT) if alone else None

    def __call__(self, calibration: Calibration) -> Extrinsics | None:
        """Return the pose, each (1,), at a frame of this calibration; None before anything is known."""
        if self.pose is None and int(calibration.status[0]) == Status.TRACKING:
            self.pose = calibration.extrinsics
        return self.pose


def bird_view(
    grid: BEVGrid,
    image: NDArray[np.uint8] | None,
    camera: Camera,
    extrinsics: Extrinsics | None,
    vertical_curvature: Tensor | None = None,
) -> NDArray[np.uint8]:
    """Resample a frame to (U, V, 3) uint8 RGB, black where the camera does not see, or nothing is known."""
    if image is None or extrinsics is None:
        return np.zeros((*grid.shape, 3), np.uint8)
    return remap_frame(image, camera, extrinsics, grid, vertical_curvature)[0]
