"""Algorithm 1, Rother's score and the least-squares vanishing direction."""

import math

import pytest
import torch

from lanebev.estimation.two_stage import vanishing
from lanebev.geometry.road import great_circle_normals, segment_rays
from lanebev.geometry.rotation import vanishing_dir_from_pitch_yaw

K = torch.tensor([[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]], dtype=torch.float64)
VP = torch.tensor([700.0, 330.0], dtype=torch.float64)
PITCH_YAW = (-math.atan((330 - 360) / 1000), math.atan(60 / math.hypot(1000, 30)))
DRAWS = torch.rand(300, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def segments_to(vp=VP, n=24, noise=0.0, outliers=0, seed=0):
    """(1, N, 2, 2) segments from the lower half that point to the vanishing point."""
    generator = torch.Generator().manual_seed(seed)
    foot = torch.rand(n, 2, generator=generator, dtype=torch.float64) * torch.tensor([1280.0, 150.0])
    foot = foot + torch.tensor([0.0, 560.0])
    share = 0.1 + 0.8 * torch.rand(
        n, 2, 1, generator=generator, dtype=torch.float64
    )  # long ones and short ones
    ends = foot[:, None] + share * (vp - foot[:, None])
    ends = ends + noise * torch.randn(ends.shape, generator=generator, dtype=torch.float64)
    wild = torch.rand(outliers, 2, 2, generator=generator, dtype=torch.float64) * 700
    return torch.cat([ends, wild])[None]


def ones(ends):
    return torch.ones(ends.shape[:2], dtype=torch.float64)


def test_angle_by_hand():
    ends = torch.tensor([[[0.0, 0.0], [2.0, 0.0]]], dtype=torch.float64)
    up = torch.tensor([1.0, 5.0, 1.0], dtype=torch.float64)
    diagonal = torch.tensor([2.0, 1.0, 1.0], dtype=torch.float64)
    infinite = torch.tensor([-1.0, 1.0, 0.0], dtype=torch.float64)
    angles = [float(vanishing.segment_angles(ends, v)) for v in (up, diagonal, infinite)]
    assert angles == pytest.approx([math.pi / 2, math.pi / 4, math.pi / 4])


def test_lines_intersect_by_hand():
    """Eq. (1): y = x and x + y = 4 meet at (2, 2); parallels meet at infinity."""
    ends = torch.tensor(
        [[[0.0, 0.0], [1.0, 1.0]], [[0.0, 4.0], [4.0, 0.0]], [[0.0, 1.0], [1.0, 2.0]]]
    ).double()
    rising, falling, parallel = vanishing.line_through(ends)
    point = vanishing.intersect_lines(rising, falling)
    assert (point / point[2]).tolist() == pytest.approx([2.0, 2.0, 1.0])
    assert float(vanishing.intersect_lines(rising, parallel)[2]) == pytest.approx(0.0, abs=1e-12)


def test_score_by_hand():
    gate = vanishing.GATE_ANGLE
    angles = torch.tensor([0.0, gate / 2, 2 * gate], dtype=torch.float64)
    lengths = torch.tensor([100.0, 50.0, 100.0], dtype=torch.float64)
    gates, weight = torch.full_like(angles, gate), torch.ones_like(angles)
    # 0.8 + 0.2, 0.4 + 0.1, and nothing for the one beyond the gate.
    assert float(vanishing.rother_score(angles, gates, lengths, weight)) == pytest.approx(1.5)
    assert (vanishing.SCORE_ANGLE_WEIGHT, vanishing.SCORE_LENGTH_WEIGHT) == (0.8, 0.2)
    assert math.degrees(gate) == pytest.approx(0.7)


def test_pairs_are_exhaustive_when_few_and_present_ones_when_sampled():
    few = vanishing.segment_pairs(torch.ones(2, 5), DRAWS)
    assert few.shape == (2, 10, 2)
    assert len({tuple(p) for p in few[0].tolist()}) == 10
    weight = torch.zeros(2, 60)
    weight[0, 7:30], weight[1] = 1.0, 1.0
    many = vanishing.segment_pairs(weight, DRAWS)
    assert many.shape == (2, 300, 2)
    assert (many[..., 0] != many[..., 1]).all()
    assert ((many[0] >= 7) & (many[0] < 30)).all()
    assert torch.equal(vanishing.segment_pairs(weight[1:], DRAWS)[0], many[1])


@pytest.mark.parametrize("n", [12, 60])
def test_ransac_finds_the_vanishing_point_among_outliers(n):
    ends = segments_to(n=n, noise=0.3, outliers=n)
    point, inliers = vanishing.ransac_vanishing_point(ends, ones(ends), 0.3 * ones(ends), DRAWS)
    assert (point[0, :2] / point[0, 2] - VP).norm() < 15
    assert inliers[0, :n].double().mean() > 0.9
    assert inliers[0, n:].double().mean() < 0.3


def test_deviation_noise_aware_gate_keeps_what_the_papers_gate_throws_away():
    ends = segments_to(n=200, noise=3.0)
    angles = vanishing.segment_angles(ends, torch.tensor([[*VP, 1.0]], dtype=torch.float64))
    sigma = 3.0 * ones(ends)
    paper = (angles < vanishing.gate_angles(ends, sigma, 0.0)).double().mean()
    ours = (angles < vanishing.gate_angles(ends, sigma, 3.5)).double().mean()
    assert paper < 0.7
    assert ours > 0.95


def least_squares(ends, sigma, weight, prior=(0.0, 0.0, 1.0)):
    rays = segment_rays(ends, K[None])
    normals = great_circle_normals(rays)
    direction = torch.tensor([prior], dtype=torch.float64)
    for _ in range(3):
        noise = vanishing.incidence_noise(rays, direction, sigma, K[None])
        direction, cov = vanishing.vanishing_dir_least_squares(normals, noise, weight, direction)
    return direction, cov


def test_deviation_least_squares_equals_svd_without_noise_and_has_z_positive():
    ends = segments_to()
    direction, _ = least_squares(ends, ones(ends), ones(ends))
    svd = torch.linalg.svd(great_circle_normals(segment_rays(ends, K[None]))[0]).Vh[-1]
    torch.testing.assert_close(direction[0], svd / svd[2], atol=1e-9, rtol=0)
    assert direction[0, 2] == 1
    expected = vanishing_dir_from_pitch_yaw(*(torch.tensor(a, dtype=torch.float64) for a in PITCH_YAW))
    torch.testing.assert_close(direction[0], expected / expected[2])


def test_least_squares_covariance_is_honest_and_beats_normalised_normals():
    errors, plain, normalised = [], [], []
    for seed in range(300):
        ends = segments_to(n=60, noise=1.0, seed=seed)
        direction, cov = least_squares(ends, ones(ends), ones(ends))
        error = direction[0, :2] - (VP - K[:2, 2]) / 1000
        errors.append(float(error @ torch.linalg.solve(cov[0], error)))
        plain.append(float(error.norm()))
        unit = torch.nn.functional.normalize(great_circle_normals(segment_rays(ends, K[None])), dim=-1)
        svd = torch.linalg.svd(unit[0]).Vh[-1]
        normalised.append(float((svd[:2] / svd[2] - (VP - K[:2, 2]) / 1000).norm()))
    assert 0.8 < sum(errors) / 2 / 300 < 1.25
    rms = [math.sqrt(sum(e * e for e in x) / 300) for x in (plain, normalised)]
    assert rms[1] > 2 * rms[0]


@pytest.mark.parametrize("kind", ["one line", "nothing", "duplicates", "padding"])
def test_degenerate_rows_are_finite_in_value_and_gradient(kind):
    ends = segments_to(n=6)
    weight = ones(ends)
    if kind == "one line":
        ends = torch.tensor([[[100.0, 700.0], [300.0, 600.0]]], dtype=torch.float64).repeat(1, 6, 1, 1)
        ends = ends + torch.arange(6.0)[None, :, None, None] * torch.tensor([10.0, -5.0])
    elif kind == "nothing":
        weight = weight * 0
    elif kind == "duplicates":
        ends = ends[:, :1].repeat(1, 6, 1, 1)
    elif kind == "padding":
        weight[:, 2:] = 0
    ends.requires_grad_()
    direction, cov = least_squares(ends, ones(ends), weight)
    (direction.sum() + cov.sum()).backward()
    assert direction.isfinite().all()
    assert ends.grad.isfinite().all()
    point, inliers = vanishing.ransac_vanishing_point(ends.detach(), weight, ones(ends), DRAWS)
    assert point.isfinite().all()
    if kind == "nothing":
        assert not inliers.any()
        torch.testing.assert_close(direction, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))


def test_gradcheck_of_the_vanishing_direction_also_with_one_line_only():
    for ends in (segments_to(n=4, noise=0.5), segments_to(n=4)[:, :1].repeat(1, 3, 1, 1)):
        weight = ones(ends)
        weight[:, -1] = 0
        assert torch.autograd.gradcheck(
            lambda e, w=weight: least_squares(e, ones(e), w)[0], (ends.requires_grad_(),), atol=1e-5
        )


def test_order_and_end_points_do_not_matter():
    ends = segments_to(noise=0.5)
    direction, _ = least_squares(ends, ones(ends), ones(ends))
    shuffled = ends[:, torch.randperm(ends.shape[1], generator=torch.Generator().manual_seed(1))].flip(2)
    again, _ = least_squares(shuffled, ones(ends), ones(ends))
    torch.testing.assert_close(direction, again)
