"""torch.compile without a graph break equals eager, frame after frame."""

import pytest
import torch

from lanebev import (
    Status,
    TwoStageCalibrator,
)
from lanebev.batch import replace_rows
from lanebev.clips import per_frame
from lanebev.estimation.mount import MountEstimator
from lanebev.tensors import constant
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes, no_lanes, stack_rows
from lanebev.types import Calibration, Extrinsics
from tests.calibrators import QUICK_CALIBRATORS
from tests.pipeline.stand_ins import small_model


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Dynamo detected a call to a `functools.lru_cache`")
@QUICK_CALIBRATORS
def test_calibrators(calibrator):
    """Started, tracking and coasting: what compares the status sees each."""
    torch.compiler.reset()
    compiled = torch.compile(calibrator, backend="eager", fullgraph=True)
    state = other = calibrator.initial_state(2, dtype=torch.float64)
    dt = torch.full((2,), 1 / 30, dtype=torch.float64)
    frames = [
        stack_rows(lanes(seed=0), no_lanes()),
        stack_rows(lanes(seed=1), lanes(seed=2)),
        stack_rows(no_lanes(), lanes(seed=3)),
    ]
    for segments in frames:
        expected, state = calibrator(segments, K.expand(2, 3, 3), state, dt)
        found, other = compiled(segments, K.expand(2, 3, 3), other, dt)
        assert torch.equal(found.status, expected.status)
        torch.testing.assert_close(found.extrinsics.stack(), expected.extrinsics.stack())
        torch.testing.assert_close(found.covariance, expected.covariance)
    assert expected.status.tolist() == [Status.COASTING, Status.TRACKING]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_whole_step():
    """Network, lines, calibrator and view in one graph."""
    torch.compiler.reset()
    net = small_model(TwoStageCalibrator(num_hypotheses=20)).eval()
    compiled = torch.compile(net, backend="eager", fullgraph=True)
    camera = torch.tensor([[[80.0, 0.0, 63.5], [0.0, 80.0, 31.5], [0.0, 0.0, 1.0]]])
    state = other = net.initial_state(1)
    for _ in range(2):
        arguments = (torch.rand(1, 3, 64, 128), camera)
        with torch.no_grad():
            expected, state = net(*arguments, state, torch.tensor([0.05]))
            found, other = compiled(*arguments, other, torch.tensor([0.05]))
        torch.testing.assert_close(found.bev, expected.bev)
        torch.testing.assert_close(found.logits, expected.logits)
        torch.testing.assert_close(found.calibration.covariance, expected.calibration.covariance)


@pytest.mark.slow
def test_mount():
    torch.compiler.reset()
    mount = MountEstimator(block_time=1.0, needed=4)
    compiled = torch.compile(mount, backend="eager", fullgraph=True)
    state = other = mount.initial_state(2)
    poses = torch.tensor([[0.02, -0.01, 0.0, 1.4], [0.02, 0.2, 0.0, 1.4]])  # the second beyond the limits
    cov = 1e-6 * torch.eye(4).expand(2, 4, 4)
    for frame in range(16):
        status = torch.full((2,), int(Status.TRACKING if frame % 7 else Status.COASTING))
        moved = poses + (frame > 10) * torch.tensor([0.05, 0.0, 0.0, 0.0])
        fast = Calibration(Extrinsics.unstack(moved), cov, status, torch.ones(2, 1))
        expected, state = mount(fast, state, torch.full((2,), 0.5))
        found, other = compiled(fast, other, torch.full((2,), 0.5))
        assert torch.equal(found.status, expected.status)
        assert torch.equal(found.reasons, expected.reasons)
        torch.testing.assert_close(found.extrinsics.stack(), expected.extrinsics.stack())


def recording_backend():
    """A list of graphs, and a backend that adds to it."""
    torch.compiler.reset()
    graphs = []

    def backend(module, _):
        graphs.append(module)
        return module.forward

    return graphs, backend


@pytest.mark.filterwarnings("ignore:Dynamo detected a call to a `functools.lru_cache`")
@pytest.mark.slow
@QUICK_CALIBRATORS
def test_numbers_that_vary_make_no_graph_per_frame(calibrator):
    """Every video of variable frame rate: dt as a float, another one in each frame; lanes of a map."""
    graphs, backend = recording_backend()
    compiled = torch.compile(calibrator, backend=backend)
    state = calibrator.initial_state(1, dtype=torch.float64)
    for frame in range(6):
        width = 3.5 + 0.01 * frame
        _, state = compiled(lanes(seed=frame), K[None], state, 0.033 + 1e-4 * frame, width)
    assert len(graphs) <= 2


def test_neither_does_that_of_a_clip():
    graphs, backend = recording_backend()
    compiled = torch.compile(lambda dt, like: 2 * per_frame("dt", dt, 2, 3, like), backend=backend)
    for frame in range(6):
        dt = 0.033 + 1e-4 * frame
        assert torch.equal(compiled(dt, K), torch.full((2, 3), 2 * dt, dtype=K.dtype))
    assert len(graphs) <= 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_rows_replaced_in_an_inductor_program_may_need_constants():
    """Which inductor does not find in a branch of ``torch.cond`` if they are long (torch 2.13)."""
    torch.compiler.reset()

    def added(values):
        return values + constant(((1.0, 2.0, 4.0), (0.0, 5.0, 3.0)), like=values).sum(0)

    def some(rows, values):
        return replace_rows(rows, values, added, values)

    compiled, values = torch.compile(some, fullgraph=True), torch.zeros(2, 3, dtype=torch.float64)
    assert torch.equal(compiled(torch.tensor([False, False]), values), values)
    expected = torch.tensor([[1.0, 7.0, 7.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    assert torch.equal(compiled(torch.tensor([True, False]), values), expected)
