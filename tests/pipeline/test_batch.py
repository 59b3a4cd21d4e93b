"""Operations on rows of a batch."""

import pytest
import torch
from torch.export import Dim

from lanebev import batch
from lanebev.batch import flags, in_blocks, masked_median, order_true_first, replace_rows
from lanebev.estimation.reasons import Reason
from lanebev.tensors import constant
from lanebev.types import Extrinsics


def test_true_entries_come_first_and_both_groups_keep_their_order():
    mask = torch.tensor([[False, True, False, True], [True, True, True, True], [False] * 4])
    assert order_true_first(mask).tolist() == [[1, 3, 0, 2], [0, 1, 2, 3], [0, 1, 2, 3]]
    assert order_true_first(mask[:, :0]).shape == (3, 0)


def test_masked_median_is_the_lower_one_of_what_is_finite_and_in_the_mask():
    values = torch.tensor([[3.0, 1.0, torch.nan, torch.inf, 2.0, 9.0], [5.0, 4.0, 0.0, 0.0, 0.0, 0.0]])
    mask = torch.tensor([[True, True, True, True, True, False], [True, True, False, False, False, False]])
    assert masked_median(values, mask).tolist() == [2.0, 4.0]
    assert masked_median(values, mask & False).tolist() == [0.0, 0.0]


def test_flags_are_the_bits_of_what_holds():
    yes, no = torch.tensor([True, False]), torch.tensor([False, False])
    found = flags({Reason.TIME: yes, Reason.NO_START: no, Reason.LANE_CHANGE: yes})
    assert found.dtype == torch.int64
    assert found.tolist() == [int(Reason.TIME | Reason.LANE_CHANGE), 0]


def _turned(pose, factor):
    return Extrinsics(pose.pitch * factor.sum(-1), pose.yaw + 1, pose.roll, pose.height.abs())


def _replaced(values, factor):
    pose = Extrinsics.unstack(values)
    return replace_rows(pose.roll > 0, pose, _turned, pose, factor).stack()


VALUES = torch.tensor([[1.0, 2.0, 3.0, -4.0], [5.0, 6.0, -7.0, -8.0], [9.0, 8.0, 7.0, 6.0]])
FACTOR = torch.tensor([[1.0, 1.0], [5.0, 5.0], [2.0, 1.0]])
REPLACED = torch.tensor([[2.0, 3.0, 3.0, 4.0], [5.0, 6.0, -7.0, -8.0], [27.0, 9.0, 7.0, 6.0]])


def test_rows_are_replaced_by_a_function_of_them_alone():
    seen = []

    def function(values, factor):
        seen.append(values.shape[0])
        return values * factor.sum(-1, keepdim=True)

    rows = torch.tensor([True, False, True])
    for chosen, count in ((rows, 2), (~rows, 1), (rows | True, 3)):
        found = replace_rows(chosen, VALUES, function, VALUES, FACTOR)
        expected = torch.where(chosen.unsqueeze(-1), VALUES * FACTOR.sum(-1, keepdim=True), VALUES)
        assert torch.equal(found, expected)
        assert seen.pop() == count
    assert replace_rows(rows & False, VALUES, function, VALUES, FACTOR) is VALUES
    assert seen == []
    assert torch.equal(_replaced(VALUES, FACTOR), REPLACED)


@pytest.mark.parametrize(("block", "counts"), [(30, [3]), (16, [2, 1]), (10, [1, 1, 1]), (1, [1, 1, 1])])
def test_a_function_is_applied_to_blocks_of_rows(monkeypatch, block, counts):
    monkeypatch.setattr(batch, "_BLOCK", block)
    seen = []

    def function(pose, factor):
        seen.append(factor.shape[0])
        return _turned(pose, factor), factor.sum(-1)

    pose = Extrinsics.unstack(VALUES)
    turned, total = in_blocks(10, function, pose, FACTOR)
    assert seen == counts
    assert isinstance(turned, Extrinsics)
    assert torch.equal(turned.stack(), _turned(pose, FACTOR).stack())
    assert torch.equal(total, FACTOR.sum(-1))


def test_gradients_flow_through_rows_that_are_replaced_and_kept():
    values, factor = VALUES.double().requires_grad_(), FACTOR.double().requires_grad_()
    assert torch.autograd.gradcheck(_replaced, (values, factor))


@pytest.mark.slow
def test_a_program_replaces_the_rows_that_ask_for_any_number_of_them():
    class Module(torch.nn.Module):
        def forward(self, values, factor):
            return _replaced(values, factor)

    batch = {0: Dim("batch", min=1)}
    program = torch.export.export(Module(), (VALUES[:2], FACTOR[:2]), dynamic_shapes=(batch, batch)).module()
    assert torch.equal(program(VALUES, FACTOR), REPLACED)
    assert torch.equal(program(VALUES[1:2], FACTOR[1:2]), VALUES[1:2])


def test_a_constant_is_made_once_per_dtype_and_takes_part_in_gradients_ever_after():
    numbers = ((1.0, 2.5), (3.0, 4.0))
    with torch.inference_mode():
        first = constant(numbers, like=VALUES)
    assert constant(numbers, like=VALUES) is first
    assert torch.equal(first, torch.tensor(numbers))
    assert constant(numbers, like=VALUES.double()).dtype == torch.float64
    assert constant((1, 2), like=VALUES, dtype=torch.int64).tolist() == [1, 2]
    weight = torch.ones(2, 2, requires_grad=True)
    (weight * first).sum().backward()
    assert torch.equal(weight.grad, first)
