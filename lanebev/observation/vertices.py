"""Probability maps to vertices: where rows and columns cross each boundary.

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

_FLOOR = 0.01  # probability that background noise has everywhere; counts as nothing
_PEAK = 2  # half-width of the box whose largest sum is a scan's peak, label px
_END = 3  # scans at either end of a stripe that its round cap makes crooked
_FADE = 0.2  # of a stripe's mass, over which a scan's weight goes to zero below ``twice``
_TOGETHER = 3.0  # px off a circle through two vertices, at and above which they are not averaged
_SURE = 0.03  # px, sigma up to which the median vertex of a boundary is that of a clean map
_UNSURE = 0.12  # px, sigma of a clean map's vertex above which it counts less, and at 3/2 of which not at all
_NEIGHBOURS = 5  # scans on either side that decide a vertex' direction and scatter


@dataclass(frozen=True)
class LineConfig:
    """How lines are read off the maps.

    Attributes:
        stride: px of the network's input per label px.
        half_width: of the stripes that the network learned, across the line, label px.
        segments: per boundary, S.
        window: half-width of the window about a scan's peak, label px.
        absent, present: share of a stripe's mass at and below which a scan has no boundary, and at and above
            which it has one for sure.
        twice: share at and above which the scan crosses the boundary more than once, as where it turns back
            at the horizon, and says nothing; it says less from ``_FADE`` below.
        min_vertices: a boundary with fewer is not seen.
        sigma_floor: least standard deviation of a vertex, label px: what correlates along the line.
        sigma_scale: of all standard deviations; 1 where the maps are true.
        correlation: px of the image, vertically, over which a line's errors are one error: vertices nearer
            together than this say no more than so many farther apart; 0 where the maps are true.
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
        if not 0 <= self.absent < self.present:
            raise ValueError(f"present: expected more than absent ({self.absent}), got {self.present}")
        if not self.present < self.twice:
            raise ValueError(f"twice: expected more than present ({self.present}), got {self.twice}")


class Vertices(NamedTuple):
    """Points on boundaries, padded.

    Attributes:
        points: (B, L, V, 2) (x, y) label px.
        normal: (B, L, V, 2) unit vectors across the line, of either sign.
        weight: (B, L, V) in [0, 1], how sure it is that the boundary is there.
        density: (B, L, V) in [0, 1], what it counts for in a mean: about 45 degrees, rows and columns share.
        common_var: (B, L, V) label px², across the line: what neighbouring vertices share.
        own_var: (B, L, V) label px², across the line: each vertex' own.
    """

    points: Tensor
    normal: Tensor
    weight: Tensor
    density: Tensor
    common_var: Tensor
    own_var: Tensor


def scan_vertices(probabilities: Tensor, config: LineConfig) -> Vertices:
    """Where each row and each column crosses each boundary, V = h + w.

    Rows count where a boundary is steep and columns where it is shallow, with a blend about 45 degrees.
    """
    by_row = _scan(probabilities, config)
    by_column = _scan(probabilities.mT, config)
    by_column = by_column._replace(points=by_column.points.flip(-1), normal=by_column.normal.flip(-1))
    return Vertices(*(torch.cat(pair, dim=2) for pair in zip(by_row, by_column, strict=True)))


def _scan(probabilities: Tensor, config: LineConfig) -> Vertices:
    """One vertex a row: (B, L, h, w) to V = h."""
    position, mass, spread = row_moments(probabilities, config.window)
    width = probabilities.shape[-1]
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
    """Least weight within _END scans, (..., h): nothing at the ends of a stripe and of the map."""
    padded = F.pad(weight.flatten(0, -2), (_END, _END)).unsqueeze(1)  # (M, 1, h), where M may be 0
    least: Tensor = F.max_pool1d(-padded, 2 * _END + 1, 1).view_as(weight)
    return -least


def _local_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean over _NEIGHBOURS scans on either side, (..., h); 0 where nothing has weight."""
    both = torch.stack([values * weight, weight]).flatten(0, -2).unsqueeze(1)
    pooled: Tensor = F.avg_pool1d(both, 2 * _NEIGHBOURS + 1, 1, _NEIGHBOURS)
    total, mass = pooled.view(2, *values.shape).unbind()
    return total / mass.clamp(min=1e-3)


def row_moments(probabilities: Tensor, window: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean position, mass and variance of each row's probability about its peak.

    The window is put about the peak, then about the mean within it; where it lies is a constant to the
    gradient.

    Args:
        probabilities: (..., h, w).
        window: half-width, px.

    Returns:
        position px, mass px, variance px²: each (..., h). Position of an empty row is its window's centre.
    """
    counted = (probabilities - _FLOOR).clamp(min=0) / (1 - _FLOOR)
    boxes = F.avg_pool1d(counted.flatten(0, -2).detach().unsqueeze(1), 2 * _PEAK + 1, 1, _PEAK).squeeze(1)
    peak = boxes.argmax(-1).reshape(counted.shape[:-1]).to(counted.dtype)  # (..., h)
    for _ in range(2):
        centre = peak.detach().round()
        peak, mass, variance = _windowed(counted, centre, window)
    return peak, mass, variance


def _windowed(counted: Tensor, centre: Tensor, window: int) -> tuple[Tensor, Tensor, Tensor]:
    """Moments of (..., h, w) rows within ``window`` of (..., h) centres."""
    offset = torch.arange(-window, window + 1, device=counted.device)
    column = centre.long().unsqueeze(-1) + offset  # (..., h, 2·window + 1)
    inside = (column >= 0) & (column < counted.shape[-1])
    values = counted.gather(-1, column.clamp(0, counted.shape[-1] - 1)) * inside
    mass = values.sum(-1)
    safe = mass.clamp(min=1e-3)
    step = offset.to(counted.dtype)
    mean = (values * step).sum(-1) / safe
    variance = (values * (step - mean.unsqueeze(-1)).square()).sum(-1) / safe
    return centre + mean, mass, variance


def local_line(position: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Line through each row's neighbours: slope in px a row, and the variance of a row about it.

    Args:
        position: (..., h).
        weight: (..., h).

    Returns:
        slope and variance, each (..., h). Fewer than three rows have slope 0 and variance 1.
    """
    rows = torch.arange(position.shape[-1], dtype=position.dtype, device=position.device)
    # moments about the row itself: sums of weight · r^a · (x - x_row)^b over r = -5..5
    index = rows.long().unsqueeze(-1) + torch.arange(-_NEIGHBOURS, _NEIGHBOURS + 1, device=position.device)
    inside = (index >= 0) & (index < len(rows))
    index = index.clamp(0, len(rows) - 1)
    w = weight[..., index] * inside  # (..., h, 11)
    x = position[..., index] - position.unsqueeze(-1)
    r = torch.arange(-_NEIGHBOURS, _NEIGHBOURS + 1, dtype=position.dtype, device=position.device)
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
    """At most 2S vertices a boundary, in order along it: means over stretches of equally many vertices.

    The mean of points on a parabola lies off it by half of what it lies off their tangents, on average: by
    that it is moved back. A boundary of n < 2S vertices keeps 2·floor(n/2) of them as they are.
    """
    points, weight = vertices.points, vertices.weight
    seen = weight > 0
    count = seen.sum(-1)
    bins = 2 * _half_of(count, config)
    rank = _rank_along(points.detach(), weight.detach())  # (B, L, V)
    total = count.clamp(min=1).unsqueeze(-1)
    slot = (rank * bins.unsqueeze(-1)).div(total, rounding_mode="floor")
    slots = torch.arange(2 * config.segments, device=points.device)
    member = (slot.unsqueeze(-1) == slots) & seen.unsqueeze(-1)  # (B, L, V, 2S)
    member = member & _with_the_middle(vertices, rank, member)
    density = member * vertices.density.unsqueeze(-1)
    share = density * weight.unsqueeze(-1)
    mass, counted = share.sum(2), density.sum(2)
    share = share / mass.clamp(min=1e-6).unsqueeze(2)  # weights of a mean
    mean = torch.einsum("blvs,blvd->blsd", share, points)
    normal = vertices.normal
    away = mean.unsqueeze(2) - points.unsqueeze(3)  # (B, L, V, 2S, 2)
    along = away @ normal.unsqueeze(-1)  # (B, L, V, 2S, 1) px off tangents
    mean = mean - 0.5 * torch.einsum("blvs,blvd->blsd", share * along.squeeze(-1), normal)
    common = torch.einsum("blvs,blv->bls", share, vertices.common_var)
    own = torch.einsum("blvs,blv->bls", share.square(), vertices.own_var)
    across = torch.einsum("blvs,blvd->blsd", share, normal)
    common = common + config.sigma_floor**2
    sure = mass / counted.clamp(min=1e-6) * _as_sure_as_most(common + own, counted > 0)
    return Vertices(mean, across, sure, counted, common, own)


def _as_sure_as_most(variance: Tensor, there: Tensor) -> Tensor:
    """Weight (B, L, 2S) of vertices by their variance and the median variance of their boundary.

    On a clean map an unsure vertex is where there is no line: at its end, at a nick, on a bend of a few px.
    A map that hedges has unsure ones anyway: there the limit grows as the median variance does.
    """
    typical = masked_median(variance, there).unsqueeze(-1)
    limit = _UNSURE * (typical / _SURE**2).clamp(min=1.0)
    return (3.0 - 2.0 * variance.sqrt() / limit).clamp(0, 1)


def _with_the_middle(vertices: Vertices, rank: Tensor, member: Tensor) -> Tensor:
    """Which vertices may be averaged with the middle one of each stretch, (B, L, V, 2S).

    Not those across a gap, further away than so many scans reach (two for scans that were dropped), nor
    those of another arm of a boundary that turns back: a chord of a circle makes equal angles with the
    tangents at its ends.
    """
    points, normal = vertices.points.detach(), vertices.normal.detach()
    ranks = torch.where(member, rank.unsqueeze(-1), -1)
    size = member.sum(2)  # (B, L, 2S)
    central = ranks.amax(2) - size.div(2, rounding_mode="floor")
    middle = (ranks == central.unsqueeze(2)).to(torch.uint8).argmax(2)
    chord = points.unsqueeze(3) - take(points, middle).unsqueeze(2)  # (B, L, V, 2S, 2)
    other = take(normal, middle).unsqueeze(2)
    normal = normal.unsqueeze(3)
    facing = torch.where((normal * other).sum(-1, keepdim=True) < 0, -normal, normal)
    off = 0.5 * ((facing + other) * chord).sum(-1).abs()
    near: Tensor = chord.norm(dim=-1) < 1.5 * size.unsqueeze(2) + 2
    return near & (off < _TOGETHER)


def _half_of(count: Tensor, config: LineConfig) -> Tensor:
    """Number of pairs of a boundary with so many vertices."""
    half = (count // 2).clamp(max=config.segments)
    return torch.where(count >= config.min_vertices, half, 0)


def _rank_along(points: Tensor, weight: Tensor) -> Tensor:
    """Place of each vertex in the order along its boundary's main direction; those not seen come last."""
    total = weight.sum(-1, keepdim=True).clamp(min=1e-6)
    mean = (points * weight.unsqueeze(-1)).sum(-2, keepdim=True) / total.unsqueeze(-1)
    x, y = (points - mean).unbind(-1)
    xx, yy, xy = (weight * x * x).sum(-1), (weight * y * y).sum(-1), (weight * x * y).sum(-1)
    angle = 0.5 * torch.atan2(2 * xy, xx - yy).unsqueeze(-1)
    along = x * angle.cos() + y * angle.sin()
    along = torch.where(weight > 0, along, math.inf)
    return along.argsort(dim=-1).argsort(dim=-1)  # ties: vertices that coincide, or are not seen


def take(points: Tensor, index: Tensor) -> Tensor:
    """(B, L, V, 2) at (B, L, S) to (B, L, S, 2)."""
    return points.gather(2, index.unsqueeze(-1).expand(*index.shape, 2))
