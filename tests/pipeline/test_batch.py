import torch

from lanebev.batch import order_true_first


def test_true_entries_come_first_and_both_groups_keep_their_order():
    mask = torch.tensor([[False, True, False, True], [True, True, True, True], [False] * 4])
    assert order_true_first(mask).tolist() == [[1, 3, 0, 2], [0, 1, 2, 3], [0, 1, 2, 3]]
    assert order_true_first(mask[:, :0]).shape == (3, 0)
