"""LaneBEV as a module among others: loaded, copied, pickled, in batches of any size, differentiated."""

import copy
import importlib.util
import io
import pickle
from pathlib import Path

import pytest
import torch

from lanebev import (
    BEVGrid,
    BEVWarp,
    JointCalibrator,
    LaneBEV,
    LaneSegmenter,
    LaneSegments,
    TwoStageCalibrator,
)
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes, no_lanes, stack_rows
from tests.calibrators import CALIBRATORS
from tests.pipeline.rows import slopes, started
from tests.pipeline.stand_ins import small_model

DOUBLE = torch.float64
CAMERA = torch.tensor([[[100.0, 0.0, 63.5], [0.0, 100.0, 31.5], [0.0, 0.0, 1.0]]])


def model(seed=0):
    return small_model(JointCalibrator(), seed).eval()


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("lanebev", LaneBEV),
        ("lane_segmenter", LaneSegmenter),
        ("joint_calibrator", JointCalibrator),
        ("two_stage_calibrator", TwoStageCalibrator),
    ],
)
def test_torch_hub_loads_it(name, kind):
    root = str(Path(__file__).parents[2])
    assert isinstance(torch.hub.load(root, name, source="local", trust_repo=True), kind)


def test_torch_hub_lists_no_other_names():
    """As ``torch.hub.list`` finds them: what can be called and has no underscore in front."""
    spec = importlib.util.spec_from_file_location("hubconf", Path(__file__).parents[2] / "hubconf.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    names = {name for name in dir(module) if callable(getattr(module, name)) and not name.startswith("_")}
    assert names == {"lanebev", "lane_segmenter", "joint_calibrator", "two_stage_calibrator"}


@pytest.mark.parametrize("way", ["pickle", "deepcopy", "state_dict"])
def test_a_copy_computes_the_same(way):
    net, image = model(), torch.rand(2, 3, 64, 128)
    if way == "pickle":
        other = pickle.loads(pickle.dumps(net))
    elif way == "deepcopy":
        other = copy.deepcopy(net)
    else:
        file = io.BytesIO()
        torch.save(net.state_dict(), file)
        file.seek(0)
        other = model(seed=1)
        other.load_state_dict(torch.load(file, weights_only=True), strict=True)
    expected, _ = net(image, CAMERA.repeat(2, 1, 1))
    found, _ = other(image, CAMERA.repeat(2, 1, 1))
    assert torch.equal(found.logits, expected.logits)
    assert torch.equal(found.bev, expected.bev)


def rows(count, seed):
    """Rows that see six boundaries, one, none, three, ..."""
    boundaries = ((0, 1, 2, 3, 4, 5), (2,), None, (1, 2, 4))
    frames = []
    for row in range(count):
        seen = boundaries[row % 4]
        frames.append(
            no_lanes() if seen is None else lanes(boundaries=seen, per=48 // len(seen), seed=100 * seed + row)
        )
    return stack_rows(*frames)


@pytest.mark.slow
@CALIBRATORS
def test_64_rows_equal_each_alone(calibrator):
    count, some = 64, (1, 2, 3, 60)
    state = calibrator.initial_state(count, dtype=DOUBLE)
    alone = {row: calibrator.initial_state(1, dtype=DOUBLE) for row in some}
    for frame in range(2):
        segments = rows(count, frame)
        together, state = calibrator(segments, K.expand(count, 3, 3), state, 1 / 30)
        for row in some:
            own = LaneSegments(*(part[row : row + 1] for part in segments))
            found, alone[row] = calibrator(own, K[None], alone[row], 1 / 30)
            pose, other = together.extrinsics.stack()[row], found.extrinsics.stack()[0]
            torch.testing.assert_close(pose, other, rtol=0, atol=1e-6)
            covariance, other = together.covariance[row], found.covariance[0]
            torch.testing.assert_close(covariance, other, rtol=1e-6, atol=1e-12)
            assert together.status[row] == found.status[0]


@CALIBRATORS
@pytest.mark.parametrize("of", ["endpoints", "weight", "intrinsics", "lane_width", "features"])
def test_gradients_of_view_pose_and_covariance_equal_finite_differences(calibrator, of):
    """Rows that track, see one boundary, see nothing, and are lost; along a random direction of an input."""
    generator = torch.Generator().manual_seed(3)
    state = started(calibrator)

    seen = stack_rows(lanes(seed=7), lanes(boundaries=(2,), per=48, seed=8), no_lanes(), no_lanes())
    inputs = {
        "endpoints": seen.endpoints,
        "weight": 0.9 * seen.weight,
        "intrinsics": K.expand(4, 3, 3).clone(),
        "lane_width": torch.full((4, 5), 3.6, dtype=DOUBLE),
        "features": torch.rand(4, 2, 18, 32, generator=generator, dtype=DOUBLE),
    }
    size = {"endpoints": 1e-3, "weight": 1e-5, "intrinsics": 1e-3, "lane_width": 1e-6, "features": 1e-3}[of]
    direction = torch.randn(inputs[of].shape, generator=generator, dtype=DOUBLE)
    if of == "intrinsics":
        direction = direction * torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=DOUBLE)
    if of == "weight":
        direction = direction * (inputs[of] > 0)
    warp = BEVWarp(BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=1.0))
    mix = {}

    def along(step):
        values = {**inputs, of: inputs[of] + step * direction}
        segments = seen._replace(endpoints=values["endpoints"], weight=values["weight"])
        calibration, _ = calibrator(segments, values["intrinsics"], state, 1 / 30, values["lane_width"])
        bev, _ = warp(
            values["features"], values["intrinsics"], calibration.extrinsics, image_size=(720, 1280)
        )
        parts = {"bev": bev, "pose": calibration.extrinsics.stack(), "cov": 1e3 * calibration.covariance}
        for name, part in parts.items():
            mix.setdefault(name, torch.randn(part.shape, generator=generator, dtype=DOUBLE))
        return torch.stack([(part * mix[name]).flatten(1).sum(-1) for name, part in parts.items()])

    analytic, numeric = slopes(along, size)
    assert numeric.abs().max() > 0
    torch.testing.assert_close(analytic, numeric, rtol=2e-3, atol=1e-4 * float(numeric.abs().max()))


def test_hooks_of_segmenter_calibrator_and_warp_run():
    net, ran = model(), []
    for name in ("segmenter", "calibrator", "warp"):
        net.get_submodule(name).register_forward_hook(lambda *_, name=name: ran.append(name))
    net(torch.rand(1, 3, 64, 128), CAMERA)
    assert ran == ["segmenter", "calibrator", "warp"]
