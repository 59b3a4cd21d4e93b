"""Live use: one object that keeps a drive's state from frame to frame."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.mount import MountCalibration, MountEstimator, describe_mount
from lanebev.estimation.reasons import Reason
from lanebev.geometry.focal import with_focal_std
from lanebev.io.state import load_state, save_state
from lanebev.observation.segments import LaneSegments
from lanebev.pipeline import LaneBEV
from lanebev.types import Calibration, Extrinsics, Status
from lanebev.view.frame import remap_frame
from lanebev.view.grid import BEVGrid

logger = logging.getLogger(__name__)

FIRST_DT = 1 / 30  # s before a first frame: it has no frame before
_LONG_DT = 5.0  # s; steps that are all longer are hardly seconds
_LOOKED_AT = 5  # steps that are looked at for that

REASONS = {
    Reason.NO_SEGMENTS: "no lane boundary was seen",
    Reason.FEW_INLIERS: "what was seen does not fit the road",
    Reason.TIME: "the time stamp does not advance, or is not known",
    Reason.NO_START: "not started: pitch and yaw are not determined yet",
    Reason.ROLL_UNSEEN: "roll is not determined: one lane or less in view",
    Reason.HEIGHT_UNSEEN: "height is not determined: no lane in view",
    Reason.LANE_CHANGE: "lane change",
    Reason.RESTARTED: "started anew",
    Reason.DIRECTION_UNSEEN: "pitch and yaw are not determined: one boundary or less in view",
}


class SessionResult(NamedTuple):
    """What a frame gave.

    Attributes:
        stamp: s, as given; None where none was.
        dt: s since the frame before that was used.
        extrinsics: pitch, yaw, roll (rad) and height (m), each (1,).
        std: their standard deviations, each (1,), in the same units.
        status: what the pose is worth.
        reasons: why the pose is not (fully) determined, or the input is doubtful, in words.
        mount: the slow estimate of how the camera is mounted.
        mount_needs: of the mount, a sentence for each axis.
        calibration: pose, covariance, status and inliers as the calibrator gives them.
        bev: (U, V, 3) bytes in the frame's order of colours, or None.
        valid: (U, V) bool, or None.
    """

    stamp: float | None
    dt: float
    extrinsics: Extrinsics
    std: Extrinsics
    status: Status
    reasons: list[str]
    mount: MountCalibration
    mount_needs: list[str]
    calibration: Calibration
    bev: NDArray[np.uint8] | None
    valid: NDArray[np.bool_] | None


class Session:
    """Calibrate a camera live, frame by frame.

    ``session(frame, stamp)`` computes the time step, runs network and calibrator, follows the mount and warps
    the frame. A frame that cannot be used gives a result that says why; it raises only for arguments that are
    wrong in every frame.

    Args:
        camera: the lens.
        model: network and calibrator; None is :meth:`LaneBEV.from_pretrained`, loaded with the first frame.
        calibrator: in place of the model's; None is a :class:`lanebev.JointCalibrator`.
        lane_width: m.
        grid: of the bird's-eye view; None for no view.
        colours: order of a frame's channels: "bgr" as OpenCV reads them, or "rgb".
        focal_std: standard deviation of the focal length as a share of it, which widens the pose's.
        device: of the network; the filter runs on the CPU.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        model: LaneBEV | None = None,
        calibrator: Calibrator[Any] | None = None,
        lane_width: float = 3.7,
        grid: BEVGrid | None = None,
        colours: Literal["bgr", "rgb"] = "bgr",
        focal_std: float = 0.0,
        device: torch.device | str = "cpu",
    ) -> None:
        if colours not in ("bgr", "rgb"):
            raise ValueError(f"colours: expected 'bgr' or 'rgb', got {colours!r}")
        if not (math.isfinite(lane_width) and 1.0 < lane_width < 10.0):
            raise ValueError(f"lane_width: expected 1 to 10 m, got {lane_width}")
        self.camera, self.lane_width, self.grid, self.colours = camera, float(lane_width), grid, colours
        self.focal_std, self.device = focal_std, torch.device(device)
        self._model = model
        self.calibrator: Calibrator[Any] = calibrator or JointCalibrator()
        self.mount = MountEstimator()
        self.reset()

    def reset(self) -> None:
        """Forget everything, as for another drive with another camera."""
        self._state: Any = self.calibrator.initial_state(1, dtype=torch.float64)
        self._mount_state = self.mount.initial_state(1, dtype=torch.float64)
        self._stamp: float | None = None
        self._steps: list[float] = []

    def __call__(
        self,
        frame: NDArray[np.uint8] | Tensor | None = None,
        stamp: float | None = None,
        *,
        polylines: Sequence[ArrayLike | Tensor] | Mapping[int, ArrayLike | Tensor] | None = None,
        speed: float | None = None,
    ) -> SessionResult:
        """Take in one frame.

        Args:
            frame: (H, W, 3) bytes in the order of ``colours``, an array or a tensor; None if only polylines
                are given, or for a frame that was lost.
            stamp: s, of any epoch; None assumes that the step is as the one before.
            polylines: lane boundaries that another detector drew, see :meth:`LaneSegments.from_polylines`;
                the network is not used then.
            speed: m/s of the vehicle, if it is known: below walking pace nothing is learnt of the mount.

        Raises:
            TypeError: a frame that is no array or tensor of bytes.
            ValueError: a frame of another size than the camera's, or a stamp that is not finite.
        """
        pixels = None if frame is None else self._checked(frame)
        dt, remarks = self._step(stamp)
        with torch.inference_mode():
            segments, scale = self._segments(pixels, polylines)
            used = dt > 0
            calibration, state = self.calibrator(
                segments, self.camera.intrinsics[None].double(), self._state, dt, self.lane_width
            )
            if used:
                self._state = state
            calibration = calibration.with_std_scaled(scale)
            if self.focal_std:
                intrinsics = self.camera.intrinsics[None].double()
                calibration = with_focal_std(calibration, intrinsics, self.focal_std)
            flags = Reason(int(self.calibrator.reasons(state)[0]))
            fast = None if speed is None else torch.tensor([speed], dtype=torch.float64)
            mounted, mount_state = self.mount(
                calibration, self._mount_state, dt, speed=fast, curvature=self.calibrator.curvature(state)
            )
            if used:
                self._mount_state = mount_state
        bev, valid = None, None
        if self.grid is not None and pixels is not None:
            bev, valid = remap_frame(pixels, self.camera, calibration.extrinsics, self.grid)
        std = calibration.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
        status = Status(int(calibration.status[0]))
        if not used and status == Status.TRACKING:
            status = Status.COASTING
        return SessionResult(
            stamp=stamp,
            dt=dt,
            extrinsics=calibration.extrinsics,
            std=Extrinsics.unstack(std),
            status=status,
            reasons=remarks + describe_reasons(flags, known=remarks),
            mount=mounted,
            mount_needs=describe_mount(mounted, self.mount.config),
            calibration=calibration,
            bev=bev,
            valid=valid,
        )

    def save(self, path: str | Path) -> None:
        """Write the state to a file, from which :meth:`load` goes on exactly.

        Raises:
            OSError: the file cannot be written.
        """
        clock = {"stamp": self._stamp, "steps": self._steps}
        states = {"calibrator": self._state, "mount": self._mount_state}
        save_state(path, {**states, "camera": self.camera.fingerprint(), "clock": clock})

    def load(self, path: str | Path) -> None:
        """Go on from a file that :meth:`save` wrote.

        Raises:
            ValueError: the file cannot be used, or is of another calibrator or camera; nothing is changed.
        """
        fresh = {
            "calibrator": self.calibrator.initial_state(1, dtype=torch.float64),
            "mount": self.mount.initial_state(1, dtype=torch.float64),
        }
        loaded = load_state(path, fresh)
        if loaded.problem is not None:
            raise ValueError(f"{path}: {loaded.problem}")
        if loaded.metadata.get("camera") != self.camera.fingerprint():
            raise ValueError(f"{path}: expected the state of this camera, got another camera's")
        clock = loaded.metadata.get("clock") or {}
        self._state, self._mount_state = loaded.states["calibrator"], loaded.states["mount"]
        self._stamp, self._steps = clock.get("stamp"), list(clock.get("steps", []))

    def _checked(self, frame: NDArray[np.uint8] | Tensor) -> NDArray[np.uint8]:
        array = frame.cpu().numpy() if isinstance(frame, Tensor) else frame
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
            got = getattr(array, "dtype", type(array).__name__)
            raise TypeError(f"frame: expected (H, W, 3) of uint8, got {got}")
        expected = (*self.camera.image_size, 3)
        if array.shape != expected:
            raise ValueError(
                f"frame: expected {expected} as the camera's, got {array.shape}; see Camera.scaled"
            )
        return array

    def _step(self, stamp: float | None) -> tuple[float, list[str]]:
        """Return the time since the last frame that was used, and what is doubtful about it."""
        if stamp is None:
            return (self._steps[-1] if self._steps else FIRST_DT), []
        if not math.isfinite(stamp):
            raise ValueError(f"stamp: expected finite seconds, got {stamp}")
        if self._stamp is None:
            self._stamp = float(stamp)
            return FIRST_DT, []
        dt = float(stamp) - self._stamp
        if dt <= 0:
            return dt, [f"the time stamp does not advance: {dt:g} s after the frame before"]
        self._stamp = float(stamp)
        self._steps = [*self._steps[-_LOOKED_AT + 1 :], dt]
        if len(self._steps) == _LOOKED_AT and min(self._steps) > _LONG_DT:
            remark = f"time stamps advance by {dt:g} a frame: expected seconds, got milli- or nanoseconds?"
            logger.warning(remark)
            return dt, [remark]
        return dt, []

    def _segments(
        self,
        frame: NDArray[np.uint8] | None,
        polylines: Sequence[ArrayLike | Tensor] | Mapping[int, ArrayLike | Tensor] | None,
    ) -> tuple[LaneSegments, float]:
        """Return the frame's segments and the scale of the pose's sigmas that their detector needs."""
        if polylines is not None or frame is None:
            lines = [] if polylines is None else polylines
            return LaneSegments.from_polylines(lines, self.camera), 1.0
        if self._model is None:
            self._model = LaneBEV.from_pretrained()
        model = self._model.eval().to(self.device)
        colours = frame if self.colours == "rgb" else frame[..., ::-1]
        image = torch.from_numpy(np.ascontiguousarray(colours)).to(self.device)
        image = image.permute(2, 0, 1)[None].float() / 255
        lens = self.camera.to(self.device, torch.float32)
        _, segments = model.observe(image, lens.intrinsics[None], lens.distortion[None], lens.model)
        on_host = (t.cpu().double() if t.is_floating_point() else t.cpu() for t in segments)
        return LaneSegments(*on_host), model.pose_sigma_scale


def describe_reasons(flags: Reason, known: Sequence[str] = ()) -> list[str]:
    """Describe why a frame is not fully tracked, a phrase for each flag.

    Args:
        flags: of the calibrator.
        known: phrases about the time that say it already.
    """
    return [text for flag, text in REASONS.items() if flags & flag and not (known and flag == Reason.TIME)]
