"""Gradients of view, pose and covariance, back to logits and pixels, against finite differences."""

import pytest
import torch

from lanebev import BEVGrid, BEVWarp, JointCalibrator, LineExtractor
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes
from tests.calibrators import CALIBRATORS
from tests.pipeline.rows import slopes, started

DOUBLE = torch.float64
IMAGE, NETWORK, MAP = (720, 1280), (180, 320), (90, 160)  # (H, W) px, px, cells
SEEN = (
    (0, 1, 2, 3, 4, 5),
    (2,),
    (),
    (0, 1, 2, 3, 4, 5),
)  # boundaries; nothing was known of the last row's pose


def painted():
    """(4, 7, h, w) maps of background and boundaries, 2 on smooth stripes where the lanes of a row are."""
    ends = lanes(noise=0.0).endpoints[0].unflatten(0, (6, -1)).flatten(1, 2)  # (6, points, 2)
    ends = (ends + 0.5) / 8 - 0.25  # cell j is centred on pixel 8 j + 1.5
    (x0, y0), (x1, y1) = ((ends.gather(1, at.expand(6, 1, 2)))[:, 0].unbind(-1) for at in _outermost(ends))
    slope = ((x1 - x0) / (y1 - y0))[:, None, None]
    rows, columns = torch.meshgrid(*(torch.arange(side, dtype=DOUBLE) for side in MAP), indexing="ij")
    off = (columns - x0[:, None, None] - slope * (rows - y0[:, None, None])) / (1 + slope.square()).sqrt()
    stripes = 2 * torch.exp(-((off / 1.2) ** 4)) * torch.sigmoid(rows - 48)
    maps = torch.zeros(4, 7, *MAP, dtype=DOUBLE)
    maps[:, 0] = 1.0
    for row, boundaries in enumerate(SEEN):
        maps[row, [1 + boundary for boundary in boundaries]] = stripes[list(boundaries)]
    return maps


def _outermost(ends):
    """Indices (6, 1, 1) of each boundary's highest and lowest points."""
    return ends[..., 1].argmin(1)[:, None, None], ends[..., 1].argmax(1)[:, None, None]


@pytest.mark.parametrize("of", [pytest.param("logits", marks=pytest.mark.slow), "pixels"])
@CALIBRATORS
def test_gradients_back_to_logits_and_pixels_equal_finite_differences(calibrator, of):
    """Rows that see six boundaries, one, none, and that are lost; along a random direction.

    The joint calibrator starts the lost row by the single-frame fit, whose gradient is that of its last two
    steps alone: there it is finite, and not compared.
    """
    generator = torch.Generator().manual_seed(5)
    state, extractor, maps = started(calibrator), LineExtractor(), painted()
    warp = BEVWarp(BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=1.0))
    direction = torch.randn(maps.shape, generator=generator, dtype=DOUBLE)
    mix = {}

    def along(step):
        moved = maps + step * direction
        segments = extractor(8 * moved, IMAGE, NETWORK)
        calibration, _ = calibrator(segments, K.expand(4, 3, 3), state, 1 / 30)
        image = moved if of == "pixels" else maps
        bev, _ = warp(image, K.expand(4, 3, 3), calibration.extrinsics, image_size=IMAGE)
        parts = {"bev": bev, "pose": calibration.extrinsics.stack(), "cov": 1e3 * calibration.covariance}
        for name, part in parts.items():
            mix.setdefault(name, torch.randn(part.shape, generator=generator, dtype=DOUBLE))
        assert (segments.weight > 0).any(1).tolist() == [True, True, False, True]
        return torch.stack([(part * mix[name]).flatten(1).sum(-1) for name, part in parts.items()])

    analytic, numeric = slopes(along, 1e-6)  # (3, 4)
    assert (numeric[:, [0, 3]].abs() > 1e-9).all()  # what is seen matters, to all three
    if of == "pixels":
        assert numeric[0, 2].abs() > 1e-3  # of the row that sees nothing, to the view
    assert analytic.isfinite().all()
    compared = slice(0, 3 if isinstance(calibrator, JointCalibrator) else 4)
    for got, expected in zip(analytic[:, compared], numeric[:, compared], strict=True):
        scale = float(expected.abs().max())
        torch.testing.assert_close(got, expected, rtol=2e-3, atol=1e-4 * scale)


@CALIBRATORS
@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE], ids=str)
def test_frames_without_gradients_may_come_before_frames_with_them(calibrator, dtype):
    """Computed in inference mode, whose tensors no graph accepts, but returned as others."""
    state, intrinsics = calibrator.initial_state(1, dtype=dtype), K[None].to(dtype)
    _, expected = calibrator(lanes(seed=0), intrinsics, state, 1 / 30)
    with torch.no_grad():
        calibration, state = calibrator(lanes(seed=0), intrinsics, state, 1 / 30)
    for one, other in zip(state, expected, strict=True):
        assert not one.is_inference()
        assert torch.equal(one, other)
    assert not any(part.is_inference() for part in (*calibration.extrinsics, *calibration[1:]))
    camera = intrinsics.clone().requires_grad_()
    calibration, _ = calibrator(lanes(seed=1), camera, state, 1 / 30)
    calibration.extrinsics.pitch.sum().backward()
    assert camera.grad.isfinite().all()
    assert camera.grad[0, 1, 2] != 0


def test_forward_mode_derivatives_are_there_without_gradients():
    calibrator = JointCalibrator()
    state = calibrator.initial_state(1, dtype=DOUBLE)
    _, state = calibrator(lanes(seed=0), K[None], state, 1 / 30)

    def pitch(camera):
        return calibrator(lanes(seed=1), camera, state, 1 / 30)[0].extrinsics.pitch

    along = torch.zeros_like(K[None])
    along[0, 1, 2] = 1.0
    _, expected = torch.func.jvp(pitch, (K[None],), (along,))
    with torch.no_grad():
        _, found = torch.func.jvp(pitch, (K[None],), (along,))
    torch.testing.assert_close(found, expected)
    assert found.abs() > 1e-5
