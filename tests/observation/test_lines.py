import numpy as np
import pytest
import torch

from lanebev.observation.lines import LineExtractor, extract_segments
from lanebev.observation.scans import (
    GAP,
    counted_probability,
    local_line,
    make_scans,
    scan_moments,
    scan_vertices,
)
from lanebev.observation.vertices import LineConfig
from lanebev.render import render_views
from train.extraction import distance_to_polyline, extraction_error

ROWS, COLUMNS, HALF_WIDTH = 96, 160, 1.125
CONFIG = LineConfig(half_width=HALF_WIDTH)


def stripe(start, end, rows=ROWS, columns=COLUMNS, half_width=HALF_WIDTH, fine=5):
    """Share of each pixel within half_width of a segment, by supersampling; independent of train.labels."""
    step = (np.arange(fine) - (fine - 1) / 2) / fine
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    start, end = np.asarray(start, float), np.asarray(end, float)
    direction = (end - start) / np.linalg.norm(end - start)
    share = np.zeros((rows, columns))
    for dy in step:
        for dx in step:
            px, py = x + dx - start[0], y + dy - start[1]
            along = np.clip(px * direction[0] + py * direction[1], 0, np.linalg.norm(end - start))
            share += np.hypot(px - along * direction[0], py - along * direction[1]) <= half_width
    return torch.from_numpy(share / fine**2)


def fan(seed=0):
    """Six boundaries through one vanishing point, and their ends, (6, 2, 2)."""
    rng = np.random.default_rng(seed)
    vanishing = np.array([80 + 8 * rng.standard_normal(), 28 + 3 * rng.standard_normal()])
    feet = vanishing[0] + rng.uniform(-25, 25) + (np.arange(6) - 2.5) * rng.uniform(70, 110)
    near = np.stack([feet, np.full(6, 110.0)], -1)
    far = vanishing + 0.15 * (near - vanishing)
    return torch.stack([stripe(a, b) for a, b in zip(near, far, strict=True)]), np.stack([near, far], 1)


def across(points, ends):
    """Signed distances of (..., 2) points to the lines through (2, 2) ends."""
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return (np.asarray(points) - ends[0]) @ np.array([-direction[1], direction[0]])


def to_label(endpoints, stride=2):
    return endpoints.numpy() / stride


@pytest.fixture(scope="module")
def fans():
    maps, ends = zip(*(fan(seed) for seed in range(6)), strict=True)
    return torch.stack(maps), np.stack(ends)


def segment_errors(segments, ends, stride=2):
    """Across-line errors of end points in label px, their sigmas, and the mask of what was seen."""
    batch = len(ends)
    points = to_label(segments.endpoints, stride).reshape(batch, 6, -1, 2, 2)
    errors = np.stack([[across(points[b, k], ends[b, k]) for k in range(6)] for b in range(batch)])
    sigma = segments.sigma.numpy().reshape(batch, 6, -1) / stride
    return errors, sigma, segments.weight.numpy().reshape(batch, 6, -1) > 0


def test_vertices_lie_on_rendered_boundaries_to_a_tenth_of_a_pixel(fans):
    maps, ends = fans
    segments = extract_segments(maps, (2 * ROWS, 2 * COLUMNS), CONFIG)
    errors, _, seen = segment_errors(segments, ends)
    assert seen.mean() > 0.95
    assert np.abs(errors[seen]).max() < 0.1
    assert abs(errors[seen].mean()) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("size", [(144, 256), (96, 160)])
def test_extraction_on_masks_of_rendered_roads(size):
    """Curves, hills, hidden stretches and lenses included: every vertex within 0.1 px."""
    frame = render_views(24, (64, 112), torch.Generator().manual_seed(0), kind="highway")
    error = extraction_error(frame, size, LineConfig(stride=1))
    assert len(error.distance) > 1000
    assert error.missed == 0
    assert error.distance.quantile(0.99) < 0.06
    assert error.distance.max() < 0.1
    if size == (144, 256):  # on coarser masks the sigmas are a fifth too large
        assert 0.8 < error.normalised() < 1.2


def test_distance_to_a_bent_polyline():
    line = torch.tensor([[0.0, 0], [4, 0], [4, 3]])
    points = torch.tensor([[2.0, 1], [6, 1], [-3, 4]])
    torch.testing.assert_close(distance_to_polyline(points, line), torch.tensor([1.0, 2.0, 5.0]))


@pytest.mark.parametrize("gap", [0, 24])
def test_bent_line_with_a_gap(gap):
    """R = 250 px about (290, 48): means of points on both sides of the gap would lie 0.3 px off it."""
    y, x = torch.meshgrid(torch.arange(96.0), torch.arange(160.0), indexing="ij")
    radius = (x.double() - 290).hypot(y.double() - 48)
    maps = (HALF_WIDTH + 0.5 - (radius - 250).abs()).clamp(0, 1)
    maps[48 - gap // 2 : 48 + gap // 2] = 0
    segments = extract_segments(maps[None, None], (192, 320), LineConfig(segments=3))
    points = segments.endpoints[0][segments.weight[0] > 0] / 2
    assert len(points) == 3
    off = (points - torch.tensor([290.0, 48])).norm(dim=-1) - 250
    assert off.abs().max() < 0.1
    if not gap:
        assert off.mean().abs() < 0.01  # means as they are lie inside the bend, 0.035 px of it


def test_scans_that_cross_twice_say_nothing():
    """The columns right of a hook's bend cross it twice."""
    hook = torch.maximum(stripe((20, 20), (100, 40)), stripe((100, 40), (20, 60)))
    vertices = scan_vertices(hook[None, None], CONFIG)
    columns = vertices.weight[0, 0, ROWS + GAP :]
    assert (columns[90:96] == 0).all()
    assert (columns[40:60] > 0.9).all()  # where only the upper one is near its peak


def test_arms_of_a_hook_are_not_averaged():
    """Nor are pieces on either side of a gap: every vertex lies on one of the two lines."""
    upper, lower = ((20, 20), (100, 32)), ((100, 32), (20, 44))
    maps = torch.maximum(stripe(*upper), stripe(*lower))
    maps[:, 56:76] = 0
    segments = extract_segments(maps[None, None], (2 * ROWS, 2 * COLUMNS), CONFIG)
    points = to_label(segments.endpoints[0][segments.weight[0] > 0]).reshape(-1, 2)
    off = np.minimum(*(np.abs(across(points, np.array(ends, float))) for ends in (upper, lower)))
    assert len(points) >= 2 * CONFIG.segments - 2  # all but the tip, which says nothing
    assert off.max() < 0.1  # means of both arms lie up to 9 px off


def test_every_vertex_is_used_once_and_baselines_are_long(fans):
    maps, ends = fans
    segments = extract_segments(maps, (2 * ROWS, 2 * COLUMNS), CONFIG)
    seen = segments.weight[0] > 0
    points = segments.endpoints[0][seen].flatten(0, 1)
    assert len(points.unique(dim=0)) == len(points)
    chords = (segments.endpoints[:, :, 1] - segments.endpoints[:, :, 0]).norm(dim=-1)
    per_boundary = chords.view(len(maps), 6, -1) / 2
    visible = np.clip(ends[..., 1], 0, ROWS) - 0
    assert per_boundary[:, 2:4].median() > 0.4 * np.median(visible[:, 2:4, 0] - visible[:, 2:4, 1])


def test_zeros_and_ones_are_the_papers_rule():
    maps = torch.zeros(1, 1, 40, 60, dtype=torch.float64)
    for row in range(40):
        maps[0, 0, row, 20 + row // 4 : 23 + row // 4] = 1  # three on-pixels: mean 21 + row // 4
    scans = make_scans(40, 60, 6, maps.device)
    position, mass, _ = scan_moments(counted_probability(maps, 6), 6, scans)
    torch.testing.assert_close(position[0, 0, :40], 21.0 + torch.arange(40, dtype=torch.float64) // 4)
    torch.testing.assert_close(mass[0, 0, :40], torch.full((40,), 3.0, dtype=torch.float64))
    below = scan_moments(counted_probability(torch.zeros_like(maps), 6), 6, scans)[1]
    assert (below == 0).all()


def test_convention_pixel_centres():
    """Label column 30 under stride 2 is network pixel 60, which is pixel 120.5 of an image twice as large."""
    maps = torch.zeros(1, 1, 96, 160, dtype=torch.float64)
    maps[..., 29:32] = 1
    small = extract_segments(maps, (192, 320), CONFIG)
    large = extract_segments(maps, (384, 640), CONFIG)
    assert (small.weight > 0).all()
    torch.testing.assert_close(small.endpoints[..., 0], torch.full_like(small.endpoints[..., 0], 60.0))
    torch.testing.assert_close(large.endpoints[..., 0], torch.full_like(large.endpoints[..., 0], 120.5))
    torch.testing.assert_close(large.sigma, 2 * small.sigma)


@pytest.mark.parametrize("angle_deg", [0, 20, 40, 45, 50, 70, 90, 110, 135, 160])
def test_steep_and_shallow_alike(angle_deg):
    direction = np.array([np.sin(np.deg2rad(angle_deg)), np.cos(np.deg2rad(angle_deg))])
    ends = np.stack([[80.3, 47.6] - 40 * direction, [80.3, 47.6] + 40 * direction])
    segments = extract_segments(stripe(*ends)[None, None], (192, 320), CONFIG)
    seen = segments.weight[0].numpy() > 0
    assert seen.sum() == CONFIG.segments
    assert np.abs(across(to_label(segments.endpoints[0])[seen], ends)).max() < 0.1


@pytest.mark.parametrize("wobble", [0.3, 1.0])
def test_sigma_matches_a_hedging_map(wobble):
    """A map that does not know where the line is within a normal of sd `wobble` says so."""
    rng = np.random.default_rng(1)
    quantiles = torch.special.ndtri((torch.arange(9, dtype=torch.float64) + 0.5) / 9).numpy()
    quantiles /= quantiles.std()
    scores = []
    for guess in wobble * quantiles:  # where the truth is within what the map thinks possible
        angle, centre = np.deg2rad(rng.uniform(-35, 35)), np.array([60, 48]) + rng.uniform(-5, 5, 2)
        direction = np.array([np.sin(angle), np.cos(angle)])
        normal = np.array([direction[1], -direction[0]])
        ends = np.stack([centre - 30 * direction, centre + 30 * direction])
        maps = sum(stripe(*(ends + (guess + wobble * q) * normal), columns=120) for q in quantiles) / 9
        segments = extract_segments(maps[None, None], (192, 240), CONFIG)
        seen = segments.weight[0].numpy() > 0
        errors = across(to_label(segments.endpoints[0])[seen], ends)
        scores.append(np.mean((errors / segments.sigma[0].numpy()[seen, None] * 2) ** 2))
    assert 0.8 < np.sqrt(np.mean(scores)) < 1.2


def test_gradcheck():
    generator = torch.Generator().manual_seed(0)
    maps = stripe((3.3, 19), (16.2, -2), rows=18, columns=20, fine=3)[None, None]
    maps = (0.9 * maps + 0.02 + 0.06 * torch.rand(maps.shape, generator=generator)).requires_grad_()
    config = LineConfig(half_width=HALF_WIDTH, segments=2)

    def endpoints_weight_sigma(p):
        segments = extract_segments(p, (36, 40), config)
        return segments.endpoints, segments.weight, segments.sigma

    assert endpoints_weight_sigma(maps)[1].max() > 0
    assert torch.autograd.gradcheck(endpoints_weight_sigma, (maps,), eps=1e-7, atol=1e-4, fast_mode=True)


def test_absent_is_weight_zero_and_finite():
    for maps in (torch.zeros(1, 6, 32, 48), torch.ones(1, 6, 32, 48), torch.full((1, 6, 32, 48), 1 / 7)):
        maps.requires_grad_()
        segments = extract_segments(maps, (64, 96), CONFIG)
        assert all(part.isfinite().all() for part in segments)
        (segments.endpoints.sum() + segments.sigma.sum() + segments.weight.sum()).backward()
        assert maps.grad.isfinite().all()
    assert (extract_segments(torch.zeros(1, 6, 32, 48), (64, 96), CONFIG).weight == 0).all()


def test_band_at_the_image_edge_is_dropped():
    """A vertical line half outside would be seen too far inside."""
    segments = extract_segments(stripe((0.2, -5), (0.2, 120))[None, None], (192, 320), CONFIG)
    assert (segments.weight == 0).all()


def test_rows_of_a_batch_are_alone(fans):
    maps, _ = fans
    alone = extract_segments(maps[1:2], (192, 320), CONFIG)
    noise = torch.full_like(maps[:1], float("nan"))
    together = extract_segments(torch.cat([noise, maps[1:2], 0 * maps[:1]]), (192, 320), CONFIG)
    for a, b in zip(alone, together, strict=True):
        torch.testing.assert_close(b[1], a[0])


def test_local_line_of_a_straight_line_with_a_gap():
    rows = torch.arange(30, dtype=torch.float64)
    weight = torch.ones_like(rows)
    weight[10:13] = 0
    slope, variance = local_line(torch.where(weight > 0, 3 + 0.7 * rows, 99.0), weight)
    torch.testing.assert_close(slope[weight > 0], torch.full((27,), 0.7, dtype=torch.float64))
    assert variance[weight > 0].max() < 1e-18


def test_local_line_has_the_variance_of_its_noise():
    noise = 0.3 * torch.randn(4000, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows = torch.arange(40, dtype=torch.float64)
    _, variance = local_line(3 + 0.7 * rows + noise, torch.ones_like(noise))
    torch.testing.assert_close(
        variance[:, 10:30].mean(), torch.tensor(0.09, dtype=torch.float64), rtol=0.02, atol=0
    )


@pytest.mark.parametrize(("start", "end", "factor"), [((80, 10), (80, 90), 3.0), ((20, 48), (140, 48), 1.0)])
def test_sigma_is_across_the_line_also_where_an_image_is_wider_than_its_map(start, end, factor):
    """Three times as wide only: a steep line's sigma grows with the width, a level one's does not."""
    maps = stripe(start, end)[None, None]
    same = extract_segments(maps, (192, 320), CONFIG)
    wide = extract_segments(maps, (192, 960), CONFIG, (192, 320))
    seen = same.weight > 0
    torch.testing.assert_close(wide.sigma[seen], factor * same.sigma[seen])


def test_vertices_count_is_static():
    vertices = scan_vertices(torch.rand(2, 3, 20, 30), CONFIG)
    assert vertices.points.shape == (2, 3, 50 + GAP, 2)
    assert (vertices.weight[..., 20 : 20 + GAP] == 0).all()
    segments = LineExtractor(CONFIG)(torch.randn(2, 4, 20, 30), (40, 60))
    assert segments.endpoints.shape == (2, 3 * CONFIG.segments, 2, 2)


@pytest.mark.slow
def test_export_equals_eager(fans):
    logits = torch.log(
        torch.cat([(1 - fans[0].sum(1, keepdim=True)).clamp(min=1e-3), fans[0].clamp(min=1e-3)], 1)
    )

    class AtSize(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.lines = LineExtractor(CONFIG)

        def forward(self, logits):
            return tuple(self.lines(logits, (192, 320)))

    exported = torch.export.export(AtSize(), (logits[:2],)).module()
    for a, b in zip(exported(logits[2:4]), AtSize()(logits[2:4]), strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: LineExtractor()(torch.zeros(2, 7, 8), (16, 16)), "logits: expected"),
        (lambda: extract_segments(torch.zeros(7, 8), (16, 16), CONFIG), "probabilities: expected"),
        (lambda: LineConfig(segments=0), "segments: expected"),
        (lambda: LineConfig(min_mass=0.7), "full_mass: expected"),
        (lambda: LineConfig(half_width=0.0), "half_width: expected more than 0"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()


def test_maps_of_another_stride_are_refused():
    logits = torch.zeros(1, 7, 48, 80)
    with pytest.raises(ValueError, match=r"maps: expected 24 x 40, .* stride of 4, got 48 x 80; see"):
        LineExtractor(LineConfig(stride=4))(logits, (360, 640), (96, 160))
    found = LineExtractor(LineConfig(stride=4))(logits[..., :24, :40], (360, 640), (93, 157))  # rounded up
    assert found.weight.shape[0] == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_logits_of_half_precision_and_autocast_give_float32_segments(fans, dtype):
    maps = fans[0][:2]
    logits = torch.cat([(1 - maps.sum(1, keepdim=True)), maps], 1).clamp(min=1e-3).log().to(dtype)
    logits.requires_grad_()
    expected = LineExtractor(CONFIG)(logits.detach().float(), (192, 320))
    with torch.autocast("cpu", torch.bfloat16):
        found = LineExtractor(CONFIG)(logits, (192, 320))
    assert found.endpoints.dtype == torch.float32
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)
    found.endpoints.sum().backward()
    assert logits.grad.dtype == dtype
    assert logits.grad.abs().sum() > 0


def test_a_networks_line_is_as_sure_as_the_rows_it_crosses():
    """Vertices nearer together than the correlation count for fewer; far apart they are as they were."""
    y, x = torch.meshgrid(torch.arange(96.0), torch.arange(160.0), indexing="ij")
    steep, shallow = (8 * ((x - 40 - s * (y - 40)).abs() < 1.5 * (1 + s * s) ** 0.5) - 4 for s in (0.2, 4.0))
    logits = torch.stack([torch.zeros_like(x), steep, shallow])[None].double()
    logits[:, 1:, :40] = logits[:, 1:, 60:] = -9.0
    plain = LineExtractor(LineConfig(stride=2))(logits, (192, 320))
    raised = LineExtractor(LineConfig(stride=2, correlation=10.0))(logits, (192, 320))
    for k in range(2):
        mine = (plain.boundary[0] == k) & (plain.weight[0] > 0)
        ends = plain.endpoints[0, mine, :, 1]
        expected = (2 * mine.sum() * 10.0 / (ends.max() - ends.min())).clamp(min=1.0).sqrt()
        assert expected > 1.5
        torch.testing.assert_close(raised.sigma[0, mine], plain.sigma[0, mine] * expected)
    far = LineExtractor(LineConfig(stride=2, correlation=0.5))(logits, (192, 320))
    torch.testing.assert_close(far.sigma, plain.sigma)
