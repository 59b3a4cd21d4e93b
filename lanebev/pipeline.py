"""LaneBEV: combines the modules; contains no maths."""

from __future__ import annotations

import math
from collections.abc import Collection
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lanebev.batch import select_rows
from lanebev.clips import doubt_intervals, drive_starts, frame_cameras, per_frame
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.expected_view import expected_vanishing_point
from lanebev.geometry.lens import check_distortion
from lanebev.geometry.precision import autocast_is_on, autocast_off, common_dtype
from lanebev.numbers import check_number
from lanebev.observation.boundary_detector import BoundaryDetector
from lanebev.observation.far_view import FarView
from lanebev.observation.frames import black_unless_finite, check_images
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segments import LaneSegments, segments_from_vertices
from lanebev.tensors import join_tensors, map_tensors
from lanebev.torch_internals import register_pytree
from lanebev.types import Calibration, Extrinsics, check_devices
from lanebev.view.checks import doubt_intrinsics
from lanebev.view.grid import BEVGrid, bev_from_image
from lanebev.view.warp import BEVWarp

STAGES = ("segmenter", "extractor", "calibrator", "warp")
_USUAL = dict(
    zip(STAGES, ("LaneSegmenter()", "LineExtractor()", "JointCalibrator()", "BEVWarp()"), strict=True)
)


@register_pytree
class LaneBEVOutput(NamedTuple):
    """Output for one frame, or for every frame with (B, T) input.

    Attributes:
        bev: (B, 3, U, V), zero where not valid; None where it was not asked for. It follows the vertical
            curvature of the road where the calibrator estimates one. An image that is not finite is black.
        valid: (B, 1, U, V) bool, nowhere in an image that is not finite; None likewise.
        calibration: extrinsics, covariance, status, inliers.
        bev_from_image: (B, 3, 3) homography from undistorted pixels to BEV pixels of a plane road, which
            touches the road below the camera.
        segments: what the calibrator was given, in undistorted pixels of the image.
        logits: (B, 1 + L, h, w) of the network for the whole image.
    """

    bev: Tensor | None
    valid: Tensor | None
    calibration: Calibration
    bev_from_image: Tensor
    segments: LaneSegments
    logits: Tensor


class LaneBEV(BoundaryDetector):
    """Image to bird's-eye view: segmenter, line extractor, calibrator, warp.

    Args:
        segmenter: image (B, 3, h, w) in [0, 1] to logits (B, 1 + L, h', w').
        extractor: a :class:`LineExtractor`, or another module with a method ``vertices`` that takes logits,
            (H, W) of the image and (h, w) of the network's input, and returns vertices in the image's pixels.
        calibrator: e.g. :class:`lanebev.JointCalibrator`.
        warp: default :class:`BEVWarp` on the default grid.
        network_width: width, px, to which the image is resized for the segmenter; the height follows by the
            aspect ratio, rounded to a multiple of 32. None does not resize.
        network_pixels: number of pixels that the network's input should have. A wide image, which would have
            fewer at ``network_width``, is resized to a larger width, at most its own. None: all images are
            resized to ``network_width``.
        pose_sigma_scale: factor on the standard deviations of the pose; None takes the segmenter's
            (:class:`SegmenterConfig`), or 1 where it has none.
        frozen: names of STAGES without training and gradients: they stay in evaluation mode, and no graph of
            them is kept. With all but the warp frozen, the view is still differentiable in the image.
        far_view: sizes of a view about the horizon that the network sees beside a smaller whole image. The
            horizon is that of the state before the frame, or of the prior of a known mount. Rows where it is
            not known (not TRACKING, or a sharp turn) have the whole image alone. None: all rows have.

    Raises:
        TypeError: a part is no module.
        ValueError: segmenter and calibrator have different numbers of boundaries, a stage does not exist, or
            a number is not positive.
    """

    def __init__(
        self,
        segmenter: nn.Module,
        extractor: LineExtractor,
        calibrator: nn.Module,
        warp: BEVWarp | None = None,
        network_width: int | None = None,
        pose_sigma_scale: float | None = None,
        frozen: Collection[str] = (),
        network_pixels: int | None = None,
        far_view: FarView | None = None,
    ) -> None:
        parts = {"segmenter": segmenter, "extractor": extractor, "calibrator": calibrator}
        for name, part in (parts | ({} if warp is None else {"warp": warp})).items():
            if not isinstance(part, nn.Module):
                raise TypeError(f"{name}: expected a module, such as lanebev.{_USUAL[name]}, got {part!r}")
        if isinstance(frozen, str) or not isinstance(frozen, Collection):
            raise TypeError(f"frozen: expected a list of names, got {frozen!r}; write ['segmenter']")
        super().__init__(segmenter, extractor, network_width, network_pixels, frozen, far_view)
        if unknown := set(frozen) - set(STAGES):
            raise ValueError(
                f"frozen: expected some of {', '.join(STAGES)}, got {', '.join(sorted(unknown))}"
            )
        seen, known = (_configured(part, "num_boundaries") for part in (segmenter, calibrator))
        if seen != known and None not in (seen, known):
            raise ValueError(
                f"num_boundaries: expected the same of segmenter and calibrator, got {seen} and {known}; "
                f"make the calibrator with num_boundaries={seen}"
            )
        if pose_sigma_scale is None:
            pose_sigma_scale = _configured(segmenter, "pose_sigma_scale", 1.0)
        check_number("pose_sigma_scale", pose_sigma_scale)
        if not 0 < pose_sigma_scale < math.inf:
            raise ValueError(f"pose_sigma_scale: expected more than 0 and finite, got {pose_sigma_scale}")
        self.calibrator = calibrator
        self.warp = warp or BEVWarp()
        self.pose_sigma_scale = pose_sigma_scale
        for stage in self.frozen:
            self.get_submodule(stage).requires_grad_(False).eval()

    @classmethod
    def from_pretrained(
        cls,
        weights: str | Path | None = None,
        grid: BEVGrid | None = None,
        calibrator: nn.Module | None = None,
        network_width: int | None = None,
        frozen: Collection[str] = (),
        far_view: FarView | None = None,
    ) -> LaneBEV:
        """Make a model with the shipped weights, offline.

        Args:
            weights: another file in the same format; None is the shipped one.
            grid: grid of the view.
            calibrator: None is a default :class:`lanebev.JointCalibrator` of the network's boundaries.
            network_width: px; None is the width that the weights were trained for, and a larger one for wide
                images, at which the input has about as many pixels as in training.
            frozen: see the class.
            far_view: see the class.

        Raises:
            ValueError: a weights file that doesn't fit the network.
        """
        from lanebev.estimation.joint.calibrator import JointCalibrator
        from lanebev.weights import load_segmenter

        segmenter = load_segmenter(weights)
        rows, columns = map(int, segmenter.image_size)
        width, pixels = (columns, rows * columns) if network_width is None else (network_width, None)
        extractor = LineExtractor.for_network(segmenter.config)
        calibrator = calibrator or JointCalibrator(num_boundaries=segmenter.config.num_boundaries)
        view = BEVWarp(grid)
        return cls(
            segmenter, extractor, calibrator, view, width,
            frozen=frozen, network_pixels=pixels, far_view=far_view,
        )  # fmt: skip

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> Any:
        """Return the calibrator's state before the first frame, of ``batch_size`` drives.

        Raises:
            TypeError: a batch size that is no whole number.
            ValueError: a negative batch size, or another dtype than float32 and float64.
        """
        initial_state: Any = self.calibrator.initial_state
        device = torch.device(device or "cpu")
        # asked, since torch.export cannot keep an empty context
        with autocast_off(device) if autocast_is_on(device) else nullcontext():
            return initial_state(batch_size, dtype=dtype, device=device)

    def forward(
        self,
        image: Tensor,
        intrinsics: Tensor,
        state: Any = None,
        dt: float | Tensor = 1 / 30,
        lane_width: float | Tensor = 3.7,
        distortion: Tensor | None = None,
        model: str = "pinhole",
        reset: Tensor | None = None,
        truncation: int | None = None,
        bev: bool = True,
        speed: float | Tensor | None = None,
    ) -> tuple[LaneBEVOutput, Any]:
        """Process one frame of every row, or T frames of every row in order.

        Args:
            image: (B, 3, H, W) or (B, T, 3, H, W), RGB in [0, 1], as taken.
            intrinsics: (B, 3, 3) px, or (B, T, 3, 3) where they change from frame to frame.
            state: state after the frame before; its dtype is the calibration's. None starts a drive in the
                dtype of the intrinsics, at least float32.
            dt: s since the frame before: float, (B,) or, with T frames, (B, T).
            lane_width: m: float, (B,) or (B, L-1). It counts as exact, also the default; for an uncertain
                width add :func:`~lanebev.geometry.road.lane_width_covariance` to the pose's covariance.
            distortion: (B, D) of the lens, or None.
            model: "pinhole", "fisheye" or "omni".
            reset: (B,) or, with T frames, (B, T) bool: in these rows the frame is the first of another drive
                and the state is reset; (B,) applies to the first frame.
            truncation: number N of frames over which gradients flow through the state: it is detached before
                the first and then every N-th frame. None keeps the whole graph, also of earlier calls.
            bev: whether to resample the image; a detector that warps only its own features needs no view.
            speed: m/s, of the vehicle at a frame: float, (B,) or, with T frames, (B, T); NaN where it is not
                known. See :meth:`~lanebev.estimation.calibrator.Calibrator.with_speed`.

        Returns:
            the output, every tensor with (B, T, ...) where the image has T, and the state after it.

        Raises:
            ValueError: shapes or devices that don't fit, or an image of whole numbers.
            TypeError: a speed, and a calibrator that takes none.
        """
        check_images(image)
        cameras = frame_cameras(intrinsics, image)
        check_distortion(distortion, model, image.shape[0])
        if truncation is not None and truncation < 1:
            raise ValueError(f"truncation: expected 1 frame or more, or None, got {truncation}")
        if speed is not None and not hasattr(self.calibrator, "with_speed"):
            got = type(self.calibrator).__qualname__
            raise TypeError(f"speed: expected a calibrator with a method with_speed, got {got}; leave it out")
        frames = image if image.ndim == 5 else image.unsqueeze(1)
        batch, steps = frames.shape[:2]
        intervals = per_frame("dt", dt, batch, steps, intrinsics)
        speeds = None if speed is None else per_frame("speed", speed, batch, steps, intrinsics)
        begins = None if reset is None else drive_starts(reset, batch, steps)
        check_devices({"image": image, "intrinsics": intrinsics, "distortion": distortion, "reset": begins})
        doubt_intrinsics(intrinsics, (image.shape[-2], image.shape[-1]))
        if state is not None:
            doubt_intervals(intervals, begins)
        if state is None or begins is not None:
            dtype = common_dtype(intrinsics) if state is None else state[0].dtype
            fresh = self.initial_state(batch, dtype, image.device)
            state = fresh if state is None else state
        clips = None if self.far_view else self._observe_clips(frames, cameras, distortion, model)
        outputs = []
        for step in range(steps):
            frame, lens = frames[:, step], (cameras[:, step], distortion, model)
            if begins is not None:
                state = select_rows(begins[:, step], fresh, state)
            if truncation is not None and step % truncation == 0:
                state = state.detach()
            if clips is None:  # the state before the frame places the far view
                point = expected_vanishing_point(self.calibrator, state, *lens)
                logits, segments = self.observe(frame, *lens, vanishing_point=point)
            else:
                logits, segments = clips[0][:, step], LaneSegments(*(part[:, step] for part in clips[1]))
            self._check_channels(logits)
            moving = None if speeds is None else speeds[:, step]
            calibration, state = self._calibrate(
                segments, cameras[:, step], state, intervals[:, step], lane_width, moving
            )
            view, valid = self._view(frame, *lens, calibration.extrinsics, state) if bev else (None, None)
            homography = bev_from_image(calibration.extrinsics, cameras[:, step], self.warp.grid)
            outputs.append(LaneBEVOutput(view, valid, calibration, homography, segments, logits))
        output = outputs[0] if image.ndim == 4 else join_tensors(lambda each: torch.stack(each, 1), outputs)
        return output, state

    def _calibrate(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: Any,
        dt: Tensor,
        lane_width: float | Tensor,
        speed: Tensor | None,
    ) -> tuple[Calibration, Any]:
        """Calibrate by the segments of a frame, with the network's factor on the standard deviations."""
        with self._gradients("calibrator"):
            calibration, state = self.calibrator(segments, intrinsics, state, dt, lane_width)
            if isinstance(self.calibrator, Calibrator):
                factor = self.pose_sigma_scale
                calibration = self.calibrator.scale_drive(calibration, state, factor, lane_width)
            else:
                calibration = calibration.with_std_scaled(self.pose_sigma_scale)
            if speed is not None:
                with_speed: Any = self.calibrator.with_speed
                state = with_speed(state, speed)
        return calibration, state

    def _check_channels(self, logits: Tensor) -> None:
        """Raise unless the network has a map of each boundary that the calibrator numbers, and background."""
        known: int | None = getattr(self.calibrator, "num_boundaries", None)
        if known is not None and logits.shape[1] != 1 + known:
            raise ValueError(
                f"logits: expected 1 + {known} channels, the background and the calibrator's boundaries, got "
                f"{logits.shape[1]}; make the calibrator with num_boundaries={logits.shape[1] - 1}"
            )

    def _view(
        self,
        image: Tensor,
        intrinsics: Tensor,
        distortion: Tensor | None,
        model: str,
        extrinsics: Extrinsics,
        state: Any,
    ) -> tuple[Tensor, Tensor]:
        """Resample images (B, 3, H, W), which count as black if they are not finite."""
        usable, finite = black_unless_finite(image)
        vertical_curvature = getattr(self.calibrator, "vertical_curvature", lambda _: None)
        with self._gradients("warp"):
            curvature = vertical_curvature(state)  # None: the road is a plane
            road = {} if curvature is None else {"vertical_curvature": curvature}
            view, valid = self.warp(usable, intrinsics, extrinsics, distortion, model, **road)
        if usable is not image:
            valid = select_rows(finite, valid, torch.zeros_like(valid))
        return view, valid

    def _observe_clips(
        self, frames: Tensor, cameras: Tensor, distortion: Tensor | None, model: str
    ) -> tuple[Tensor, LaneSegments]:
        """Observe T frames (B, T, 3, H, W) as one batch, as :meth:`observe`; of tensors (B, T, ...)."""
        batch, steps = frames.shape[:2]
        lens = None if distortion is None else distortion.repeat_interleave(steps, 0)
        seen = self.observe(frames.flatten(0, 1), cameras.flatten(0, 1), lens, model)

        def by_clip(part: Tensor) -> Tensor:
            return part.reshape(batch, steps, *part.shape[1:])

        return by_clip(seen[0]), map_tensors(by_clip, seen[1])

    def observe(
        self,
        image: Tensor,
        intrinsics: Tensor,
        distortion: Tensor | None = None,
        model: str = "pinhole",
        vanishing_point: Tensor | None = None,
    ) -> tuple[Tensor, LaneSegments]:
        """Run network, line extraction and pairing only.

        Args:
            image: (B, 3, H, W) as taken.
            intrinsics: (B, 3, 3) px.
            distortion: (B, D) or None.
            model: "pinhole", "fisheye" or "omni".
            vanishing_point: (B, 2) px of the image as taken, see :meth:`boundary_vertices`.

        Returns:
            logits (B, 1 + L, h, w) and segments in undistorted pixels of the image.
        """
        logits, vertices = self.boundary_vertices(image, vanishing_point)
        with self._gradients("extractor"):
            return logits, segments_from_vertices(vertices, intrinsics, distortion, model)


def _configured(part: nn.Module, name: str, default: Any = None) -> Any:
    """Return a setting of a module's ``config``, if it has one."""
    return getattr(getattr(part, "config", None), name, default)
