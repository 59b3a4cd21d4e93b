"""Operations on rows of a batch."""

import torch

from lanebev.batch import masked_median


def test_masked_median_is_the_lower_one_of_what_is_finite_and_in_the_mask():
    values = torch.tensor([[3.0, 1.0, torch.nan, torch.inf, 2.0, 9.0], [5.0, 4.0, 0.0, 0.0, 0.0, 0.0]])
    mask = torch.tensor([[True, True, True, True, True, False], [True, True, False, False, False, False]])
    assert masked_median(values, mask).tolist() == [2.0, 4.0]
    assert masked_median(values, mask & False).tolist() == [0.0, 0.0]
