"""Vertices of boundaries in probability maps, and their means over stretches of a boundary.

Label pixels are cells of the map. Everything is differentiable in the probabilities.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import masked_median

_CIRCLE_TOLERANCE = 3.0  # px; two vertices that are farther off a common circle are not averaged
_CLEAN_SIGMA = 0.03  # px; up to this median sigma of a boundary's vertices the map is clean
_LARGEST_SIGMA = 0.12  # px; on a clean map a vertex of larger sigma counts less, at 3/2 of it not at all


@dataclass(frozen=True)
class LineConfig:
    """Configuration of the line extraction.

    Attributes:
        stride: px of the network's input per label px.
        half_width: half width of the stripes that the network learned, across the line, label px.
        segments: per boundary, S.
        window: half-width of the window about a scan's peak, label px.
        min_mass, full_mass: sums of a scan's probabilities, as fractions of a stripe's, up to which the scan
            has weight 0 (no boundary), and from which it has weight 1.
        max_mass: fraction from which a scan is not used: it crosses the boundary more than once, as where
            the boundary turns back at the horizon; its weight decreases over 0.2 below that.
        min_vertices: a boundary with fewer counts as not seen.
        sigma_floor: least standard deviation of a vertex, label px, by errors that correlate along the line.
        sigma_scale: factor on all standard deviations; 1 for exact maps.
        least_weight: smallest weight of a vertex; fainter ones are on the foot of a barrier as often as on
            paint.
        correlation: vertical distance, px of the image, over which a line's errors are fully correlated:
            vertices nearer to each other count as one observation; 0 for exact maps.
    """

    stride: int = 2
    half_width: float = 1.125
    segments: int = 16
    window: int = 6
    min_mass: float = 0.2
    full_mass: float = 0.6
    max_mass: float = 1.4
    min_vertices: int = 8
    sigma_floor: float = 0.004
    sigma_scale: float = 1.0
    least_weight: float = 0.2
    correlation: float = 0.0

    def __post_init__(self) -> None:
        for name in ("stride", "segments", "window", "min_vertices"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        for name in ("half_width", "sigma_scale"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected more than 0 and finite, got {getattr(self, name)}")
        if not 0 <= self.correlation < math.inf:
            raise ValueError(f"correlation: expected 0 px or more, got {self.correlation}")
        if not 0 <= self.least_weight <= 1:
            raise ValueError(f"least_weight: expected 0 to 1, got {self.least_weight}")
        if not 0 <= self.min_mass < self.full_mass:
            raise ValueError(
                f"full_mass: expected more than min_mass ({self.min_mass}), got {self.full_mass}"
            )
        if not self.full_mass < self.max_mass:
            raise ValueError(
                f"max_mass: expected more than full_mass ({self.full_mass}), got {self.max_mass}"
            )


class Vertices(NamedTuple):
    """Points on boundaries, padded.

    Attributes:
        points: (B, L, V, 2) (x, y) label px.
        normal: (B, L, V, 2) unit vectors across the line, of either sign.
        weight: (B, L, V) in [0, 1], confidence that the boundary is there.
        density: (B, L, V) in [0, 1], weight in a mean: near 45 degrees rows and columns share it.
        common_var: (B, L, V) label px², variance across the line that neighbouring vertices share.
        own_var: (B, L, V) label px², variance across the line of each vertex alone.
    """

    points: Tensor
    normal: Tensor
    weight: Tensor
    density: Tensor
    common_var: Tensor
    own_var: Tensor


def representative_vertices(vertices: Vertices, config: LineConfig) -> Vertices:
    """Average vertices over stretches of equally many: at most 2S on a boundary, in order along it.

    The mean of points on a parabola is off it by half of its mean distance from their tangents; it is moved
    back by that. A boundary of n < 2S vertices keeps 2·floor(n/2) of them unchanged.
    """
    points, normal = vertices.points.mT, vertices.normal.mT  # (B, L, 2, V)
    stretch, middle, size = stretches(vertices, config)
    together = (vertices.weight > 0) & _averaged_with_middle(points.detach(), normal.detach(), middle, size)
    density = vertices.density * together
    share = density * vertices.weight
    alone = torch.stack([density, share, share * vertices.common_var, share.square() * vertices.own_var], -2)
    sums = _sums(
        torch.cat([alone, share.unsqueeze(-2) * torch.cat([points, normal], -2)], -2), stretch, config
    )  # (B, L, 8, 2S)
    counted, mass, common, own = sums[:, :, :4].unbind(-2)
    safe = mass.clamp(min=1e-6)  # weights of a mean
    mean, across = (sums[:, :, 4:] / safe.unsqueeze(-2)).split(2, -2)  # (B, L, 2, 2S)
    off_tangent = ((_take_columns(mean, stretch) - points) * normal).sum(-2)  # (B, L, V) px
    moved = _sums((share * off_tangent).unsqueeze(-2) * normal, stretch, config)
    mean = mean - 0.5 * moved / safe.unsqueeze(-2)
    common_var, own_var = common / safe + config.sigma_floor**2, own / safe.square()
    sure = mass / counted.clamp(min=1e-6) * _variance_weight(common_var + own_var, counted > 0)
    return Vertices(mean.mT, across.mT, sure, counted, common_var, own_var)


def _sums(values: Tensor, stretch: Tensor, config: LineConfig) -> Tensor:
    """Sum values (B, L, K, V) over the vertices of each stretch, (B, L, K, 2S)."""
    index = stretch.unsqueeze(-2).expand_as(values)
    return values.new_zeros(*values.shape[:-1], 2 * config.segments).scatter_add_(-1, index, values)


def _take_columns(values: Tensor, index: Tensor) -> Tensor:
    """Gather (B, L, K, S) at indices (B, L, V), (B, L, K, V)."""
    return values.gather(-1, index.unsqueeze(-2).expand(-1, -1, values.shape[-2], -1))


def stretches(vertices: Vertices, config: LineConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Divide each boundary, along its main direction, into stretches of equally many seen vertices.

    Returns:
        the stretch of each vertex, 0..2S-1; the index of the middle vertex of that stretch; the number of
        vertices in it: each (B, L, V) int64. A boundary with too few vertices is one stretch; the values for
        unseen vertices are arbitrary.
    """
    count = (vertices.weight > 0).sum(-1, keepdim=True)  # (B, L, 1)
    bins, total = 2 * _half_of(count, config), count.clamp(min=1)
    order, rank = order_along(vertices.points.detach(), vertices.weight.detach())
    last_one = 2 * config.segments - 1
    stretch = (rank * bins).div(total, rounding_mode="floor").clamp(max=last_one)
    number = torch.arange(last_one + 2, device=rank.device)
    some = bins.clamp(min=1)
    begin = (number * total + some - 1).div(some, rounding_mode="floor")  # (B, L, 2S + 1) ranks
    sizes = begin.diff()  # of ranks r with floor(r · bins / total) = number
    middles = (begin[..., 1:] - 1 - sizes.div(2, rounding_mode="floor")).clamp(0, order.shape[-1] - 1)
    return stretch, order.gather(-1, middles).gather(-1, stretch), sizes.gather(-1, stretch)


def _variance_weight(variance: Tensor, there: Tensor) -> Tensor:
    """Weigh vertices (B, L, 2S) by their variance and the median variance of their boundary.

    On a clear map a vertex has a large variance only where there is no line: at its end, at a notch, on a
    bend of a few px. On an unclear map many have; there the limit grows with the median variance.
    """
    typical = masked_median(variance, there).unsqueeze(-1)
    limit = _LARGEST_SIGMA * (typical / _CLEAN_SIGMA**2).clamp(min=1.0)
    return (3.0 - 2.0 * variance.sqrt() / limit).clamp(0, 1)


def _averaged_with_middle(points: Tensor, normal: Tensor, middle: Tensor, size: Tensor) -> Tensor:
    """Return which vertices may be averaged with the middle one of their stretch, (B, L, V).

    These are not those across a gap (farther away than so many scans reach, two for dropped scans), nor
    those on another arm of a boundary that turns back: a chord of a circle makes equal angles with the
    tangents at its ends.

    Args:
        points: (B, L, 2, V).
        normal: (B, L, 2, V).
        middle: (B, L, V), see :func:`stretches`.
        size: (B, L, V).
    """
    centre, other = _take_columns(torch.cat([points, normal], -2), middle).split(2, -2)
    chord = points - centre
    facing = torch.where((normal * other).sum(-2, keepdim=True) < 0, -normal, normal)
    off = 0.5 * ((facing + other) * chord).sum(-2).abs()
    near = chord.square().sum(-2) < (1.5 * size + 2).square()
    kept: Tensor = near & (off < _CIRCLE_TOLERANCE)
    return kept


def _half_of(count: Tensor, config: LineConfig) -> Tensor:
    """Return the number of pairs of a boundary with so many vertices."""
    half = (count // 2).clamp(max=config.segments)
    return torch.where(count >= config.min_vertices, half, 0)


def order_along(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Sort vertices along their boundary's main direction, unseen ones last; return them and the ranks.

    Args:
        points: (B, L, V, 2).
        weight: (B, L, V).

    Returns:
        indices and ranks, each (B, L, V) int64.
    """
    total = weight.sum(-1, keepdim=True).clamp(min=1e-6)
    x, y = (part - (part * weight).sum(-1, keepdim=True) / total for part in points.unbind(-1))
    xy = (weight * x * y).sum(-1)
    difference = (weight * (x + y) * (x - y)).sum(-1)  # of xx and yy
    angle = 0.5 * torch.atan2(2 * xy, difference).unsqueeze(-1)
    along = x * angle.cos() + y * angle.sin()
    order = torch.where(weight > 0, along, math.inf).argsort(dim=-1)
    rank = torch.arange(order.shape[-1], device=order.device).expand_as(order)
    # ties: vertices that coincide, or are not seen
    return order, torch.zeros_like(order).scatter(-1, order, rank)


def take(points: Tensor, index: Tensor) -> Tensor:
    """Gather (B, L, V, 2) at indices (B, L, S), (B, L, S, 2)."""
    return points.gather(2, index.unsqueeze(-1).expand(*index.shape, 2))
