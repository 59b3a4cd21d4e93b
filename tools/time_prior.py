"""A prior of the network's maps by time: the last frame's boundaries, moved by the predicted pose.

The logit of boundary k, at a distance of d cells from its place in the joint filter's prediction, gets

    gain · g - penalty · (1 - g),   g = p_k exp(-d² / 2s²),   s = 1.5 cells,

with p_k near 1 while the filter takes vertices of the boundary for inliers. :class:`lanebev.LaneBEV` has no
such prior, since it makes some figures worse: see ``tools/bench_time_prior.py``.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np
import torch
from torch import Tensor, nn

from lanebev.camera.model import Camera
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.layout import NUM_COMMON, SHAPE, layout
from lanebev.estimation.joint.measurement import HEIGHT, OFFSET, VERTICAL
from lanebev.estimation.joint.observations import boundary_places
from lanebev.estimation.joint.prediction import predict_state
from lanebev.estimation.joint.road_curve import road_curve, road_shape
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.geometry.lens import denormalise_points
from lanebev.geometry.road import road_from_image_points
from lanebev.geometry.rotation import road_from_cam
from lanebev.observation.segments import LaneSegments
from lanebev.types import Calibration, Status

_FARTHEST = 80.0  # m ahead, up to which a boundary is drawn
_SPREAD = 1.5  # cells, s
_MEMORY = 0.5  # s, time constant of the presence of a boundary that is not seen
_SEEN = 5.0  # inliers from which a boundary is surely present
_CROSSING = 0.3  # m from a line, nearer than which boundaries may be renumbered


def predicted_rays(state: JointState, places: Tensor, z: Tensor) -> Tensor:
    """Compute rays (L, P, 3) in the camera's axes to the boundaries of a state at z (P,) m, by (J2)."""
    params = state.mean[:, layout(len(places)).observed]  # (1, 12 + L)
    curve = road_curve(z.unsqueeze(0), road_shape(params[:, SHAPE], state.phase))
    x_k = (params[0, OFFSET] + places + params[0, NUM_COMMON:]).unsqueeze(-1)  # (L, 1)
    across = curve.bend + x_k * (1 + 0.5 * curve.heading.square())
    down = params[0, HEIGHT] + 0.5 * params[0, VERTICAL] * z.square()
    points = torch.stack([across, down.expand_as(across), z.expand_as(across)], dim=-1)
    rays: Tensor = points @ road_from_cam(*params[:, :HEIGHT].unbind(-1))  # d_cam = Rᵀ d_road, as rows
    return rays


def draw(cells: Tensor, presence: Tensor, size: tuple[int, int]) -> Tensor:
    """Draw g (L, h, w) about boundaries (L, P, 2) (x, y), near to far, NaN where one is not to be drawn."""
    drawn = torch.zeros(len(cells), *size, dtype=cells.dtype)
    rows, columns = np.arange(size[0], dtype=float), torch.arange(size[1], dtype=cells.dtype)
    for own, points, share in zip(drawn, cells, presence, strict=True):
        x, y = points[points.isfinite().all(-1)].flip(0).mT.numpy()
        if len(x) > 1:
            at_rows = torch.from_numpy(np.interp(rows, y, x, np.nan, np.nan)).to(cells.dtype)
            steep = (1 + torch.gradient(at_rows)[0].square()).rsqrt()
            distance = steep.unsqueeze(-1) * (columns - at_rows.unsqueeze(-1))
            own[:] = share * (-0.5 * (distance / _SPREAD).square()).exp()
    return drawn.nan_to_num(0.0)


class PriorCalibrator(JointCalibrator):
    """The joint calibrator of one drive, which remembers its state for the prior of the next frame's maps.

    Args:
        prior: gain and penalty, nats.
        camera: the lens.
        network_size: (h, w) px of the network's input.
    """

    def __init__(self, prior: tuple[float, float], camera: Camera, network_size: tuple[int, int]) -> None:
        super().__init__()
        self.prior, self.camera, self.network_size = prior, camera, network_size
        self.last: JointState | None = None
        self.dt = torch.zeros(1, dtype=torch.float64)
        self.places = torch.zeros(self.num_boundaries, dtype=torch.float64)  # m, of the boundaries
        self.presence = torch.zeros_like(self.places)
        self.reach = torch.zeros_like(self.places)  # m, how far ahead a boundary was seen

    def forget(self) -> None:
        """Forget the drive."""
        self.last = None
        self.presence, self.reach = torch.zeros_like(self.presence), torch.zeros_like(self.reach)

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> JointState:
        """See :class:`~lanebev.JointCalibrator`; the drive before is forgotten."""
        self.forget()
        return super().initial_state(batch_size, dtype, device)

    def step(
        self, segments: LaneSegments, intrinsics: Tensor, state: JointState, dt: Tensor, lane_width: Tensor
    ) -> tuple[Calibration, JointState]:
        """See :class:`~lanebev.JointCalibrator`."""
        calibration, self.last = super().step(segments, intrinsics, state, dt, lane_width)
        self.dt, self.places = dt, boundary_places(lane_width, self.num_boundaries, dt)[0]
        ends = segments.endpoints.flatten(1, 2)
        road, ahead = road_from_image_points(ends, intrinsics, calibration.extrinsics)
        z = torch.where(ahead, road[..., 1], 0.0).reshape(-1, 2).amax(-1)
        kept = segments.weight[0] * calibration.inliers[0] > 0.3
        own = kept & (segments.boundary[0] == torch.arange(self.num_boundaries).unsqueeze(-1))  # (L, N)
        decay = math.exp(-float(dt[0]) / _MEMORY) * float(not int(self.last.reasons[0]) & Reason.LANE_CHANGE)
        self.presence = torch.maximum((own.sum(-1) / _SEEN).clamp(max=1.0), decay * self.presence)
        self.reach = torch.maximum((own * z).amax(-1), decay * self.reach).clamp(max=_FARTHEST)
        return calibration, self.last

    def add_prior(self, logits: Tensor) -> Tensor:
        """Add the prior to the logits (1, 1 + L, h, w) of the frame that comes next."""
        if not any(self.prior) or self.last is None or int(self.last.status[0]) != Status.TRACKING:
            return logits
        predicted, *_ = predict_state(self.last, self.dt, self.config)
        if (predicted.mean[0, OFFSET] + self.places).abs().min() < _CROSSING:
            return logits
        z = 1 / torch.linspace(1 / 3.0, 1 / _FARTHEST, 64, dtype=self.places.dtype)
        rays = predicted_rays(predicted, self.places, z)
        ideal = (rays[..., :2] / rays[..., 2:].clamp(min=0.05)).flatten(0, 1)[None]
        pixels = self.camera.distort_points(
            denormalise_points(ideal, self.camera.intrinsics.to(ideal)[None])[0]
        )
        ratio = pixels.new_tensor(self.network_size[::-1]) / pixels.new_tensor(self.camera.image_size[::-1])
        cells = ((pixels + 0.5) * ratio - 0.5) / (self.network_size[0] / logits.shape[-2])
        shown = (z <= self.reach.unsqueeze(-1)).unsqueeze(-1)
        cells = torch.where(shown, cells.unflatten(0, shown.shape[:2]), torch.nan)
        drawn = draw(cells, self.presence, (logits.shape[-2], logits.shape[-1])).to(logits)
        gain, penalty = self.prior
        return torch.cat([logits[:, :1], logits[:, 1:] + gain * drawn - penalty * (1 - drawn)], dim=1)


class PriorSegmenter(nn.Module):
    """A network with the prior of a calibrator in its logits."""

    def __init__(self, segmenter: nn.Module, calibrator: PriorCalibrator) -> None:
        super().__init__()
        self.segmenter, self.calibrator, self.config = segmenter, calibrator, segmenter.config

    def forward(self, image: Tensor) -> Tensor:
        """Compute the logits of one image (1, 3, h, w)."""
        return self.calibrator.add_prior(self.segmenter(image))


class RememberedSegmenter(nn.Module):
    """A network that computes the logits of an image once, for all priors."""

    def __init__(self, segmenter: nn.Module) -> None:
        super().__init__()
        self.segmenter, self.config = segmenter, segmenter.config
        self.logits: dict[bytes, Tensor] = {}

    def forward(self, image: Tensor) -> Tensor:
        """Compute the logits of one image (1, 3, h, w)."""
        name = hashlib.sha256(image.cpu().numpy().tobytes()).digest()
        if name not in self.logits:
            self.logits[name] = self.segmenter(image)
        return self.logits[name]
