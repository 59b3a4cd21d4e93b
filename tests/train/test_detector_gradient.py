"""What the gradient tells of the pose, and how the pitch follows a crest: known answers."""

import math

import pytest
import torch

from train.detector.crests import AHEAD, elevations, summary
from train.detector.drives import WARM_UP
from train.detector.gradient import rank_correlation, sign_agreement


def test_rank_correlation_of_known_columns():
    error = torch.tensor([0.0, 1.0, 2.0, 3.0])
    first = torch.stack([error.exp(), -error, torch.tensor([1.0, 0.0, 3.0, 2.0])], dim=1)
    second = error[:, None].expand(4, 3)
    assert rank_correlation(first, second) == pytest.approx([1.0, -1.0, 0.6])


def test_signs_are_compared_where_the_error_is_large():
    error = torch.tensor([[0.1, -3.0], [-0.2, 2.0], [3.0, 0.1], [-4.0, 0.2]])
    gradient = torch.tensor([[-1.0, -1.0], [-1.0, -1.0], [1.0, 5.0], [-1.0, 5.0]])
    assert sign_agreement(gradient, error) == pytest.approx([1.0, 2 / 3])


def test_a_pitch_that_follows_the_road_has_regression_one():
    bend = torch.tensor([-1.0, 0.5, 2.0, -0.5])  # 1/km
    elevation = 0.5e-3 * bend[:, None] * torch.tensor(AHEAD).square()
    rows = summary(elevation, elevation[:, 2] / AHEAD[2])
    bend_rms = math.sqrt(5.5 / 4) * 1e-3
    for ahead, (rms, moved, degrees, correlation, regression) in zip(AHEAD, rows, strict=True):
        assert rms == pytest.approx(0.5 * bend_rms * ahead**2)
        assert moved == pytest.approx(0.5 * bend_rms * ahead**3 / 1.5)
        assert degrees == pytest.approx(math.degrees(0.5 * bend_rms * ahead))
        assert correlation == pytest.approx(1.0)
        assert regression == pytest.approx(30.0 / ahead)


def test_the_road_of_a_drive_is_tangent_to_the_plane(tmp_path):
    elevation = elevations(tmp_path / "3.npz", WARM_UP + 2, 10.0)
    assert elevation.shape == (2, len(AHEAD))
    assert elevation[:, 0].abs().max() < 0.02
    assert 0 < elevation[:, 3].abs().max() < 0.5
