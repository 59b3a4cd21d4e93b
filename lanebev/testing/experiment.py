"""The paper's synthetic experiment: six straight boundaries seen by a camera in motion, and its bound.

Shared by reproduce_table1.py, bench_calibration.py and the tests. Segments are those of Sec. VI-B: points
every 30 px along each boundary, paired at random, Gaussian noise on every end point.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from lanebev.geometry.rotation import road_from_cam
from lanebev.observation.segments import LaneSegments
from lanebev.types import Extrinsics


@dataclass(frozen=True)
class Experiment:
    """Settings that the paper does not give: focal length, frame rate, motion, range (paper.md D13)."""

    width: int = 1920
    height: int = 1020
    focal: float = 1050.0
    num_boundaries: int = 6
    lane_width: float = 3.7
    num_frames: int = 300
    fps: float = 30.0
    spacing_px: float = 30.0
    segments_per_boundary: int = 30
    horizon_margin_px: float = 20.0  # boundaries end this far below the vanishing point
    pitch_deg: float = 1.5
    yaw_deg: float = 1.5
    roll_deg: float = 1.0
    height_m: float = 0.05
    mean_height_m: float = 1.5
    max_frequency_hz: float = 1.0

    def intrinsics(self) -> Tensor:
        """(3, 3) px, principal point in the middle of the image."""
        cx, cy = (self.width - 1) / 2, (self.height - 1) / 2
        return torch.tensor(
            [[self.focal, 0.0, cx], [0.0, self.focal, cy], [0.0, 0.0, 1.0]], dtype=torch.float64
        )

    def motion(self) -> tuple[Extrinsics, Tensor]:
        """Return extrinsics of every frame and the lateral offset, m, each (T,): sinusoids up to 1 Hz."""
        t = torch.arange(self.num_frames, dtype=torch.float64) / self.fps
        turn = 2 * math.pi * self.max_frequency_hz * t
        pitch = math.radians(self.pitch_deg) * (turn + 0.3).sin()
        yaw = math.radians(self.yaw_deg) * (0.7 * turn + 1.1).sin()
        roll = math.radians(self.roll_deg) * (0.9 * turn + 2.0).sin()
        height = self.mean_height_m + self.height_m * (0.8 * turn).sin()
        offset = 0.4 * (0.15 * turn + 0.5).sin()
        return Extrinsics(pitch, yaw, roll, height), offset


def boundary_lines(pose: Tensor, positions: Tensor, intrinsics: Tensor) -> Tensor:
    """Compute the image lines of straight boundaries.

    Args:
        pose: (5,) pitch, yaw, roll, height, offset of the camera to the right.
        positions: (L,) m, right of the ego lane's middle.
        intrinsics: (3, 3).

    Returns:
        (L, 3) homogeneous lines with unit (a, b).
    """
    rotation = road_from_cam(pose[0], pose[1], pose[2])
    x = positions - pose[4]
    ones = torch.ones_like(x)
    # The plane through the camera and the boundary: normal to (0, 0, 1) and to (x, h, 0) in the road frame.
    normals = torch.stack([pose[3] * ones, -x, torch.zeros_like(x)], dim=-1) @ rotation
    lines: Tensor = normals @ torch.linalg.inv(intrinsics)
    length: Tensor = lines[:, :2].norm(dim=-1, keepdim=True)
    return lines / length


def boundary_spans(pose: Tensor, positions: Tensor, intrinsics: Tensor, exp: Experiment) -> Tensor:
    """Compute where each boundary enters the image and ends near the vanishing point, (L, 2, 2) px."""
    rotation = road_from_cam(pose[0], pose[1], pose[2])
    vanishing = intrinsics @ rotation[2]
    vp = vanishing[:2] / vanishing[2]
    spans = []
    for line in boundary_lines(pose, positions, intrinsics):
        a, b = line[:2].tolist()
        direction = torch.tensor([-b, a], dtype=pose.dtype)
        direction = direction * (1 if direction[1] > 0 else -1)  # down the image
        reach = []
        for axis, limit in ((0, 0.0), (0, exp.width - 1.0), (1, exp.height - 1.0)):
            if abs(direction[axis]) > 1e-9:
                s = (limit - vp[axis]) / direction[axis]
                if s > 0:
                    reach.append(float(s))
        start = exp.horizon_margin_px / max(float(direction[1]), 0.2)
        spans.append(torch.stack([vp + min(reach) * direction, vp + start * direction]))
    return torch.stack(spans)


def sample_segments(
    spans: Tensor, exp: Experiment, rows: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw random pairs of points every 30 px, without noise.

    Args:
        spans: (L, 2, 2) px.
        exp: spacing and number of segments.
        rows: R independent draws.
        generator: generator of the draws.

    Returns:
        end points (R, L·S, 2, 2) px and boundary (R, L·S).
    """
    parts = []
    for span in spans:
        length = float((span[1] - span[0]).norm())
        count = max(int(length // exp.spacing_px) + 1, 2)
        points = span[0] + (span[1] - span[0]) * (torch.arange(count) * exp.spacing_px / length).unsqueeze(-1)
        first = torch.randint(count, (rows, exp.segments_per_boundary), generator=generator)
        second = torch.randint(count - 1, (rows, exp.segments_per_boundary), generator=generator)
        second = second + (second >= first)
        parts.append(torch.stack([points[first], points[second]], dim=2))
    boundary = torch.arange(len(parts)).repeat_interleave(exp.segments_per_boundary)
    return torch.cat(parts, dim=1), boundary.expand(rows, -1)


def cramer_rao_cov(
    pose: Tensor, positions: Tensor, intrinsics: Tensor, endpoints: Tensor, boundary: Tensor, variance: float
) -> Tensor:
    """Compute the per-frame Cramér-Rao bound of (pitch, yaw, roll, height) with unknown offset.

    Source: Kay 1993, Sec. 3.9, for independent perpendicular errors of all end points.

    Args:
        pose: (5,).
        positions: (L,) m.
        intrinsics: (3, 3).
        endpoints: (N, 2, 2) px, exact.
        boundary: (N,).
        variance: px².

    Returns:
        (4, 4).
    """
    jacobian: Tensor = torch.func.jacfwd(boundary_lines)(pose, positions, intrinsics)  # (L, 3, 5)
    ones = torch.ones_like(endpoints[..., :1])
    points = torch.cat([endpoints, ones], dim=-1)  # (N, 2, 3)
    rows = torch.einsum("nec,ncd->ned", points, jacobian[boundary]).flatten(0, 1)
    covariance: Tensor = torch.linalg.inv(rows.T @ rows / variance)
    return covariance[:4, :4]


@dataclass(frozen=True)
class Frame:
    """One frame for all rows: exact and noisy segments, the true pose and its bound at unit variance."""

    endpoints: Tensor  # (R, N, 2, 2) exact
    boundary: Tensor  # (R, N)
    truth: Tensor  # (4,)
    bound: Tensor  # (4,) standard deviations at a variance of 1 px²

    def segments(self, std: Tensor, generator: torch.Generator, dtype: torch.dtype) -> LaneSegments:
        """Return segments with Gaussian noise of (R,) px on every end point."""
        noise = torch.randn(self.endpoints.shape, generator=generator, dtype=self.endpoints.dtype)
        noisy = self.endpoints + noise * std[:, None, None, None]
        weight = torch.ones(self.boundary.shape, dtype=dtype)
        return LaneSegments(
            noisy.to(dtype), self.boundary, weight, std[:, None].expand_as(weight).to(dtype).contiguous()
        )


def frames(exp: Experiment, rows: int, generator: torch.Generator) -> Iterator[Frame]:
    """Yield every :class:`Frame` of the experiment, R rows each with its own pairs."""
    extrinsics, offset = exp.motion()
    intrinsics = exp.intrinsics()
    middle = (exp.num_boundaries - 1) / 2
    positions = (torch.arange(exp.num_boundaries, dtype=torch.float64) - middle) * exp.lane_width
    poses = torch.cat([extrinsics.stack(), offset[:, None]], dim=-1)
    for pose in poses:
        spans = boundary_spans(pose, positions, intrinsics, exp)
        endpoints, boundary = sample_segments(spans, exp, rows, generator)
        cov = cramer_rao_cov(pose, positions, intrinsics, endpoints[0], boundary[0], 1.0)
        yield Frame(endpoints, boundary, pose[:4], cov.diagonal().sqrt())
