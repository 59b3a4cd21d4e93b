"""Vertices to segments: which are paired, what the segments are worth, and what a lens does to them."""

import pytest
import torch

from lanebev.geometry.lens import distort_points
from lanebev.observation.boundary_vertices import BoundaryVertices, line_directions, move_to_front
from lanebev.observation.segments import pair_vertices, segments_from_vertices

K = torch.tensor([[1000.0, 0, 639.5], [0, 1000.0, 359.5], [0, 0, 1]], dtype=torch.float64)
LENS = torch.tensor([[-0.25, 0.04, 1e-4, -1e-4, 0.0]], dtype=torch.float64)


def column(count, most=8, weight=1.0, x=600.0, dtype=torch.float64):
    """Vertices (1, 1, most) on one vertical line, ``count`` of them there, ten rows apart."""
    y = 400.0 + 10.0 * torch.arange(most, dtype=dtype)
    there = (torch.arange(most) < count).to(dtype)
    points = torch.stack([torch.full_like(y, x), y], dim=-1)
    sigma = 0.5 + 0.1 * torch.arange(most, dtype=dtype)
    return BoundaryVertices(
        points[None, None], weight * there[None, None], sigma[None, None], torch.ones(1, 1).long()
    )


@pytest.mark.parametrize(
    ("count", "pairs"),
    [(8, [(0, 4), (1, 5), (2, 6), (3, 7)]), (7, [(0, 4), (1, 5), (2, 6)]), (2, [(0, 1)]), (1, []), (0, [])],
)
def test_vertex_i_of_k_goes_with_vertex_i_plus_half_of_k(count, pairs):
    segments = segments_from_vertices(column(count), K[None])
    seen = segments.weight[0] > 0
    rows = (segments.endpoints[0, seen, :, 1] - 400) / 10
    assert [tuple(row) for row in rows.round().int().tolist()] == pairs
    assert segments.endpoints.shape == (1, 4, 2, 2)
    assert (segments.boundary == 1).all()


def test_a_segment_is_as_sure_as_its_ends():
    vertices = column(4, most=4)
    vertices = vertices._replace(weight=torch.tensor([[[0.9, 0.2, 0.5, 0.8]]], dtype=torch.float64))
    segments = pair_vertices(vertices)
    torch.testing.assert_close(segments.weight, torch.tensor([[0.5, 0.2]], dtype=torch.float64))
    expected = torch.tensor([[(0.5**2 + 0.7**2) / 2, (0.6**2 + 0.8**2) / 2]], dtype=torch.float64).sqrt()
    torch.testing.assert_close(segments.sigma, expected)


def test_what_was_not_seen_moves_to_the_end_and_is_not_paired():
    vertices = column(8)
    weight = vertices.weight.clone()
    weight[..., [1, 6]] = 0.0
    nan = torch.where(weight.unsqueeze(-1) > 0, vertices.points, torch.nan)
    front = move_to_front(vertices._replace(weight=weight, points=nan))
    assert (front.weight > 0).tolist() == [[[True] * 6 + [False] * 2]]
    assert front.points[0, 0, :6, 1].tolist() == [400, 420, 430, 440, 450, 470]
    assert (front.points[0, 0, 6:] == 0).all()
    segments = segments_from_vertices(vertices._replace(weight=weight), K[None])
    ends = segments.endpoints[segments.weight > 0]
    assert ends[..., 1].tolist() == [[400, 440], [420, 450], [430, 470]]


def test_direction_from_the_vertex_before_to_the_one_after():
    points = torch.tensor([[0.0, 0], [1, 1], [1, 3], [9, 9]])
    there = torch.tensor([True, True, True, False])
    expected = torch.tensor([[1.0, 1], [1, 3], [0, 2]])
    torch.testing.assert_close(line_directions(points, there)[:3], expected)
    alone = line_directions(points, torch.tensor([True, False, False, False]))
    assert (alone[0] == 0).all()


def test_the_lens_is_taken_out_of_points_and_sigmas(dtype):
    ideal = column(8, x=1200.0)
    taken = distort_points(ideal.points.flatten(1, 2), K[None], LENS).view_as(ideal.points)
    vertices = ideal._replace(
        points=taken.to(dtype), weight=ideal.weight.to(dtype), sigma=ideal.sigma.to(dtype)
    )
    segments = segments_from_vertices(vertices, K[None], LENS)
    assert segments.endpoints.dtype == torch.float64
    expected = segments_from_vertices(ideal, K[None])
    torch.testing.assert_close(segments.endpoints, expected.endpoints, atol=1e-3, rtol=0)
    right, left, below, above = (
        distort_points(ideal.points[0] + ideal.points.new_tensor(step), K[None], LENS)[0]
        for step in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
    )
    across, along = right - left, torch.nn.functional.normalize(below - above, dim=-1)
    shrunk = (across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]).abs()  # of a pixel here, as taken
    each = ideal.sigma[0, 0] / shrunk
    expected_sigma = (0.5 * (each[:4] ** 2 + each[4:] ** 2)).sqrt()
    torch.testing.assert_close(segments.sigma[0], expected_sigma, rtol=2e-4, atol=0)


def test_a_pixel_that_no_point_is_imaged_on_is_left_out():
    barrel = torch.tensor([[-0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)  # folds over 0.7 of f off the axis
    vertices = column(8)
    points = vertices.points.clone()
    points[0, 0, 3] = torch.tensor([639.5 + 900.0, 359.5])
    segments = segments_from_vertices(vertices._replace(points=points), K[None], barrel)
    assert (segments.weight > 0).sum() == 3
    assert segments.endpoints[segments.weight > 0][..., 0].max() < 640


def test_rows_of_a_batch_are_alone_also_beside_a_lens_that_is_none():
    one, other = column(8), column(5, x=300.0)
    both = BoundaryVertices(*(torch.cat(pair) for pair in zip(one, other, strict=True)))
    bad = torch.full_like(LENS, torch.nan)
    together = segments_from_vertices(both, K.expand(2, 3, 3), torch.cat([bad, LENS]))
    assert not together.weight[0].any()
    assert together.endpoints.isfinite().all()
    alone = segments_from_vertices(other, K[None], LENS)
    for a, b in zip(alone, together, strict=True):
        torch.testing.assert_close(b[1], a[0])


def test_gradcheck_through_the_lens():
    whole = column(6)
    bend = torch.linspace(-3, 3, 6, dtype=torch.float64).square()
    points = (whole.points[0, 0, :6] + torch.stack([bend, 0 * bend], -1)).requires_grad_()
    weight = torch.linspace(0.9, 0.4, 6, dtype=torch.float64, requires_grad=True)
    sigma = whole.sigma[0, 0, :6].clone().requires_grad_()

    def parts(*seen):
        padded = (
            torch.cat([own, rest[0, 0, 6:]])[None, None] for own, rest in zip(seen, whole, strict=False)
        )
        segments = segments_from_vertices(BoundaryVertices(*padded, whole.boundary), K[None], LENS)
        return segments.endpoints, segments.weight, segments.sigma

    assert torch.autograd.gradcheck(parts, (points, weight, sigma), eps=1e-6, atol=1e-4)


def test_padding_carries_no_gradient_that_is_not_finite():
    vertices = column(4)
    points = torch.where(vertices.weight.unsqueeze(-1) > 0, vertices.points, torch.inf).requires_grad_()
    segments = segments_from_vertices(vertices._replace(points=points), K[None], LENS)
    (segments.endpoints.sum() + segments.sigma.sum()).backward()
    assert points.grad.isfinite().all()


@pytest.mark.slow
def test_export_equals_eager():
    class Pair(torch.nn.Module):
        def forward(self, vertices, intrinsics, lens):
            return segments_from_vertices(vertices, intrinsics, lens)

    exported = torch.export.export(Pair(), (column(8), K[None], LENS)).module()
    for a, b in zip(
        exported(column(5), K[None], LENS), segments_from_vertices(column(5), K[None], LENS), strict=True
    ):
        torch.testing.assert_close(a, b)
