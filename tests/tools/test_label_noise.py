"""The measure of labels against the paint they mark."""

import math

import numpy as np
import pytest
import torch

from lanebev import LaneSegments
from lanebev.estimation.joint.frame.single_frame import fit_single_frame
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes
from tools.label_noise import line_offsets, split_half_yaw, stripe_centre


def row_with(*stripes: tuple[int, int]) -> np.ndarray:
    """A dark row of 200 px with stripes from one px to another, exclusive."""
    row = np.full(200, 60, np.uint8)
    for first, last in stripes:
        row[first:last] = 200
    return row


def test_centre_of_a_stripe_and_nothing_where_it_is_not_clear():
    assert stripe_centre(row_with((95, 104)), 103.0) == pytest.approx(99.0)
    assert math.isnan(stripe_centre(row_with(), 100.0))
    assert math.isnan(stripe_centre(row_with((90, 94), (100, 104)), 100.0))  # two stripes
    assert math.isnan(stripe_centre(row_with((99, 100)), 100.0))  # a stone
    assert math.isnan(stripe_centre(row_with((8, 14)), 10.0))  # cut by the image's edge


def test_offsets_of_label_and_line_from_a_stripe():
    grey = np.stack([row_with((95, 104))] * 500)
    rows, horizon = np.arange(300, 500, 10.0), 240.0
    beside = 99.0 + 8.0 * (rows - horizon) / 200.0  # a line beside the stripe on the road meets it there
    turned = np.full(20, 97.5)
    label, line = line_offsets(grey, rows, beside, turned, horizon)
    assert label.mean == pytest.approx(8.0 * (415 - horizon) / 200.0)
    assert label.horizon == pytest.approx(0.0, abs=1e-9)
    assert line == pytest.approx((-1.5, -1.5))


def test_lines_without_enough_paint_do_not_count():
    grey = np.stack([row_with((95, 104))] * 500)
    rows, x = np.arange(400, 500, 10.0), np.full(10, 99.0)
    assert line_offsets(grey, rows, x, x, 240.0) is None  # 90 px only
    rows, x = np.arange(300, 500, 10.0), np.full(20, 99.0)
    assert line_offsets(grey, rows, x + 40, x, 240.0) is None  # another stripe


@pytest.mark.slow
def test_halves_of_lines_differ_by_twice_what_all_of_them_err():
    """And exact ones not at all."""
    pose, straight = (0.03, -0.02, 0.015, 1.5), FramePrior(curvature_std=1e-6, curvature_rate_std=1e-8)
    drawn = [lanes(pose, (1, 2, 3, 4), per=24, noise=4.0, seed=seed) for seed in range(120)]
    noisy, cameras = (
        LaneSegments(*(torch.cat(parts) for parts in zip(*drawn, strict=True))),
        K.expand(120, 3, 3),
    )
    halves = split_half_yaw(noisy, cameras, straight)
    error = fit_single_frame(noisy, cameras, prior=straight).extrinsics.yaw - pose[1]
    assert len(halves) == 120
    assert 0.8 < float(halves.square().mean().sqrt() / error.square().mean().sqrt()) < 1.2
    exact, three = (lanes(pose, boundaries, noise=0.0) for boundaries in ((1, 2, 3, 4), (1, 2, 3)))
    assert float(split_half_yaw(exact, K[None], FramePrior()).max()) < 1e-6
    assert len(split_half_yaw(three, K[None], FramePrior())) == 0
