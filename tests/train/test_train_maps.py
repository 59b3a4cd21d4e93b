"""Label maps drawn on the device against those that OpenCV draws."""

import numpy as np
import pytest
import torch

from lanebev.render import draw_stripes, render_views
from train.labels import ViewConfig, full_view
from train.maps import boundaries_as_taken, label_maps
from train.pool import labelled_images

VIEW = ViewConfig()
SIZE = (128, 224)


@pytest.fixture(scope="module")
def frame():
    return render_views(3, SIZE, torch.Generator().manual_seed(4))


@pytest.fixture(scope="module")
def maps(frame):
    return label_maps(boundaries_as_taken(frame), frame.painted > 0.5, frame.visible > 0.5, SIZE, VIEW)


@pytest.fixture(scope="module")
def by_opencv(frame):
    return [full_view(sample, SIZE, VIEW) for sample in labelled_images(frame)]


def test_equal_opencvs_up_to_their_edges(maps, by_opencv):
    for row, view in enumerate(by_opencv):
        target = torch.from_numpy(view.target) / 255
        drawn = target.sum(0) > 0
        assert drawn.any()
        off = (maps.target[row] - target).abs()
        assert off.sum() < 0.15 * target.sum()  # of the mass
        assert off.mean() < 2e-3
        assert (maps.weight[row] == torch.from_numpy(view.weight).bool()).float().mean() > 0.99


def test_row_centres_are_those_of_the_line():
    """x = 20.3 + 0.08 (y + 5), on every row to 0.07 px."""
    line = torch.tensor([[20.3, -5.0], [26.3, 70.0]])
    stripe = draw_stripes(line, torch.ones(2), (64, 48), VIEW.half_width).double()
    rows = torch.arange(64)
    centre = (stripe * torch.arange(48)).sum(1) / stripe.sum(1)
    assert (centre - (20.3 + 0.08 * (rows + 5))).abs().max() < 0.07
    width = 2 * VIEW.half_width * np.hypot(1, 0.08)
    torch.testing.assert_close(stripe.sum(1), torch.full((64,), width).double(), atol=0.1, rtol=0)


def test_rows_of_a_batch_are_drawn_alone(frame, maps):
    one = label_maps(
        boundaries_as_taken(frame)[1:2], frame.painted[1:2] > 0.5, frame.visible[1:2] > 0.5, SIZE, VIEW
    )
    torch.testing.assert_close(one.target[0], maps.target[1])
    torch.testing.assert_close(one.weight[0], maps.weight[1])


def test_points_that_are_no_numbers_or_far_away_draw_nothing():
    line = torch.tensor([[5.0, 5.0], [torch.nan, 3.0], [1e9, 0.0], [5.0, 20.0]])
    assert draw_stripes(line, torch.ones(4), (32, 32), 1.0).sum() == 0


def test_long_pieces_have_no_holes():
    stripe = draw_stripes(torch.tensor([[-30.0, 16.0], [80.0, 16.0]]), torch.ones(2), (32, 32), 1.0)
    torch.testing.assert_close(stripe[16], torch.ones(32))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_the_device_they_are_the_same(frame, maps):
    points, painted, visible = (
        part.cuda() for part in (boundaries_as_taken(frame), frame.painted > 0.5, frame.visible > 0.5)
    )
    there = label_maps(points, painted, visible, SIZE, VIEW)
    torch.testing.assert_close(there.target.cpu(), maps.target, atol=1e-4, rtol=0)
