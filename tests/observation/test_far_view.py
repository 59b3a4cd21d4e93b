"""Far views: sizes, crops and the merging of vertices."""

import pytest
import torch
from torch import nn

from lanebev import FarView
from lanebev.geometry.vanishing_point import vanishing_point
from lanebev.observation.boundary_detector import BoundaryDetector
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.far_view import (
    ViewSizes,
    contradiction,
    crop_images,
    inside_far_view,
    merge_vertices,
    place_crop,
    view_sizes,
    x_on_rows,
)
from lanebev.observation.polylines import VERTICES_PER_LINE

SIZE, SIZES = (720, 1280), ViewSizes((256, 448), (128, 544), (415, 737))
NOWHERE = float("nan")
HORIZON = torch.tensor([50.0])


class Ramp(nn.Module):
    """Stands for network and extraction: each view has vertices at known pixels, with the image's values."""

    def __init__(self) -> None:
        super().__init__()
        self.inputs = []

    def forward(self, image):
        self.inputs.append(image)
        return image

    def vertices(self, logits, covered, network_size):
        """Return three vertices of one boundary, at pixels that all views have."""
        x, y = torch.tensor([40.0, 60.0, 80.0]), torch.tensor([20.0, 30.0, 40.0])
        scale = torch.tensor([covered[1] / network_size[1], covered[0] / network_size[0]])
        points = (torch.stack([x, y], -1) + 0.5) * scale - 0.5
        rows = len(logits)
        seen = torch.ones(rows, 1, 6)
        index = torch.zeros(rows, 1, dtype=torch.int64)
        return BoundaryVertices(torch.cat([points, points + 1]).expand(rows, 1, 6, 2), seen, seen, index)


def ramp_images(rows=1, size=SIZE):
    """Images whose red is x and whose green is y, px."""
    y, x = torch.meshgrid(*(torch.arange(side, dtype=torch.float32) for side in size), indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)]).expand(rows, 3, *size)


def detector(**arguments):
    ramp = Ramp()
    return BoundaryDetector(ramp, ramp, 576, 320 * 576, (), FarView(**arguments)), ramp


@pytest.mark.parametrize(
    "size", [(720, 1280), (1080, 1920), (375, 1242), (590, 1640), (480, 640), (1208, 1920)]
)
def test_both_views_have_at_most_the_pixels_of_one(size):
    detecting, _ = detector()
    rows, columns = detecting.network_size(size)
    whole, far, resized = detecting.view_sizes(size)
    assert 0.95 * rows * columns < whole[0] * whole[1] + far[0] * far[1] <= rows * columns
    assert all(side % 32 == 0 for side in (*whole, *far))
    assert far[0] <= resized[0]
    assert far[1] <= resized[1]
    assert resized[1] / columns == pytest.approx(min(1.28, size[1] / columns), rel=0.01)


def test_an_image_smaller_than_the_network_s_input_still_has_a_far_view_inside():
    sizes = view_sizes(FarView(), (100, 150), (384, 576))
    assert sizes.far[0] <= sizes.resized[0]
    assert sizes.far[1] <= sizes.resized[1]


def test_the_far_view_is_about_the_vanishing_point_and_inside_the_image():
    point = torch.tensor([[639.5, 359.5], [0.0, 0.0], [5000.0, 5000.0], [-3.0, 400.0]])
    corner = place_crop(point, SIZES, SIZE, 0.25)
    middle = [round(0.5 * (737 - 544)), round(0.5 * 415 - 0.25 * 128)]
    assert corner.tolist() == [middle, [0, 0], [737 - 544, 415 - 128], [0, round(400.5 * 415 / 720 - 32)]]


def test_each_image_is_cropped_at_its_own_place(device):
    image = torch.rand(3, 3, 20, 30, device=device)
    corner = torch.tensor([[0, 0], [5, 7], [18, 11]], device=device)
    crops = crop_images(image, corner, (9, 12))
    for row, (left, top) in enumerate(corner.tolist()):
        assert torch.equal(crops[row], image[row, :, top : top + 9, left : left + 12])


@pytest.mark.parametrize("magnification", [1.0, 2.0])
def test_vertices_of_a_far_view_are_where_the_image_s_values_say(magnification):
    """Red and green of the image are x and y: what the network's input shows at a vertex is its place."""
    detecting, ramp = detector(magnification=magnification)
    points = torch.tensor([[600.0, 250.0], [100.0, 600.0], [1140.0, 330.0]])
    _, found = detecting.boundary_vertices(ramp_images(3, (640, 1152)), points)
    view = ramp.inputs[-1]
    assert view.shape == (3, 3, *SIZES.far)
    for row in range(3):
        seen = view[row, :2, [20, 30, 40], [40, 60, 80]].mT
        distance = torch.cdist(found.points[row, 0].double(), seen.double()).amin(0)
        torch.testing.assert_close(distance, torch.zeros(3).double(), atol=2e-3, rtol=0)
    assert found.weight.shape == (3, 1, VERTICES_PER_LINE)


def test_rows_without_a_horizon_have_the_whole_image_at_full_size():
    detecting, ramp = detector()
    image = ramp_images(2)
    _, found = detecting.boundary_vertices(image, torch.tensor([[NOWHERE, 250.0], [600.0, 250.0]]))
    assert [tuple(view.shape) for view in ramp.inputs] == [
        (2, 3, 256, 448),
        (1, 3, 128, 544),
        (1, 3, 320, 576),
    ]
    _, full = detecting.boundary_vertices(image[:1])
    torch.testing.assert_close(found.points[:1, :, :6], full.points)
    assert bool((found.weight[0, 0, 6:] == 0).all())


class Quiet(Ramp):
    """A ramp that remembers nothing, as a compiled program must."""

    def forward(self, image):
        return image


@pytest.mark.filterwarnings("ignore")
def test_a_compiled_program_gives_each_row_the_same():
    """It computes both ways for all rows, in one graph."""
    torch.compiler.reset()
    ramp = Quiet()
    detecting = BoundaryDetector(ramp, ramp, 576, None, (), FarView())
    compiled = torch.compile(detecting.boundary_vertices, backend="eager", fullgraph=True)
    image, points = ramp_images(2).clone(), torch.tensor([[600.0, 250.0], [NOWHERE, NOWHERE]])
    expected, found = (each(image, points)[1] for each in (detecting.boundary_vertices, compiled))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


def test_rows_of_a_batch_are_independent():
    detecting, _ = detector()
    image = ramp_images(4).clone()
    image[3, 0, 5, 5] = torch.nan
    points = torch.tensor([[600.0, 250.0], [NOWHERE, NOWHERE], [900.0, 300.0], [600.0, 250.0]])
    _, together = detecting.boundary_vertices(image, points)
    for row in range(4):
        _, alone = detecting.boundary_vertices(image[row : row + 1], points[row : row + 1])
        for one, other in zip(together, alone, strict=True):
            assert torch.equal(one[row : row + 1], other)
    assert bool((together.weight[3] == 0).all()), "expected no vertices of an image that is not finite"


def vertices(x, y, sigma):
    """Vertices of batch size 1 on one boundary."""
    points = torch.tensor([list(zip(x, y, strict=True))]).unsqueeze(1)
    shape = points.shape[:3]
    return BoundaryVertices(points, torch.ones(shape), torch.full(shape, sigma), torch.tensor([[2]]))


def test_merged_vertices_are_in_order_and_none_counts_twice():
    """The far view's replace those of the whole image inside it."""
    whole = vertices([100.0, 110.0, 120.0, 130.0], [400.0, 300.0, 200.0, 100.0], 2.0)
    far = vertices([131.0, 128.0, 125.0, 122.0], [90.0, 120.0, 150.0, 180.0], 1.0)
    inside = torch.tensor([[[False, False, True, True]]])
    merged = merge_vertices(whole, far, inside, HORIZON)
    rows = merged.points[0, 0, :6, 1].tolist()
    assert sorted(rows) == [90.0, 120.0, 150.0, 180.0, 300.0, 400.0]
    assert rows in (sorted(rows), sorted(rows, reverse=True))
    assert merged.weight[0, 0].tolist() == [1.0] * 6 + [0.0] * (VERTICES_PER_LINE - 6)
    by_row = dict(zip(rows, merged.sigma[0, 0].tolist(), strict=False))
    assert by_row[90.0] == 1.0
    assert by_row[400.0] == 2.0
    assert merged.boundary.tolist() == [[2]]


def test_a_boundary_that_the_far_view_hardly_shows_keeps_the_vertices_of_the_whole_image():
    whole = vertices([100.0, 110.0, 120.0, 130.0], [400.0, 300.0, 200.0, 100.0], 2.0)
    far = vertices([131.0, 128.0, 125.0], [90.0, 120.0, 150.0], 1.0)
    merged = merge_vertices(whole, far, torch.ones(1, 1, 4, dtype=torch.bool), HORIZON)
    assert int((merged.weight > 0).sum()) == 7


def test_a_boundary_that_both_views_see_a_lane_apart_is_that_of_the_whole_image():
    """At 100 px below the horizon 250 px are a lane; 20 px are not."""
    whole = vertices([100.0, 110.0, 120.0, 130.0], [400.0, 300.0, 200.0, 100.0], 2.0)
    x, y = [131.0, 128.0, 125.0, 122.0], [120.0, 140.0, 150.0, 180.0]
    apart = vertices([each + 250.0 for each in x], y, 1.0)
    inside = torch.tensor([[[False, False, True, True]]])
    merged = merge_vertices(whole, apart, inside, HORIZON)
    assert sorted(merged.points[0, 0, :4, 1].tolist()) == [100.0, 200.0, 300.0, 400.0]
    assert int((merged.weight > 0).sum()) == 4
    near = merge_vertices(whole, vertices([each + 20.0 for each in x], y, 1.0), inside, HORIZON)
    assert int((near.weight > 0).sum()) == 6
    expected = torch.tensor([[250.0]]) / 100.0
    torch.testing.assert_close(contradiction(whole, apart, HORIZON), expected, atol=0.2, rtol=0)


def test_x_on_rows_is_between_vertices_only():
    """The order of the vertices does not matter, nor what is beyond those with a weight."""
    line = vertices([10.0, 30.0, 20.0, 99.0], [100.0, 300.0, 200.0, 900.0], 1.0)
    line = line._replace(weight=torch.tensor([[[1.0, 1.0, 0.5, 0.0]]]))
    x, there = x_on_rows(line, torch.tensor([[[50.0, 150.0, 250.0, 600.0]]]))
    assert there.tolist() == [[[False, True, True, False]]]
    assert x.tolist() == [[[0.0, 15.0, 25.0, 0.0]]]


def test_inside_is_inside_less_the_edges_where_lines_end():
    corner = torch.tensor([[100, 50]])
    x = (100 + torch.tensor([3.0, 5.0, 538.0, 541.0]) + 0.5) * 1280 / 737 - 0.5
    y = torch.full_like(x, (50 + 60 + 0.5) * 720 / 415 - 0.5)
    points = torch.stack([x, y], -1)[None, None]
    assert inside_far_view(points, corner, SIZES, SIZE)[0, 0].tolist() == [False, True, True, False]
    below = torch.tensor([[[[700.0, (50 + 126.5) * 720 / 415]]]])
    assert not bool(inside_far_view(below, corner, SIZES, SIZE))


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ({"whole": 1.0}, "whole: expected 0.3 to 0.9"),
        ({"rows": 0.1}, "rows: expected"),
        ({"magnification": 0.5}, "magnification: expected 1 to 4"),
        ({"above": 1.5}, "above: expected"),
    ],
)
def test_impossible_far_views_are_refused(values, match):
    with pytest.raises(ValueError, match=match):
        FarView(**values)


def test_wrong_arguments_are_refused_by_name():
    detecting, ramp = detector()
    image = ramp_images(2)
    with pytest.raises(
        ValueError, match=r"vanishing_point: expected \(2, 2\) of floating point, px, got \(2,\)"
    ):
        detecting.boundary_vertices(image, torch.zeros(2))
    with pytest.raises(ValueError, match=r"vanishing_point: .* torch\.int64"):
        detecting.boundary_vertices(image, torch.zeros(2, 2, dtype=torch.int64))
    with pytest.raises(TypeError, match=r"vanishing_point: expected a torch\.Tensor"):
        detecting.boundary_vertices(image, [640.0, 360.0])
    with pytest.raises(
        TypeError, match=r"far_view: expected a lanebev.FarView or None, got True; write FarView\(\)"
    ):
        BoundaryDetector(ramp, ramp, 576, None, (), True)


def test_the_vanishing_point_of_known_angles():
    """Yaw to the left moves it to the right, pitch down moves it up."""
    intrinsics = torch.tensor([[[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]]]).double()
    angles = torch.tensor([0.1]).double(), torch.tensor([0.05]).double()
    found = vanishing_point(*angles, intrinsics)
    expected = [640 + 1000 * torch.tan(angles[1]) / torch.cos(angles[0]), 360 - 1000 * torch.tan(angles[0])]
    torch.testing.assert_close(found[0], torch.cat(expected))
