import numpy as np
import pytest
import torch

from train.labels import LabelledImage, ViewConfig, draw_boundaries, full_view, random_view, separated
from train.losses import boundary_cross_entropy, row_cross_entropy, unweighted_bias


def test_cross_entropy_of_one_pixel():
    """p = (1/2, 1/4, 1/4), label (0, 3/4, 1/4): -3/4 log 1/4 - 1/4 log 1/4 = log 4."""
    logits = torch.log(torch.tensor([2.0, 1.0, 1.0])).view(1, 3, 1, 1).double()
    target = torch.tensor([0.0, 0.75, 0.25]).view(1, 3, 1, 1).double()
    loss = boundary_cross_entropy(logits, target, torch.ones(1, 1, 1))
    assert loss.item() == pytest.approx(np.log(4))
    weighted = boundary_cross_entropy(logits, target, torch.ones(1, 1, 1), torch.tensor([1.0, 2.0, 1.0]))
    assert weighted.item() == pytest.approx(np.log(4) * 1.75)


def test_pixels_of_weight_zero_do_not_count():
    logits = torch.randn(1, 3, 1, 2)
    target = torch.softmax(torch.randn(1, 3, 1, 2), 1)
    both = boundary_cross_entropy(logits, target, torch.tensor([[[1.0, 0.0]]]))
    first = boundary_cross_entropy(logits[..., :1], target[..., :1], torch.ones(1, 1, 1))
    torch.testing.assert_close(both, first)


def test_class_weights_are_undone():
    """The loss' minimum under class weights, plus the bias, is the label's frequency."""
    frequency = torch.tensor([0.9, 0.07, 0.03], dtype=torch.float64)
    weights = torch.tensor([0.3, 1.0, 2.0], dtype=torch.float64)
    logits = torch.zeros(1, 3, 1, 1, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([logits], max_iter=100, tolerance_grad=1e-12, line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        loss = boundary_cross_entropy(logits, frequency.view(1, 3, 1, 1), torch.ones(1, 1, 1), weights)
        loss.backward()
        return loss

    optimizer.step(closure)
    learned = logits.detach().flatten()
    assert learned.softmax(0)[0] < 0.8  # moved away from the frequency
    torch.testing.assert_close((learned + unweighted_bias(weights)).softmax(0), frequency, atol=1e-5, rtol=0)


def test_row_loss_says_where():
    target = torch.zeros(1, 2, 2, 4)
    target[0, 1, 0, 2] = 1  # row 0 has the boundary at column 2; row 1 has none
    target[:, 0] = 1 - target[:, 1]
    flat = torch.zeros(1, 2, 2, 4)
    assert row_cross_entropy(flat, target, torch.ones(1, 2, 4)).item() == pytest.approx(np.log(4))
    right = flat.clone()
    right[0, 1, 0, 2] = 30
    assert row_cross_entropy(right, target, torch.ones(1, 2, 4)).item() < 3  # saturates in the softmax
    assert row_cross_entropy(flat, 0 * target, torch.ones(1, 2, 4)).item() == 0


def test_drawn_stripe_is_centred_and_as_wide_as_asked():
    points = np.full((2, 2, 2), np.nan, np.float32)
    points[0] = [[20.3, -5], [25.9, 70]]
    maps = draw_boundaries(points, np.isfinite(points).all(-1), (64, 48), 1.125).astype(float) / 255
    columns = np.arange(48)
    errors = []
    for row in range(2, 62):
        mass = maps[0, row].sum()
        assert mass == pytest.approx(2 * 1.125 / np.cos(np.arctan(5.6 / 75)), abs=0.15)
        errors.append((maps[0, row] * columns).sum() / mass - (20.3 + 5.6 * (row + 5) / 75))
    assert np.abs(errors).max() < 0.2
    assert abs(np.mean(errors)) < 0.05
    assert maps[1].max() == 0


def test_stripes_share_where_they_overlap():
    points = np.tile(np.array([[10, 0], [10, 40]], np.float32), (3, 1, 1))
    maps = draw_boundaries(points, np.ones((3, 2), bool), (32, 20), 1.125)
    assert maps.sum(0).max() <= 256
    np.testing.assert_array_equal(maps[0], maps[2])


def test_boundaries_that_cannot_be_told_apart_are_left_out():
    points = torch.tensor([[[0, 10], [9, 0]], [[10, 10], [10, 0]], [[20, 10], [11, 0]]]).double()
    keep = separated(points, torch.ones(3, 2).bool(), gap=2.0)
    assert keep.tolist() == [[True, False], [True, False], [True, False]]
    alone = separated(points, torch.tensor([[1, 1], [0, 0], [0, 0]]).bool(), gap=2.0)
    assert alone.tolist() == [[True, True], [False, False], [False, False]]


def bright_line(slot=1):
    """An image whose only bright pixels lie on boundary ``slot`` of three."""
    start, end = np.array([120.0, 150.0]), np.array([170.0, 40.0])
    y, x = np.mgrid[0:160, 0:280]
    direction = (end - start) / np.linalg.norm(end - start)
    distance = np.abs((x - start[0]) * -direction[1] + (y - start[1]) * direction[0])
    image = np.where((distance < 2)[..., None], 255, 0).astype(np.uint8).repeat(3, -1)
    points = np.full((3, 20, 2), np.nan, np.float32)
    points[slot] = start + np.linspace(-0.3, 1.3, 20)[:, None] * (end - start)
    there = np.isfinite(points).all(-1)
    return LabelledImage(image, points, there, there, np.array([190, 20], np.float32))


def centre_error(view, slot):
    """Offset in label px between label stripe and bright stripe, over rows that have both."""
    bright, label = view.image[0, ::2].astype(float), view.target[slot].astype(float)
    place = np.arange(label.shape[1])
    rows = (bright.sum(1) > 300) & (label.sum(1) > 300) & (label[:, :4].sum(1) + label[:, -4:].sum(1) == 0)
    assert rows.sum() > 10
    in_image = (bright @ np.arange(bright.shape[1]) / np.maximum(bright.sum(1), 1))[rows] / 2
    return np.abs(in_image - (label @ place / np.maximum(label.sum(1), 1))[rows]).mean()


def test_views_warp_image_and_labels_alike():
    rng = np.random.default_rng(3)
    config = ViewConfig(rotation_deg=4.0, flip=0.0)
    assert centre_error(full_view(bright_line(), (96, 168), config), 1) < 0.3
    for _ in range(8):
        assert centre_error(random_view(bright_line(), (96, 168), config, rng), 1) < 0.3


def test_mirroring_renumbers():
    rng = np.random.default_rng(3)
    view = random_view(bright_line(slot=0), (96, 168), ViewConfig(rotation_deg=1.0, flip=1.0), rng)
    assert centre_error(view, 2) < 0.3
    assert view.target[0].max() == 0


def test_hidden_boundaries_are_not_judged():
    sample = bright_line()
    visible = sample.visible.copy()
    visible[1, 8:] = False
    view = full_view(sample._replace(visible=visible), (96, 168), ViewConfig())
    assert (view.weight == 0).any()
    assert (view.target[1][view.weight == 0] == 0).all()
