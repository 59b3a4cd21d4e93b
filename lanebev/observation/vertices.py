"""Extract vertices from probability maps: where rows and columns cross each boundary.

Label pixels are cells of the map. Everything is differentiable in the probabilities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lanebev.batch import masked_median

_FLOOR = 0.01  # probability of background noise, which counts as 0
_LEAST_MASS = 1e-3  # px, what is divided by of an empty window
_PEAK = 2  # half-width of the box whose largest sum is a scan's peak, label px
_END = 3  # scans at either end of a stripe that its round cap makes crooked
_FADE = 0.2  # of a stripe's mass, over which a scan's weight goes to zero below ``twice``
_TOGETHER = 3.0  # px off a circle through two vertices, at and above which they are not averaged
_SURE = 0.03  # px, sigma up to which the median vertex of a boundary is that of a clean map
_UNSURE = 0.12  # px, sigma of a clean map's vertex above which it counts less, and at 3/2 of which not at all
_NEIGHBOURS = 5  # scans on either side that decide a vertex' direction and scatter


@dataclass(frozen=True)
class LineConfig:
    """Numbers of the line extraction.

    Attributes:
        stride: px of the network's input per label px.
        half_width: half width of the stripes that the network learned, across the line, label px.
        segments: per boundary, S.
        window: half-width of the window about a scan's peak, label px.
        absent, present: fractions of a stripe's mass up to which a scan has no boundary, and from which it
            surely has one.
        twice: fraction from which the scan crosses the boundary more than once, as where it turns back at the
            horizon, and is not used; its weight decreases from ``_FADE`` below.
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
    absent: float = 0.2
    present: float = 0.6
    twice: float = 1.4
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
        if not 0 <= self.absent < self.present:
            raise ValueError(f"present: expected more than absent ({self.absent}), got {self.present}")
        if not self.present < self.twice:
            raise ValueError(f"twice: expected more than present ({self.present}), got {self.twice}")


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


def scan_vertices(probabilities: Tensor, config: LineConfig) -> Vertices:
    """Find where each row and each column crosses each boundary, V = h + w.

    Rows count where a boundary is steep and columns where it is shallow, with a blend about 45 degrees.
    """
    counted = counted_probability(probabilities)
    by_row, by_column = (_scan(counted, config, dim) for dim in (-1, -2))
    by_column = by_column._replace(points=by_column.points.flip(-1), normal=by_column.normal.flip(-1))
    return Vertices(*(torch.cat(pair, dim=2) for pair in zip(by_row, by_column, strict=True)))


def _scan(counted: Tensor, config: LineConfig, dim: int) -> Vertices:
    """Find one vertex a row, V = h, by ``dim`` -1 of (B, L, h, w), or one a column, V = w, by ``dim`` -2.

    Points and normals are (along the scan, across scans): (x, y) of rows and (y, x) of columns.
    """
    position, mass, spread = scan_moments(counted, config.window, dim)
    width = counted.shape[dim]
    share = mass / (2 * config.half_width)
    step = ((share - config.absent) / (config.present - config.absent)).clamp(0, 1)
    slope, scatter = local_line(position, step)
    cos2 = 1 / (1 + slope.square())  # of the angle between line and vertical
    cos = cos2.sqrt()
    weight = ((share * cos - config.absent) / (config.present - config.absent)).clamp(0, 1)
    weight = weight * ((config.twice - share * cos) / _FADE).clamp(0, 1)
    weight = _eroded(weight)
    steep = (2.5 * (2 * cos2 - 1) + 0.5).clamp(0, 1)  # 1 below 39 degrees, 0 above 51
    reach = config.half_width / cos + 1.0  # of the stripe's band in its row
    inside = (position - reach >= 0) & (position + reach <= width - 1)
    weight = torch.where(inside & (steep > 0), weight, 0.0)
    stripe = config.half_width**2 / 3 + 1 / 12  # variance across a uniform stripe drawn in pixels
    excess = _local_mean(spread * cos2 - stripe, step).clamp(min=0)  # of one scan it depends on pixel phase
    rows = torch.arange(position.shape[-1], dtype=position.dtype, device=position.device)
    points = torch.stack([position, rows.expand_as(position)], dim=-1)
    normal = torch.stack([torch.ones_like(slope), -slope], dim=-1) * cos.unsqueeze(-1)
    return Vertices(points, normal, weight, steep, excess, scatter * cos2)


def _eroded(weight: Tensor) -> Tensor:
    """Compute the least weight within _END scans, (..., h): zero at the ends of a stripe and of the map."""
    padded = F.pad(weight.flatten(0, -2), (_END, _END)).unsqueeze(1)  # (M, 1, h), where M may be 0
    least: Tensor = F.max_pool1d(-padded, 2 * _END + 1, 1).view_as(weight)
    return -least


def _local_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Compute the weighted mean over _NEIGHBOURS scans on either side, (..., h); 0 without any weight."""
    both = torch.stack([values * weight, weight]).flatten(0, -2).unsqueeze(1)
    pooled: Tensor = F.avg_pool1d(both, 2 * _NEIGHBOURS + 1, 1, _NEIGHBOURS)
    total, mass = pooled.view(2, *values.shape).unbind()
    return total / mass.clamp(min=1e-3)


def row_moments(probabilities: Tensor, window: int) -> tuple[Tensor, Tensor, Tensor]:
    """Compute mean position, mass and variance of each row about its peak, see :func:`scan_moments`.

    Args:
        probabilities: (..., h, w).
        window: half-width, px.

    Returns:
        position px, mass px, variance px²: each (..., h).
    """
    return scan_moments(counted_probability(probabilities), window, -1)


def counted_probability(probabilities: Tensor) -> Tensor:
    """Remove the probability that background noise has everywhere; what is certain still counts 1."""
    return (probabilities - _FLOOR).clamp(min=0) / (1 - _FLOOR)


def scan_moments(counted: Tensor, window: int, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the mean position, mass and variance of each scan's probability about its peak.

    The window is centred on the peak, then on the mean within it; gradients take its position as constant.

    Args:
        counted: (..., h, w), see :func:`counted_probability`.
        window: half-width, px.
        dim: -1 to scan rows, -2 to scan columns.

    Returns:
        position px, mass px, variance px² along the scan: each (..., h) of rows or (..., w) of columns.
        Position of an empty scan is its window's centre.
    """
    reach, last = max(window, _PEAK), counted.shape[dim] - 1
    padded = F.pad(counted, (reach, reach) if dim == -1 else (0, 0, reach, reach))
    centre = box_peak(padded.detach(), reach, dim)
    values, step = _about(padded, centre + reach, window, dim)
    first, _ = _mean(values, step, dim)
    centre = (centre + first.detach()).round().long().clamp(0, last)  # clamp: of NaN anything may come
    values, step = _about(padded, centre + reach, window, dim)
    mean, mass = _mean(values, step, dim)
    variance = (values * (step - mean.unsqueeze(dim)).square()).sum(dim) / mass.clamp(min=_LEAST_MASS)
    return centre + mean, mass, variance


def box_peak(padded: Tensor, padding: int, dim: int) -> Tensor:
    """Find where the sum over _PEAK neighbours on either side is largest.

    Args:
        padded: (..., h, w) with ``padding`` empty cells, _PEAK at least, at both ends of ``dim``.
        padding: cells.
        dim: -1 to scan rows, -2 to scan columns.

    Returns:
        (..., h) of rows or (..., w) of columns, int64, counted without the padding.
    """
    size = padded.shape[dim] - 2 * padding
    first = padding - _PEAK
    total = padded.narrow(dim, first, size) + padded.narrow(dim, first + 1, size)
    for start in range(first + 2, padding + _PEAK + 1):
        total += padded.narrow(dim, start, size)
    return total.max(dim).indices


def _about(padded: Tensor, centre: Tensor, window: int, dim: int) -> tuple[Tensor, Tensor]:
    """Return values within ``window`` of the scans' centres, 2·window + 1 along ``dim``, and offsets, px."""
    offset = torch.arange(-window, window + 1, device=padded.device).view((-1,) + (1,) * (-1 - dim))
    return padded.gather(dim, centre.unsqueeze(dim) + offset), offset.to(padded.dtype)


def _mean(values: Tensor, step: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Compute the mean offset and mass of windows; an empty one has mean 0."""
    mass = values.sum(dim)
    return (values * step).sum(dim) / mass.clamp(min=_LEAST_MASS), mass


def local_line(position: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fit a line to each row's neighbours: slope in px per row, and the variance of a row about it.

    Args:
        position: (..., h).
        weight: (..., h).

    Returns:
        slope and variance, each (..., h). Fewer than three rows have slope 0 and variance 1.
    """
    reach, count = _NEIGHBOURS, 2 * _NEIGHBOURS + 1
    # moments about the row itself: sums of weight · r^a · (x - x_row)^b over r = -5..5
    w = F.pad(weight, (reach, reach)).unfold(-1, count, 1)  # (..., h, 11)
    x = F.pad(position, (reach, reach)).unfold(-1, count, 1) - position.unsqueeze(-1)
    r = torch.arange(-reach, reach + 1, dtype=position.dtype, device=position.device)
    total = w.sum(-1)
    enough = total > 2.5
    safe = torch.where(enough, total, 1.0)
    mean_r, mean_x = (w * r).sum(-1) / safe, (w * x).sum(-1) / safe
    dr, dx = r - mean_r.unsqueeze(-1), x - mean_x.unsqueeze(-1)
    var_r = (w * dr * dr).sum(-1)
    slope = (w * dr * dx).sum(-1) / torch.where(enough, var_r, 1.0).clamp(min=1e-3)
    slope = torch.where(enough, slope, 0.0)
    residual = dx - slope.unsqueeze(-1) * dr
    freedom = (total - 2).clamp(min=0.5)
    variance = (w * residual.square()).sum(-1) / freedom
    return slope, torch.where(enough, variance, 1.0)


def representative_vertices(vertices: Vertices, config: LineConfig) -> Vertices:
    """Average vertices over stretches of equally many: at most 2S on a boundary, in order along it.

    The mean of points on a parabola is off it by half of its mean distance from their tangents; it is moved
    back by that. A boundary of n < 2S vertices keeps 2·floor(n/2) of them unchanged.
    """
    points, normal, weight = vertices.points, vertices.normal, vertices.weight
    stretch, middle, size = stretches(vertices, config)
    together = (weight > 0) & _with_the_middle(vertices, middle, size)
    slots = torch.arange(2 * config.segments, device=points.device)
    member = (stretch.unsqueeze(-2) == slots.unsqueeze(-1)).to(points.dtype)  # (B, L, 2S, V)
    density = vertices.density * together
    share = (density * weight).unsqueeze(-1)
    common, own = vertices.common_var.unsqueeze(-1), vertices.own_var.unsqueeze(-1)
    terms = [density.unsqueeze(-1), share, share * points, share * normal, share * common, share**2 * own]
    sums = member @ torch.cat(terms, dim=-1)  # (B, L, 2S, 8), over the stretches
    counted, mass = sums[..., 0], sums[..., 1]
    safe = mass.clamp(min=1e-6).unsqueeze(-1)  # of weights of a mean
    mean, across = sums[..., 2:4] / safe, sums[..., 4:6] / safe
    off_tangent = ((take(mean, stretch) - points) * normal).sum(-1, keepdim=True)  # (B, L, V, 1) px
    mean = mean - 0.5 * (member @ (share * off_tangent * normal)) / safe
    common_var = sums[..., 6] / safe[..., 0] + config.sigma_floor**2
    own_var = sums[..., 7] / safe[..., 0].square()
    sure = mass / counted.clamp(min=1e-6) * _as_sure_as_most(common_var + own_var, counted > 0)
    return Vertices(mean, across, sure, counted, common_var, own_var)


def stretches(vertices: Vertices, config: LineConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Divide each boundary, along its main direction, into stretches of equally many seen vertices.

    Returns:
        the stretch of each vertex, 0..2S-1; the index of the middle vertex of that stretch; the number of
        vertices in it: each (B, L, V) int64. A boundary with too few vertices is one stretch; the values for
        unseen vertices are arbitrary.
    """
    count = (vertices.weight > 0).sum(-1, keepdim=True)  # (B, L, 1)
    bins, total = 2 * _half_of(count, config), count.clamp(min=1)
    order, rank = _order_along(vertices.points.detach(), vertices.weight.detach())
    stretch = (rank * bins).div(total, rounding_mode="floor").clamp(max=2 * config.segments - 1)
    some = bins.clamp(min=1)
    first, last = (  # ranks r with floor(r · bins / total) = stretch
        (part * total + some - 1).div(some, rounding_mode="floor") for part in (stretch, stretch + 1)
    )
    size = last - first
    middle = (last - 1 - size.div(2, rounding_mode="floor")).clamp(0, order.shape[-1] - 1)
    return stretch, order.gather(-1, middle), size


def _as_sure_as_most(variance: Tensor, there: Tensor) -> Tensor:
    """Weigh vertices (B, L, 2S) by their variance and the median variance of their boundary.

    On a clear map a vertex has a large variance only where there is no line: at its end, at a notch, on a
    bend of a few px. On an unclear map many have; there the limit grows with the median variance.
    """
    typical = masked_median(variance, there).unsqueeze(-1)
    limit = _UNSURE * (typical / _SURE**2).clamp(min=1.0)
    return (3.0 - 2.0 * variance.sqrt() / limit).clamp(0, 1)


def _with_the_middle(vertices: Vertices, middle: Tensor, size: Tensor) -> Tensor:
    """Return which vertices may be averaged with the middle one of their stretch, (B, L, V).

    These are not those across a gap (farther away than so many scans reach, two for dropped scans), nor
    those on another arm of a boundary that turns back: a chord of a circle makes equal angles with the
    tangents at its ends.
    """
    points, normal = vertices.points.detach(), vertices.normal.detach()
    chord, other = points - take(points, middle), take(normal, middle)  # (B, L, V, 2)
    facing = torch.where((normal * other).sum(-1, keepdim=True) < 0, -normal, normal)
    off = 0.5 * ((facing + other) * chord).sum(-1).abs()
    near: Tensor = chord.norm(dim=-1) < 1.5 * size + 2
    return near & (off < _TOGETHER)


def _half_of(count: Tensor, config: LineConfig) -> Tensor:
    """Number of pairs of a boundary with so many vertices."""
    half = (count // 2).clamp(max=config.segments)
    return torch.where(count >= config.min_vertices, half, 0)


def _order_along(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Sort vertices along their boundary's main direction, unseen ones last; return them and the ranks.

    Args:
        points: (B, L, V, 2).
        weight: (B, L, V).

    Returns:
        indices and ranks, each (B, L, V) int64.
    """
    total = weight.sum(-1, keepdim=True).clamp(min=1e-6)
    mean = (points * weight.unsqueeze(-1)).sum(-2, keepdim=True) / total.unsqueeze(-1)
    x, y = (points - mean).unbind(-1)
    xx, yy, xy = (weight * x * x).sum(-1), (weight * y * y).sum(-1), (weight * x * y).sum(-1)
    angle = 0.5 * torch.atan2(2 * xy, xx - yy).unsqueeze(-1)
    along = x * angle.cos() + y * angle.sin()
    order = torch.where(weight > 0, along, math.inf).argsort(dim=-1)
    return order, order.argsort(dim=-1)  # ties: vertices that coincide, or are not seen


def take(points: Tensor, index: Tensor) -> Tensor:
    """Gather (B, L, V, 2) at indices (B, L, S), (B, L, S, 2)."""
    return points.gather(2, index.unsqueeze(-1).expand(*index.shape, 2))
