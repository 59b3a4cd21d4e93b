"""Everything stays on the device and in the precision that came; --device cuda asks a GPU for it."""

import pytest
import torch

import lanebev
from lanebev import BEVGrid, BEVWarp, Extrinsics
from lanebev.testing.segments import INTRINSICS, lanes
from tests.calibrators import CALIBRATORS

GRID = BEVGrid(resolution=1.0)


def _moved(value, device, dtype):
    """A tensor, or a NamedTuple of tensors, floating ones in the dtype, on the device."""
    if isinstance(value, torch.Tensor):
        return value.to(device, dtype if value.is_floating_point() else None)
    return type(value)(*(_moved(part, device, dtype) for part in value))


def _assert_there(value, device, dtype):
    if isinstance(value, torch.Tensor):
        assert value.device.type == device.type
        assert value.dtype == dtype or not value.is_floating_point()
        assert value.isfinite().all() or not value.is_floating_point()
        return
    for part in value:
        _assert_there(part, device, dtype)


@CALIBRATORS
def test_calibrators(calibrator, device, dtype):
    segments, intrinsics = _moved(lanes(), device, dtype), INTRINSICS[None].to(device, dtype)
    state = calibrator.initial_state(1, dtype=dtype, device=device)
    for _ in range(2):
        calibration, state = calibrator(segments, intrinsics, state, 1 / 30, 3.7)
    _assert_there((calibration, state), device, dtype)
    on_cpu = calibrator.initial_state(1, dtype=torch.float64)
    for _ in range(2):
        expected, on_cpu = calibrator(lanes(), INTRINSICS[None].double(), on_cpu, 1 / 30, 3.7)
    found = calibration.extrinsics.stack().cpu().double()
    torch.testing.assert_close(found, expected.extrinsics.stack(), atol=1e-4, rtol=0)


def test_mount(device, dtype):
    mount = lanebev.MountEstimator()
    calibration = lanebev.Calibration(
        Extrinsics.unstack(torch.tensor([[0.02, -0.01, 0.005, 1.4]], dtype=dtype, device=device)),
        1e-6 * torch.eye(4, dtype=dtype, device=device)[None],
        torch.ones(1, dtype=torch.int64, device=device),
        torch.ones(1, 1, dtype=dtype, device=device),
    )
    mounted, state = mount(calibration, mount.initial_state(1, dtype=dtype, device=device), 0.1)
    _assert_there((mounted, state), device, dtype)


@pytest.mark.parametrize("distortion", [None, (-0.2, 0.03, 0.001, -0.001, 0.0)])
def test_warp(device, dtype, distortion):
    pose = Extrinsics.unstack(torch.tensor([[0.02, -0.01, 0.005, 1.4]], dtype=dtype, device=device))
    lens = None if distortion is None else torch.tensor([distortion], dtype=dtype, device=device)
    image = torch.rand(1, 3, 60, 90, dtype=dtype, device=device)
    intrinsics = torch.tensor([[[80.0, 0, 44.5], [0, 80, 29.5], [0, 0, 1]]], dtype=dtype, device=device)
    _assert_there(BEVWarp(GRID)(image, intrinsics, pose, lens), device, dtype)
    homography = lanebev.bev_from_image(pose, intrinsics, GRID)
    points, valid = lanebev.road_from_image_points(
        torch.tensor([[[40.0, 55.0]]], dtype=dtype, device=device), intrinsics, pose
    )
    _assert_there((homography, points, valid), device, dtype)


def test_lanebev(device):
    network = lanebev.LaneSegmenter(lanebev.SegmenterConfig(base_width=4, decoder_width=8))
    extractor = lanebev.LineExtractor.for_network(network.config)
    model = lanebev.LaneBEV(network, extractor, lanebev.TwoStageCalibrator(), BEVWarp(GRID)).to(device).eval()
    image = torch.rand(1, 2, 3, 64, 96, device=device, requires_grad=True)
    intrinsics = torch.tensor([[[80.0, 0, 47.5], [0, 80, 31.5], [0, 0, 1]]], device=device)
    out, state = model(image, intrinsics)
    _assert_there((out.bev, out.calibration, out.bev_from_image, out.segments, state), device, torch.float32)
    out.bev.sum().backward()
    assert image.grad.isfinite().all()
