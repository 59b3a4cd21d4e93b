"""Scan probability maps: where rows and columns cross each boundary.

Label pixels are cells of the map. Everything is differentiable in the probabilities. A scan is a row or a
column; all are computed together, rows first, then ``GAP`` empty ones, then columns, so that the last row
and the first column are not neighbours. Tensors over scans have their number, h + GAP + w, last.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lanebev.observation.vertices import LineConfig, Vertices

GAP = 5  # scans, at least as many as the neighbours of one
_NEIGHBOURS = 5  # scans on either side that decide a vertex' direction and scatter
_END = 3  # scans at either end of a stripe that its round cap makes crooked
_FLOOR = 0.01  # probability of background noise, which counts as 0
_LEAST_MASS = 1e-3  # px, what is divided by of an empty window
_PEAK = 2  # half-width of the box whose largest sum is a scan's peak, label px
_TINY = 1e-30  # times the number of cells it is less than any difference of two sums
_FADE = 0.2  # fraction of a stripe's mass below ``max_mass`` in which a scan's weight falls to zero


class Scans(NamedTuple):
    """Place of each scan in the flat map with ``padding`` empty cells on each side, each (V,) int64.

    Cell n of a scan is the flat map's cell ``start`` + n · ``step``; those of the empty scans are a corner.

    Attributes:
        start: index of the scan's first cell.
        step: from a cell to the next one.
        last: number of cells less one.
        number: of the row or column.
    """

    start: Tensor
    step: Tensor
    last: Tensor
    number: Tensor


def make_scans(rows: int, columns: int, padding: int, device: torch.device) -> Scans:
    """Make the scans of a map of so many rows and columns."""
    stride = columns + 2 * padding
    first = padding * (stride + 1)  # cell (0, 0) of the map
    row, column = torch.arange(rows, device=device), torch.arange(columns, device=device)
    none = torch.zeros(GAP, dtype=torch.int64, device=device)
    return Scans(
        torch.cat([first + stride * row, none, first + column]),
        torch.cat([torch.ones_like(row), none, torch.full_like(column, stride)]),
        torch.cat([torch.full_like(row, columns - 1), none, torch.full_like(column, rows - 1)]),
        torch.cat([row, none, column]),
    )


def scan_vertices(probabilities: Tensor, config: LineConfig) -> Vertices:
    """Find where each row and each column crosses each boundary, V = h + GAP + w.

    Rows count where a boundary is steep and columns where it is shallow, with a blend about 45 degrees.

    Args:
        probabilities: (B, L, h, w).
        config: configuration of the extraction.
    """
    padding = max(config.window, _PEAK)
    rows, columns = probabilities.shape[-2:]
    scans = make_scans(rows, columns, padding, probabilities.device)
    position, mass, spread = scan_moments(counted_probability(probabilities, padding), config.window, scans)
    whole = 2 * config.half_width  # px, mass of a stripe across the scan
    least, full, most = (part * whole for part in (config.min_mass, config.full_mass, config.max_mass))
    step = _ramp(mass, least, full)
    slope, scatter = local_line(position, step)
    cos2 = 1 / (1 + slope.square())  # squared cosine of the angle between the line and the normal of the scan
    cos = cos2.sqrt()
    across = mass * cos
    weight = _eroded(_ramp(across, least, full) * _ramp(across, most, most - _FADE * whole))
    steep = _ramp(cos2, 0.4, 0.6)  # 1 below 39 degrees, 0 above 51
    reach = config.half_width / cos + 1.0  # half of the stripe's width in its scan
    inside = (position >= reach) & (position + reach <= scans.last) & (steep > 0)
    stripe = config.half_width**2 / 3 + 1 / 12  # variance across a uniform stripe drawn in pixels
    excess = _local_mean(spread * cos2 - stripe, step).clamp(min=0)  # one scan depends on the pixel phase
    return Vertices(
        points=_as_xy(position, scans.number.to(position), scans),
        normal=_as_xy(cos, -slope * cos, scans),
        weight=torch.where(inside, weight, 0.0),
        density=steep,
        common_var=excess,
        own_var=scatter * cos2,
    )


def _as_xy(along: Tensor, across: Tensor, scans: Scans) -> Tensor:
    """Return (..., V, 2) coordinates (x, y) of coordinates along scans and across them, (..., V).

    In memory x and y are apart, which makes sums over them fast.
    """
    row = scans.step == 1
    return torch.stack([torch.where(row, along, across), torch.where(row, across, along)], dim=-2).mT


def _ramp(values: Tensor, zero: float, one: float) -> Tensor:
    """Return 0 up to ``zero``, 1 from ``one`` on and linear between; ``zero`` may be the larger one."""
    return ((values - zero) / (one - zero)).clamp(0, 1)


def _eroded(weight: Tensor) -> Tensor:
    """Compute the least weight within _END scans, (..., V): zero at the ends of a stripe and of the map."""
    padded = F.pad(weight.flatten(0, -2), (_END, _END)).unsqueeze(1)  # (M, 1, V), where M may be 0
    least: Tensor = F.max_pool1d(-padded, 2 * _END + 1, 1).view_as(weight)
    return -least


def _local_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Compute the weighted mean over _NEIGHBOURS scans on either side, (..., V); 0 without any weight."""
    total, mass = _neighbours(torch.stack([values * weight, weight])).sum(-2).unbind()
    return total / mass.clamp(min=1e-2)


def _neighbours(values: Tensor) -> Tensor:
    """Return the values (..., V) of each scan and its _NEIGHBOURS on either side, (..., 11, V)."""
    padded = F.pad(values, (_NEIGHBOURS, _NEIGHBOURS))
    return padded.unfold(-1, 2 * _NEIGHBOURS + 1, 1).mT.contiguous()  # sums over neighbours are vectorised


def counted_probability(probabilities: Tensor, padding: int) -> Tensor:
    """Remove the probability that background noise has everywhere; what is certain still counts 1.

    Args:
        probabilities: (..., h, w).
        padding: empty cells to add on each side.
    """
    return F.pad(probabilities, (padding,) * 4).sub_(_FLOOR).clamp_(min=0).div_(1 - _FLOOR)


def scan_moments(padded: Tensor, window: int, scans: Scans) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the mean position, mass and variance of each scan's probability about its peak.

    The window is centred on the peak, then on the mean within it; gradients take its position as constant.

    Args:
        padded: (..., h, w), see :func:`counted_probability`, padded by ``window`` cells and _PEAK at least.
        window: half-width, px.
        scans: of the map.

    Returns:
        position px, mass px, variance px² along the scan: each (..., V). Position of an empty scan is its
        window's centre.
    """
    padding = max(window, _PEAK)
    fixed = padded.detach()
    by_row, by_column = (box_peak(fixed, padding, dim) for dim in (-1, -2))
    centre = torch.cat([by_row, by_row.new_zeros(*by_row.shape[:-1], GAP), by_column], dim=-1)
    offset = torch.arange(-window, window + 1, device=padded.device).unsqueeze(-1)  # (2·window + 1, 1)
    step = offset.to(padded.dtype)
    values = _about(fixed, centre, offset, scans)
    first, _ = _mean(values, step)
    centre = (centre + first).round().long().clamp(min=0).minimum(scans.last)  # a NaN may become any number
    values = _about(padded, centre, offset, scans)
    mean, mass = _mean(values, step)
    variance = (values * (step - mean.unsqueeze(-2)).square()).sum(-2) / mass.clamp(min=_LEAST_MASS)
    return centre + mean, mass, variance


def box_peak(padded: Tensor, padding: int, dim: int) -> Tensor:
    """Find where the sum over _PEAK neighbours on either side is largest.

    Args:
        padded: (..., h, w) with ``padding`` empty cells, _PEAK at least, on each side.
        padding: cells.
        dim: -1 to scan rows, -2 to scan columns.

    Returns:
        (..., h) of rows or (..., w) of columns, int64, counted without the padding.
    """
    size, other = padded.shape[dim] - 2 * padding, -3 - dim
    lines = padded.narrow(other, padding, padded.shape[other] - 2 * padding)
    first = padding - _PEAK
    total = lines.narrow(dim, first, size) + lines.narrow(dim, first + 1, size)
    for start in range(first + 2, padding + _PEAK + 1):
        total += lines.narrow(dim, start, size)
    return first_maximum_(total, dim)


def first_maximum_(values: Tensor, dim: int) -> Tensor:
    """Find the first of the largest values along a dimension, and overwrite all values.

    ``values.max(dim).indices`` takes three times as long, since it is not vectorised on CPUs.

    Args:
        values: (..., h, w), either equal or further apart than h · _TINY and w · _TINY.
        dim: -1 or -2.

    Returns:
        (..., h) or (..., w), int64.
    """
    size = values.shape[dim]
    index = torch.arange(size, dtype=values.dtype, device=values.device) * _TINY
    below = values.sub_(values.amax(dim, keepdim=True))  # 0 at the largest values
    most = below.sub_(index.view((-1,) + (1,) * (-1 - dim))).amax(dim)  # -index · _TINY of the first of them
    return (most / -_TINY).round().long().clamp(0, size - 1)  # clamp: NaN has no index


def _about(padded: Tensor, centre: Tensor, offset: Tensor, scans: Scans) -> Tensor:
    """Return the values (..., 2·window + 1, V) at offsets from the scans' centres (..., V), px."""
    cells = (scans.start + scans.step * centre).unsqueeze(-2) + scans.step * offset
    return padded.flatten(-2).gather(-1, cells.flatten(-2)).view(cells.shape)


def _mean(values: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the mean offset and mass of windows (..., 2·window + 1, V); an empty one has mean 0."""
    mass = values.sum(-2)
    return (values * step).sum(-2) / mass.clamp(min=_LEAST_MASS), mass


def local_line(position: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fit a line to each scan's neighbours: slope in px per scan, and the variance of a scan about it.

    Args:
        position: (..., V).
        weight: (..., V).

    Returns:
        slope and variance, each (..., V). Fewer than three scans have slope 0 and variance 1.
    """
    w, x = _neighbours(weight), _neighbours(position) - position.unsqueeze(-2)
    # moments about the scan itself: sums of weight · r^a · (x - x_scan)^b over r = -5..5
    r = torch.arange(-_NEIGHBOURS, _NEIGHBOURS + 1, dtype=x.dtype, device=x.device).unsqueeze(-1)
    total = w.sum(-2)
    enough = total > 2.5
    safe = total.clamp(min=2.5)
    mean_r, mean_x = (w * r).sum(-2) / safe, (w * x).sum(-2) / safe
    dr, dx = r - mean_r.unsqueeze(-2), x - mean_x.unsqueeze(-2)
    weighted = w * dr
    var_r, cov = (weighted * dr).sum(-2), (weighted * dx).sum(-2)
    slope = torch.where(enough, cov / var_r.clamp(min=1e-3), 0.0)
    residual = dx - slope.unsqueeze(-2) * dr
    variance = (w * residual.square()).sum(-2) / (total - 2).clamp(min=0.5)
    return slope, torch.where(enough, variance, 1.0)
