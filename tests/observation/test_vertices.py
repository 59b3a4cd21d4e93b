"""The scans and stretches of the extractor against their definitions, written out."""

import pytest
import torch

from lanebev.observation.scans import (
    GAP,
    box_peak,
    counted_probability,
    first_maximum_,
    make_scans,
    scan_moments,
    scan_vertices,
)
from lanebev.observation.vertices import LineConfig, Vertices, representative_vertices, stretches


def maps(seed=0, size=(2, 3, 40, 60)):
    """Noise, a stripe that leaves the map, and nothing at all."""
    values = 0.1 * torch.rand(size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    x = torch.arange(size[-1]).double()
    y = torch.arange(size[-2]).double().unsqueeze(-1)
    values[0, 0] += (1.5 - (x - 70 + 1.2 * y).abs()).clamp(0, 0.9)
    values[1, 1] += (1.5 - (x - 5 - 0.8 * y).abs()).clamp(0, 0.9)
    values[1, 2] = 0.0
    return values


def test_columns_are_rows_of_the_transposed_map():
    counted = counted_probability(maps(), 6)
    straight = scan_moments(counted, 6, make_scans(40, 60, 6, counted.device))
    turned = scan_moments(counted.mT, 6, make_scans(60, 40, 6, counted.device))
    for part, other in zip(straight, turned, strict=True):
        torch.testing.assert_close(part[..., :40], other[..., 60 + GAP :])
        torch.testing.assert_close(part[..., 40 + GAP :], other[..., :60])


def test_moments_are_those_of_the_window_about_the_mean():
    """Cell by cell, windows that reach over the edge included."""
    counted = counted_probability(maps(), 0)
    scans = make_scans(40, 60, 4, counted.device)
    position, mass, variance = scan_moments(counted_probability(maps(), 4), 4, scans)
    for index in ((0, 0, 10), (0, 0, 39), (1, 1, 0), (0, 1, 7), (1, 2, 5)):
        values = counted[index].tolist()
        sums = [sum(values[max(0, i - 2) : i + 3]) for i in range(60)]
        centre = max(range(60), key=sums.__getitem__)
        for _ in range(2):
            window = [i for i in range(60) if abs(i - centre) <= 4]
            total = sum(values[i] for i in window)
            mean = sum(values[i] * (i - centre) for i in window) / max(total, 1e-3)
            last, centre = centre, round(centre + mean)
        spread = sum(values[i] * (i - last - mean) ** 2 for i in window) / max(total, 1e-3)
        expected = torch.tensor([last + mean, total, spread], dtype=torch.float64)
        found = torch.stack([position[index], mass[index], variance[index]])
        torch.testing.assert_close(found, expected)


def test_the_first_of_equal_peaks_is_taken():
    row = torch.zeros(1, 1, 1, 20)
    row[..., 8:10] = 1.0
    padded = torch.nn.functional.pad(row, (6, 6, 6, 6))
    assert box_peak(padded, 6, -1).item() == 7  # of boxes 7 to 10 that hold both
    assert box_peak(padded.mT, 6, -2).item() == 7


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dim", [-1, -2])
def test_first_maximum_is_that_of_max(dtype, dim):
    """Ties, neighbouring numbers of the dtype, zeros, small numbers; of NaN only that it is an index."""
    generator = torch.Generator().manual_seed(0)
    values = torch.randint(0, 4, (50, 30, 40), generator=generator).to(dtype)
    values[:10] = 1.0 + torch.finfo(dtype).eps * values[:10]
    values[10:20] *= 1e-9
    values[20] = 0.0
    expected = values.max(dim).indices
    values[49, 7] = torch.nan
    found = first_maximum_(values.clone(), dim)
    assert torch.equal(found[:49], expected[:49])
    assert ((found >= 0) & (found < values.shape[dim])).all()


def test_windows_narrower_than_a_peak_and_maps_of_nan_have_vertices():
    narrow = scan_vertices(maps(), LineConfig(window=1))
    assert narrow.points.isfinite().all()
    unknown = maps()
    unknown[0] = torch.nan
    mixed, alone = scan_vertices(unknown, LineConfig()), scan_vertices(maps(), LineConfig())
    assert torch.equal(mixed.points[1], alone.points[1])


def dense_representatives(vertices: Vertices, row: int, boundary: int, segments: int):
    """Means of one boundary by Python loops: (stretch, point, weight, count)."""
    part = [value[row, boundary] for value in vertices]
    points, normal, weight, density = part[:4]
    seen = [int(i) for i in weight.nonzero().flatten()]
    total = weight.sum()
    centre = (points * weight.unsqueeze(-1)).sum(0) / total
    off = points - centre
    xx, xy, yy = ((weight * off[:, i] * off[:, j]).sum() for i, j in ((0, 0), (0, 1), (1, 1)))
    angle = 0.5 * torch.atan2(2 * xy, xx - yy)
    along = off @ torch.stack([angle.cos(), angle.sin()])
    order = sorted(seen, key=lambda i: float(along[i]))
    bins = 2 * min(len(order) // 2, segments)
    for stretch in range(bins):
        members = [i for rank, i in enumerate(order) if rank * bins // len(order) == stretch]
        middle = members[len(members) - 1 - len(members) // 2]
        kept = []
        for i in members:
            chord, facing = points[i] - points[middle], normal[i]
            if facing @ normal[middle] < 0:
                facing = -facing
            near = chord.norm() < 1.5 * len(members) + 2
            if near and abs(0.5 * (facing + normal[middle]) @ chord) < 3.0:
                kept.append(i)
        share = (weight * density)[kept]
        mean = (share.unsqueeze(-1) * points[kept]).sum(0) / share.sum()
        off = ((mean - points[kept]) * normal[kept]).sum(-1, keepdim=True)
        moved = mean - 0.5 * (share.unsqueeze(-1) * off * normal[kept]).sum(0) / share.sum()
        yield stretch, moved, density[kept].sum()


def test_representatives_are_means_of_stretches():
    config = LineConfig(segments=5)
    vertices = scan_vertices(maps(), config)
    found = representative_vertices(vertices, config)
    compared = 0
    for row, boundary in ((0, 0), (1, 1)):
        for stretch, point, counted in dense_representatives(vertices, row, boundary, 5):
            if counted > 0:
                torch.testing.assert_close(found.points[row, boundary, stretch], point)
                torch.testing.assert_close(found.density[row, boundary, stretch], counted)
                compared += 1
    assert compared >= 15
    assert (found.density[1, 2] == 0).all()


def test_stretches_differ_by_one_vertex_at_most():
    config = LineConfig(segments=5)
    vertices = scan_vertices(maps(), config)
    stretch, middle, size = stretches(vertices, config)
    for row, boundary in ((0, 0), (1, 1)):
        seen = vertices.weight[row, boundary] > 0
        of_seen = stretch[row, boundary][seen]
        counts = of_seen.bincount(minlength=10)
        assert counts.max() - counts.min() <= 1
        assert torch.equal(size[row, boundary][seen], counts[of_seen])
        assert torch.equal(stretch[row, boundary][middle[row, boundary][seen]], of_seen)
