"""Live use: one object that holds a drive's state from frame to frame."""

import logging
import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lanebev.camera.model import Camera, check_camera
from lanebev.camera.plausibility import camera_remarks
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.lane_width_prior import check_lane_width_prior, lane_width_prior
from lanebev.estimation.mount import MountCalibration, describe_mount
from lanebev.estimation.reasons import Reason, describe_reasons
from lanebev.estimation.tracker import Tracker
from lanebev.io.frame_clock import FrameClock
from lanebev.io.frozen_images import STRIDE, ImageChanges
from lanebev.io.lanes.doubts import LaneDoubts
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.speeds import fast_remark
from lanebev.io.state import lane_width_remark, load_state, save_state
from lanebev.numbers import check_number
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.frames import check_frame, image_bytes, network_image
from lanebev.observation.polylines import LINE_SIGMA, lines_from_polylines, vertices_from_lines
from lanebev.pipeline import LaneBEV
from lanebev.tensors import map_tensors, usable_device
from lanebev.types import Calibration, Extrinsics, Status, check_type
from lanebev.view.frame import remap_frame
from lanebev.view.grid import BEVGrid

logger = logging.getLogger(__name__)


class SessionResult(NamedTuple):
    """Result of one frame.

    Attributes:
        stamp: time stamp, s, as given; None if none was.
        dt: s since the frame before.
        extrinsics: pitch, yaw, roll (rad) and height (m), each (1,).
        std: their standard deviations, each (1,), in the same units.
        status: status of the pose.
        reasons: in words, why the pose is not (fully) determined, and what in the input is doubtful.
        mount: the current mount estimate.
        mount_needs: what the mount estimate still needs, a sentence for each axis.
        calibration: pose, covariance, status and inliers as the calibrator gives them.
        bev: (U, V, 3) bytes in the frame's order of colours, or None.
        valid: (U, V) bool, or None.
        vertical_curvature: (1,) 1/m of the road, positive over a crest, which the view follows; None where
            the calibrator takes the road as plane.
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
    vertical_curvature: Tensor | None = None


class Session:
    """Calibrate a camera live, frame by frame.

    ``session(frame, stamp)`` computes the time step, runs network and calibrator, updates the mount estimate
    and computes the bird's-eye view. If a frame cannot be used, the result says why; an exception means that
    the arguments are wrong for every frame.

    Args:
        camera: the lens.
        model: network and calibrator; None is :meth:`LaneBEV.from_pretrained`, loaded with the first frame.
        calibrator: used instead of the model's. None is the model's or, if no model is given, a
            :class:`lanebev.JointCalibrator`.
        lane_width: m, exact unless ``lane_width_std`` is given; the height is proportional to it. None
            assumes 3.7 m with a standard deviation of 0.2 m, as ``lanebev run`` does.
        lane_width_std: standard deviation of the lane width, m; the standard deviations of the height and
            of the mount's height contain its effect. None is 0 if ``lane_width`` or the calibrator's own
            ``lane_width_std`` is given, else 0.2 m. Only one of the two ``lane_width_std`` may be above 0.
        grid: grid of the bird's-eye view; None for no view.
        colours: order of a frame's channels: "bgr" as OpenCV reads them, or "rgb".
        focal_std: standard deviation of the focal length as a fraction of it; the standard deviations of the
            pose contain its effect.
        polyline_sigma: standard deviation of given polylines across their lines, px.
        device: device of the network; the filter runs on the CPU.

    Implausible numbers of the camera, as ``lanebev doctor`` finds them, are logged as a warning.

    Raises:
        TypeError: an argument of another type.
        ValueError: an argument out of range, or a device that PyTorch cannot use here.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        model: LaneBEV | None = None,
        calibrator: Calibrator[Any] | None = None,
        lane_width: float | None = None,
        lane_width_std: float | None = None,
        grid: BEVGrid | None = None,
        colours: Literal["bgr", "rgb"] = "bgr",
        focal_std: float = 0.0,
        polyline_sigma: float = LINE_SIGMA,
        device: torch.device | str = "cpu",
    ) -> None:
        check_camera(camera)
        check_type("model", model, LaneBEV)
        check_type("calibrator", calibrator, Calibrator)
        check_type("grid", grid, BEVGrid)
        if colours not in ("bgr", "rgb"):
            raise ValueError(f"colours: expected 'bgr' or 'rgb', got {colours!r}")
        _check_numbers(lane_width, lane_width_std, focal_std, polyline_sigma)
        self.camera, self.grid, self.colours, self.device = camera, grid, colours, usable_device(device)
        self.polyline_sigma = polyline_sigma
        self._model = model
        if calibrator is None:
            calibrator = JointCalibrator() if model is None else _calibrator_of(model)
        width, width_std = _lane_width_of(calibrator, lane_width, lane_width_std)
        self._new_tracker = partial(Tracker, calibrator, camera, width, float(focal_std), width_std)
        for remark in camera_remarks(camera):
            logger.warning(remark)
        self.reset()

    def reset(self) -> None:
        """Forget the drive and the mount, as if the session were new."""
        self.tracker: Tracker[Any] = self._new_tracker()
        self._clock = FrameClock()
        self._lanes, self._images = LaneDoubts(self.camera), ImageChanges()

    def __call__(
        self,
        frame: NDArray[np.uint8] | Tensor | None = None,
        stamp: float | None = None,
        *,
        polylines: Sequence[ArrayLike | Tensor] | Mapping[int, ArrayLike | Tensor] | None = None,
        speed: float | None = None,
    ) -> SessionResult:
        """Process one frame.

        Args:
            frame: (H, W, 3) bytes in the order of ``colours``, or a tensor (3, H, W) of bytes or in [0, 1];
                None if only polylines are given, or for a frame that was lost.
            stamp: time, s, of any epoch; None assumes the time step of the frame before.
            polylines: lane boundaries of another detector, used instead of the network; see
                :meth:`LaneSegments.from_polylines`.
            speed: speed of the vehicle at this frame, m/s, if known. The pose on winding roads depends on it,
                see :meth:`JointCalibrator.with_speed`; below ``MountConfig.min_speed`` the mount estimate is
                not updated.

        Raises:
            TypeError: a frame that is neither an array nor a tensor, or a stamp or speed that is no number.
            ValueError: a frame of another size than the camera's or of other numbers, or a stamp or speed
                that is not finite.
        """
        if speed is not None:
            check_number("speed", speed, "m/s as a number, or None")
            if not math.isfinite(speed):
                raise ValueError(f"speed: expected finite m/s, or None if it is not known, got {speed}")
        pixels = None if frame is None else self._rgb(frame)
        fast = fast_remark(speed or 0.0, "divide it by 3.6")
        lost = "no frame was given" if frame is None and polylines is None else ""
        with torch.inference_mode():
            vertices, scale = self._vertices(pixels, polylines)
            dt, remarks = self._clock.step(stamp)  # not of a frame that is refused
            _, calibration, reasons, vertical_curvature = self.tracker.drive_frame(vertices, dt, scale, speed)
        self._images.add(None if pixels is None else image_bytes(pixels[:, ::STRIDE, ::STRIDE]))
        mounted = self.tracker.mount
        assert mounted is not None  # after a frame
        bev, valid = None, None
        if self.grid is not None and pixels is not None:
            bev, valid = remap_frame(
                image_bytes(pixels), self.camera, calibration.extrinsics, self.grid, vertical_curvature
            )
            bev = bev if self.colours == "rgb" else np.ascontiguousarray(bev[..., ::-1])
        std = calibration.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
        return SessionResult(
            stamp=stamp,
            dt=dt,
            extrinsics=calibration.extrinsics,
            std=Extrinsics.unstack(std),
            status=Status(int(calibration.status[0])),
            reasons=[
                *filter(None, (*remarks, lost, fast, self._lanes.doubt, self._images.remark())),
                *describe_reasons(reasons & ~Reason.TIME if remarks else reasons),
            ],
            mount=mounted,
            mount_needs=describe_mount(mounted, self.tracker.mount_estimator.config),
            calibration=calibration,
            bev=bev,
            valid=valid,
            vertical_curvature=vertical_curvature,
        )

    def save(self, path: str | Path) -> None:
        """Write the state to a file, from which :meth:`load` continues exactly.

        Raises:
            OSError: the file cannot be written.
        """
        plain = {"camera": self.camera.fingerprint(), "lane_width": self.tracker.lane_width}
        save_state(path, {**self.tracker.states(), **plain, "clock": self._clock.values()})

    def load(self, path: str | Path) -> None:
        """Continue from a file that :meth:`save` wrote; warn if its lane width is another one.

        Raises:
            ValueError: the file cannot be used, or is of another calibrator or camera; nothing is changed.
        """
        fresh = self._new_tracker()
        loaded = load_state(path, fresh.states())
        if loaded.problem is not None:
            raise ValueError(f"{loaded.problem}; leave out load to start anew")
        if loaded.metadata.get("camera") != self.camera.fingerprint():
            raise ValueError(f"{path}: expected the state of this camera, got another camera's")
        if remark := lane_width_remark(loaded, fresh.lane_width):
            logger.warning(remark)
        fresh.state, fresh.mount_state = loaded.states["calibrator"], loaded.states["mount"]
        self.tracker = fresh
        self._clock = FrameClock(**(loaded.metadata.get("clock") or {}))
        self._lanes, self._images = LaneDoubts(self.camera), ImageChanges()

    def _rgb(self, frame: NDArray[np.uint8] | Tensor) -> Tensor:
        """Check a frame and return it as (3, H, W) RGB."""
        image = check_frame(frame, self.camera.image_size)
        return image if self.colours == "rgb" else image.flip(0)

    def _vertices(
        self,
        image: Tensor | None,
        polylines: Sequence[ArrayLike | Tensor] | Mapping[int, ArrayLike | Tensor] | None,
    ) -> tuple[BoundaryVertices, float]:
        """Return the frame's vertices and the scale of the pose's sigmas that their detector needs."""
        if polylines is not None or image is None:
            lines = lines_from_polylines([] if polylines is None else polylines, self.polyline_sigma)
            self._lanes.add(FrameLines("", lines), image)
            return vertices_from_lines(lines, self.camera), 1.0
        if self._model is None:
            self._model = LaneBEV.from_pretrained()
        model = self._model.eval().to(self.device)
        point = None if model.far_view is None else self.tracker.vanishing_point()
        _, vertices = model.boundary_vertices(network_image(image, self.device), point)
        return map_tensors(Tensor.cpu, vertices), model.pose_sigma_scale


def _check_numbers(
    lane_width: float | None, lane_width_std: float | None, focal_std: float, polyline_sigma: float
) -> None:
    """Raise TypeError or ValueError unless these are numbers, and the last two in their ranges."""
    for name, value in (("lane_width", lane_width), ("lane_width_std", lane_width_std)):
        if value is not None:
            check_number(name, value)
    check_number("focal_std", focal_std)
    check_number("polyline_sigma", polyline_sigma)
    if not 0.0 <= focal_std < 1.0:
        raise ValueError(f"focal_std: expected a fraction of the focal length, 0 to 1, got {focal_std}")
    if not (math.isfinite(polyline_sigma) and polyline_sigma > 0):
        raise ValueError(f"polyline_sigma: expected more than 0 px, got {polyline_sigma}")


def _lane_width_of(
    calibrator: Calibrator[Any], lane_width: float | None, lane_width_std: float | None
) -> tuple[float, float]:
    """Return the lane width and its standard deviation, m, as the session must add its effect.

    Raises:
        ValueError: out of range, or a standard deviation beside the calibrator's own.
    """
    if lane_width_std is None and calibrator.lane_width_std:
        lane_width_std = 0.0  # the calibrator's covariance contains it already
    width, width_std = lane_width_prior(lane_width, lane_width_std)
    check_lane_width_prior(width, width_std, ("lane_width", "lane_width_std"))
    if width_std and calibrator.lane_width_std:
        raise ValueError(
            f"lane_width_std: expected it once, got {width_std:g} m beside the calibrator's "
            f"{calibrator.lane_width_std:g} m; leave one out"
        )
    return width, width_std


def _calibrator_of(model: LaneBEV) -> Calibrator[Any]:
    """Return a copy of a model's calibrator on the CPU.

    Raises:
        TypeError: the model has another module in its place.
    """
    own = model.calibrator
    if not isinstance(own, Calibrator):
        got = type(own).__qualname__
        raise TypeError(f"model: expected one with a lanebev.Calibrator, got {got}; give one as calibrator=")
    return deepcopy(own).cpu()
