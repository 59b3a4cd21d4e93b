"""The agreement of the detector's gradient with the error of the pose: known answers."""

import pytest
import torch

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
