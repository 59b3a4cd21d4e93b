import torch

from lanebev.batch import flags, order_true_first
from lanebev.estimation.reasons import Reason


def test_true_entries_come_first_and_both_groups_keep_their_order():
    mask = torch.tensor([[False, True, False, True], [True, True, True, True], [False] * 4])
    assert order_true_first(mask).tolist() == [[1, 3, 0, 2], [0, 1, 2, 3], [0, 1, 2, 3]]
    assert order_true_first(mask[:, :0]).shape == (3, 0)


def test_flags_are_the_bits_of_what_holds():
    yes, no = torch.tensor([True, False]), torch.tensor([False, False])
    found = flags({Reason.TIME: yes, Reason.NO_START: no, Reason.LANE_CHANGE: yes})
    assert found.dtype == torch.int64
    assert found.tolist() == [int(Reason.TIME | Reason.LANE_CHANGE), 0]
