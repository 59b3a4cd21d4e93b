"""State of pitch, yaw, roll and height in each frame: measured, uncertain, undetermined, lost or unknown."""

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from lanebev.estimation.mount import MountConfig
from lanebev.io.results import ExtrinsicsRow
from lanebev.types import AXES

_UNSEEN = {
    "pitch": "DIRECTION_UNSEEN", "yaw": "DIRECTION_UNSEEN", "roll": "ROLL_UNSEEN", "height": "HEIGHT_UNSEEN",
}  # fmt: skip
_RADIANS = MountConfig().largest_std
LARGEST_STD = (*np.degrees(_RADIANS[:3]).tolist(), _RADIANS[3])
"""deg, deg, deg, m: above this standard deviation a value counts as uncertain, as in the mount estimator."""

UNITS, DIGITS = ("°", "°", "°", " m"), (2, 2, 2, 3)
"""Of pitch, yaw, roll and height, as a page shows them."""


class AxisState(IntEnum):
    """The states of an axis in a frame, by how well the frame determines it, best first."""

    MEASURED = 0  # from this frame's lane boundaries
    UNCERTAIN = 1  # measured, but with a standard deviation above LARGEST_STD
    UNDETERMINED = 2  # not determined by this frame: predicted from earlier ones
    LOST = 3  # too long without support
    UNKNOWN = 4  # nothing known yet


def estimates(rows: Sequence[ExtrinsicsRow]) -> NDArray[np.float64]:
    """Return (F, 4) pitch, yaw, roll (deg) and height (m)."""
    return np.array([row.pose for row in rows], dtype=np.float64).reshape(-1, 4)


def estimate_stds(rows: Sequence[ExtrinsicsRow]) -> NDArray[np.float64]:
    """Return (F, 4) standard deviations of pitch, yaw, roll (deg) and height (m)."""
    return np.array([row.std for row in rows], dtype=np.float64).reshape(-1, 4)


def axis_states(row: ExtrinsicsRow) -> tuple[AxisState, AxisState, AxisState, AxisState]:
    """Return the state of pitch, yaw, roll and height in a frame, from its status, reasons and sigmas."""
    whole = {"LOST": AxisState.LOST, "COASTING": AxisState.UNDETERMINED, "TRACKING": AxisState.MEASURED}
    state = whole.get(row.status, AxisState.UNKNOWN)
    if state != AxisState.MEASURED:
        return state, state, state, state
    pitch, yaw, roll, height = (
        _tracked_state(_UNSEEN[axis] in row.reason_names, std, most)
        for axis, std, most in zip(AXES, row.std, LARGEST_STD, strict=True)
    )
    return pitch, yaw, roll, height


def all_axis_states(rows: Sequence[ExtrinsicsRow]) -> NDArray[np.int64]:
    """Return (F, 4) states of pitch, yaw, roll and height."""
    return np.array([axis_states(row) for row in rows], dtype=np.int64).reshape(-1, 4)


def with_unit(axis: str, value: float, sign: str = "") -> str:
    """Return a value of an axis (deg, m) in words, such as "0.12°" or "3.4 cm"; sign "+" shows it always."""
    return f"{100 * value:{sign}.1f} cm" if axis == "height" else f"{value:{sign}.2f}°"


def plus_minus(axis: int, value: float, std: float, sign: str = "", more_digits: int = 0) -> str:
    """Return a value of an axis (deg, m) and twice its standard deviation, such as "0.12 ± 0.03°"."""
    digits = DIGITS[axis] + more_digits
    return f"{value:{sign}.{digits}f} ± {2 * std:.{digits}f}{UNITS[axis]}"


def _tracked_state(unseen: bool, std: float, most: float) -> AxisState:
    if unseen:
        return AxisState.UNDETERMINED
    return AxisState.MEASURED if std <= most else AxisState.UNCERTAIN
