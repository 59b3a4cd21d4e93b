"""Drives as lists of moments, and batches of noisy segments of them with exact truth.

Every row of a batch is the same drive with its own pairs of points and its own noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from lanebev.geometry.road import image_from_road_points
from lanebev.observation.segments import LaneSegments
from lanebev.testing.motions import Motion
from lanebev.types import Extrinsics

FPS = 30.0
WIDTH = 3.7
IMAGE = (1020, 1920)
STEP = 30.0  # px between points of a boundary
CAMERA = torch.tensor([[1050.0, 0.0, 959.5], [0.0, 1050.0, 509.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
PLACES = (torch.arange(6, dtype=torch.float64) - 2.5) * WIDTH


@dataclass(frozen=True)
class Moment:
    """One frame of a drive: the truth, and the changes made to its observations."""

    pose: tuple[float, float, float, float]  # rad, rad, rad, m
    offset: float = 0.0  # m, X of the ego lane's middle
    places: Tensor = field(default_factory=lambda: PLACES)  # (6,) m
    headings: Tensor = field(default_factory=lambda: torch.zeros(6, dtype=torch.float64))  # (6,) tangent
    wander: Callable[[Tensor], Tensor] | None = None  # of Z (G,): boundaries beside their places (6, G) m
    curvature: Callable[[Tensor], Tensor] | None = None  # of Z ahead, 1/m
    profile: float = 0.0  # 1/m, vertical curvature of the road, positive over a crest
    crossfall: Callable[[Tensor], Tensor] | None = None  # of Z: slope down to the right, less that at 0
    visible: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    shift: int = 0  # wrong numbering of the whole frame
    near: float = 3.5
    far: float = 75.0
    outliers: float = 0.0
    wrong_index: float = 0.0
    wrong_boundary: float = 0.0  # probability that a whole boundary has another one's index
    longest: int = 10**6  # points between the ends of a segment, at most
    dt: float = 1 / FPS
    speed: float = math.nan  # m/s, of the vehicle, where the road is no straight one
    stale: Moment | None = None  # an older moment whose image comes instead
    tag: str = ""  # scenarios name the moments that they bound separately


Change = Callable[[float, Moment], Moment]
"""Changes the moment at a time in s."""


def table1_pose(t: float) -> tuple[float, float, float, float]:
    """Return the motion of the Table I experiment: ±1.5° pitch and yaw, ±1° roll, ±5 cm, up to 1 Hz."""
    turn = 2 * math.pi * t
    return (
        math.radians(1.5) * math.sin(turn + 0.3),
        math.radians(1.5) * math.sin(0.7 * turn + 1.1),
        math.radians(1.0) * math.sin(0.9 * turn + 2.0),
        1.5 + 0.05 * math.sin(0.8 * turn),
    )


def table1_offset(t: float) -> float:
    """Return the lateral offset of the same experiment, m."""
    return -0.4 * math.sin(0.3 * math.pi * t + 0.5)


def moments(
    seconds: float,
    change: Change | None = None,
    motion: Motion = table1_pose,
    fps: float = FPS,
    start: float = 0.0,
) -> list[Moment]:
    """Return a drive of a motion from ``start`` s on, each frame changed by ``change(t, moment)``."""
    drive = []
    for k in range(round(seconds * fps)):
        t = start + k / fps
        moment = Moment(motion(t), table1_offset(t), dt=1 / fps)
        drive.append(change(t, moment) if change else moment)
    return drive


def observe(
    drive: list[Moment], rows: int, sigma: float, per_boundary: int, seed: int, dtype: torch.dtype
) -> Iterator[tuple[Moment, LaneSegments]]:
    """Yield every frame's segments for R rows."""
    generator = torch.Generator().manual_seed(seed)
    for moment in drive:
        endpoints, boundary, weight = _exact(moment.stale or moment, rows, per_boundary, generator)
        noise = torch.randn(endpoints.shape, generator=generator, dtype=torch.float64)
        endpoints = endpoints + sigma * noise
        endpoints, boundary = _corrupt(moment, endpoints, boundary, generator)
        boundary = boundary + moment.shift
        weight = weight * ((boundary >= 0) & (boundary < 6))
        segments = LaneSegments(
            endpoints.to(dtype),
            boundary.clamp(0, 5),
            weight.to(dtype),
            torch.full_like(weight, sigma).to(dtype),
        )
        yield moment, segments


def road_curves(moment: Moment, num: int = 400) -> Tensor:
    """Return X and Z of the boundaries from near to far, (6, G, 2) m."""
    inverse = torch.linspace(1 / moment.near, 1 / moment.far, num, dtype=torch.float64)
    z = 1 / inverse
    if moment.curvature is not None:
        fine = torch.linspace(0, moment.far * 1.1, 2000, dtype=torch.float64)
        step = float(fine[1] - fine[0])
        turned = _integral(moment.curvature(fine), step)
        # along the arc: dX = sin(heading) ds, dZ = cos(heading) ds
        side, ahead = _integral(turned.sin(), step), _integral(turned.cos(), step)
        points = []
        for place, own in zip(moment.places + moment.offset, moment.headings, strict=True):
            x = side + place * turned.cos() + own * ahead
            zz = ahead - place * turned.sin()
            points.append(resample(zz, x, z))
        x = torch.stack(points)
    else:
        x = (moment.places + moment.offset).unsqueeze(-1) + moment.headings.unsqueeze(-1) * z
    if moment.wander is not None:
        x = x + moment.wander(z)
    return torch.stack([x, z.expand_as(x)], dim=-1)


def _integral(values: Tensor, step: float) -> Tensor:
    """Integrate values (G,) by the trapezoidal rule from the first one on, (G,)."""
    return torch.nn.functional.pad(torch.cumulative_trapezoid(values, dx=step), (1, 0))


def on_flat_road(
    road: Tensor, height: float, profile: float, crossfall: Callable[[Tensor], Tensor] | None = None
) -> Tensor:
    """Compute the points of a flat road that look the same as those of a road that is not flat.

    Source: the road is d = ½ κ Z² + c X lower than its tangent plane below the camera, so the ray to it meets
    that plane at h / (h + d) of the way.

    Args:
        road: (..., 2) m, X and Z.
        height: h, m.
        profile: κ, 1/m, positive over a crest.
        crossfall: c of Z, the slope down to the right less that at the camera; None is 0 everywhere.
    """
    x, z = road.split(1, dim=-1)
    lower = 0.5 * profile * z.square()
    if crossfall is not None:
        lower = lower + crossfall(z) * x
    seen: Tensor = road * (height / (height + lower))
    return seen


def curves(moment: Moment, num: int = 400) -> tuple[Tensor, Tensor]:
    """Return the boundaries from near to far, (6, G, 2) px, and (6, G) bool: in the image."""
    road = on_flat_road(road_curves(moment, num), moment.pose[3], moment.profile, moment.crossfall)
    pose = Extrinsics.unstack(torch.tensor([moment.pose], dtype=torch.float64))
    pixels, ahead_ok = image_from_road_points(road.flatten(0, 1)[None], CAMERA[None], pose)
    pixels = pixels[0].view(6, num, 2)
    inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= IMAGE[1] - 1) & (pixels[..., 1] <= IMAGE[0] - 1)
    return pixels, inside & ahead_ok[0].view(6, num)


def resample(z: Tensor, x: Tensor, at: Tensor) -> Tensor:
    """Interpolate x (G,) or (G, 2) linearly at the given z; z (G,) increasing."""
    right = torch.searchsorted(z.contiguous(), at.contiguous()).clamp(1, len(z) - 1)
    share = (at - z[right - 1]) / (z[right] - z[right - 1])
    share = share if x.ndim == 1 else share.unsqueeze(-1)
    return x[right - 1] + share * (x[right] - x[right - 1])


def _exact(
    moment: Moment, rows: int, per_boundary: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return end points (R, N, 2, 2), boundary and weight (R, N): points every 30 px, paired at random."""
    pixels, inside = curves(moment)
    ends, weights = [], []
    for k in range(6):
        line = pixels[k][inside[k]]
        arc = torch.cat([torch.zeros(1, dtype=torch.float64), line.diff(dim=0).norm(dim=-1).cumsum(0)])
        count = int(arc[-1] // STEP) + 1 if len(arc) > 1 else 0
        if k not in moment.visible or count < 2:
            ends.append(torch.zeros(rows, per_boundary, 2, 2, dtype=torch.float64))
            weights.append(torch.zeros(rows, per_boundary, dtype=torch.float64))
            continue
        at = torch.arange(count, dtype=torch.float64) * STEP
        points = resample(arc, line, at)
        first = torch.randint(count, (rows, per_boundary), generator=generator)
        reach = min(count - 1, moment.longest)
        second = first + torch.randint(1, reach + 1, first.shape, generator=generator)
        second = torch.where(second < count, second, (second - count) if reach == count - 1 else first - 1)
        ends.append(torch.stack([points[first], points[second.clamp(min=0)]], dim=2))
        weights.append((second >= 0).double())
    boundary = torch.arange(6).repeat_interleave(per_boundary).expand(rows, -1).clone()
    return torch.cat(ends, dim=1), boundary, torch.cat(weights, dim=1)


def _corrupt(
    moment: Moment, endpoints: Tensor, boundary: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Add gross outliers anywhere in the lower half, and wrong indices of segments or of whole boundaries."""

    def draw() -> Tensor:
        return torch.rand(boundary.shape, generator=generator)

    gross = draw() < moment.outliers
    size = torch.tensor([IMAGE[1], IMAGE[0] / 2], dtype=torch.float64)
    anywhere = torch.rand(endpoints.shape, generator=generator, dtype=torch.float64) * size
    anywhere[..., 1] += IMAGE[0] / 2
    endpoints = torch.where(gross[..., None, None], anywhere, endpoints)
    other = (boundary + torch.randint(1, 6, boundary.shape, generator=generator)) % 6
    boundary = torch.where(draw() < moment.wrong_index, other, boundary)
    whole = torch.rand(boundary.shape[0], 6, generator=generator) < moment.wrong_boundary
    onto = torch.randint(0, 6, whole.shape, generator=generator)
    return endpoints, torch.where(whole.gather(1, boundary), onto.gather(1, boundary), boundary)
