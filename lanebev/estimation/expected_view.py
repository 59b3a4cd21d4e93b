"""The point where the lanes are expected to meet in the next image, by the state before it."""

from typing import Any

import torch
from torch import Tensor

from lanebev.geometry.vanishing_point import vanishing_point
from lanebev.types import Status

_LARGEST_STD = 0.005  # rad, standard deviation of an angle up to which it places a far view


def expected_vanishing_point(
    calibrator: Any, state: Any, intrinsics: Tensor, distortion: Tensor | None = None, model: str = "pinhole"
) -> Tensor:
    """Compute the vanishing point that the pose of a state gives, in the image as taken.

    The pose is that of the last frame. Between two frames it moves by less than the far view is tall.

    Args:
        calibrator: a :class:`~lanebev.estimation.calibrator.Calibrator`.
        state: its state before the frame.
        intrinsics: (B, 3, 3) px.
        distortion: (B, D) of the lens, or None.
        model: "pinhole", "fisheye" or "omni".

    Returns:
        (B, 2) px; NaN where it is not known: where a row is not TRACKING, or a standard deviation of pitch or
        yaw is 0.005 rad or more, as in a sharp turn. At a start it is known if the prior's standard deviation
        of the pitch is smaller, as that of a known mount is.
    """
    found = getattr(calibrator, "pitch_and_yaw", lambda _: None)(state)
    if found is None:
        return intrinsics.new_full((len(intrinsics), 2), torch.nan)
    (pitch, yaw), sure = found[0].unbind(-1), found[1] < _LARGEST_STD**2
    known = (state.status == int(Status.TRACKING)) & sure.all(-1)
    known = known | ((state.status == int(Status.UNINITIALISED)) & sure[:, 0])
    lens = (intrinsics.to(pitch), None if distortion is None else distortion.to(pitch), model)
    return torch.where(known.unsqueeze(-1), vanishing_point(pitch, yaw, *lens), torch.nan)
