"""LaneBEV as a layer: shapes, batches over time, gradients from the view back to the image."""

from dataclasses import replace

import pytest
import torch

from lanebev import (
    HILLY_ROADS,
    BEVGrid,
    BEVWarp,
    ImageFromBEV,
    JointCalibrator,
    LaneBEV,
    LaneSegmenter,
    LaneSegments,
    LineExtractor,
    MountEstimator,
    Status,
    TwoStageCalibrator,
)
from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.layout import layout
from lanebev.estimation.joint.measurement.residuals import VERTICAL
from lanebev.observation.frames import resized_size
from lanebev.observation.segmenter import SegmenterConfig
from lanebev.pipeline import STAGES
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes
from lanebev.types import Extrinsics
from lanebev.weights import save_segmenter
from tests.calibrators import CALIBRATORS
from tests.pipeline.stand_ins import (
    GRID,
    INTRINSICS,
    SIZE,
    BrightnessSegmenter,
    FixedExtractor,
    images,
    model,
)


def test_one_frame():
    out, state = model()(images(2), INTRINSICS.expand(2, 3, 3), None, dt=0.05)
    assert out.bev.shape == (2, 3, *GRID.shape)
    assert out.valid.shape == (2, 1, *GRID.shape)
    assert out.valid.dtype == torch.bool
    assert out.bev_from_image.shape == (2, 3, 3)
    assert out.logits.shape == (2, 7, *SIZE)
    assert out.segments.endpoints.shape == (2, 48, 2, 2)
    assert out.calibration.status.tolist() == [Status.TRACKING] * 2
    assert state.status.tolist() == [Status.TRACKING] * 2


def test_each_frame_of_a_clip_may_have_its_own_camera():
    """As where every frame is cropped in another way: equal to frame by frame."""
    layer, clip = model(), images(2, 3)
    zooms = torch.tensor([[1.0, 1.1, 0.9], [1.2, 1.0, 1.0]], dtype=torch.float64)
    cameras = INTRINSICS.repeat(2, 3, 1, 1)
    cameras[..., 0, 0] *= zooms
    cameras[..., 1, 1] *= zooms
    together, after = layer(clip, cameras, dt=0.05)
    state = None
    for step in range(3):
        alone, state = layer(clip[:, step], cameras[:, step], state, dt=0.05)
        torch.testing.assert_close(together.bev[:, step], alone.bev, rtol=0, atol=0)
        torch.testing.assert_close(together.bev_from_image[:, step], alone.bev_from_image, rtol=0, atol=0)
        torch.testing.assert_close(
            together.calibration.covariance[:, step], alone.calibration.covariance, rtol=0, atol=0
        )
    assert all(torch.equal(*pair) for pair in zip(after, state, strict=True))
    same, _ = layer(clip, INTRINSICS.repeat(2, 1, 1), dt=0.05)
    expected, _ = layer(clip, INTRINSICS.repeat(2, 3, 1, 1), dt=0.05)
    assert torch.equal(same.bev, expected.bev)
    assert not torch.equal(same.bev, together.bev)
    with pytest.raises(ValueError, match=r"intrinsics: expected \(2, 3, 3, 3\), got \(2, 2, 3, 3\)"):
        layer(clip, cameras[:, :2])
    with pytest.raises(ValueError, match=r"intrinsics: expected \(2, 3, 3\), got \(2, 3, 3, 3\)"):
        layer(clip[:, 0], cameras)


def test_the_view_follows_the_roads_vertical_curvature():
    """It is the warp's own with what the calibrator says of the road, in every row."""
    layer = model()
    layer.calibrator = JointCalibrator(HILLY_ROADS)
    image, intrinsics = images(2), INTRINSICS.expand(2, 3, 3)
    out, state = layer(image, intrinsics)
    state = state._replace(mean=state.mean.clone())
    state.mean[:, VERTICAL] = torch.tensor([2e-3, -2e-3], dtype=torch.float64)
    out, state = layer(image, intrinsics, state)
    curvature = layer.calibrator.vertical_curvature(state)
    pose = out.calibration.extrinsics
    expected, valid = layer.warp(image, intrinsics, pose, vertical_curvature=curvature)
    assert torch.equal(out.bev, expected)
    assert torch.equal(out.valid, valid)
    assert (out.bev - layer.warp(image, intrinsics, pose)[0]).abs().amax((1, 2, 3)).min() > 0.01


def test_frames_at_once_equal_frames_one_by_one():
    net, frames = model(), images(2, 3)
    dt = torch.tensor([[0.1, 0.03, 0.04], [0.1, 0.05, 0.02]], dtype=torch.float64)
    together, last = net(frames, INTRINSICS.expand(2, 3, 3), None, dt)
    assert together.bev.shape == (2, 3, 3, *GRID.shape)
    state = None
    for step in range(3):
        one, state = net(frames[:, step], INTRINSICS.expand(2, 3, 3), state, dt[:, step])
        assert torch.equal(together.bev[:, step], one.bev)
        assert torch.equal(together.calibration.covariance[:, step], one.calibration.covariance)
        assert isinstance(together.calibration.extrinsics, Extrinsics)
    assert all(map(torch.equal, last, state))


def test_the_speed_may_be_given_with_every_frame():
    """At once and one by one, in one row only; where it is not a number it is not known."""
    net = LaneBEV(BrightnessSegmenter(), FixedExtractor(), JointCalibrator(), BEVWarp(GRID))
    frames, cameras = images(2, 3), INTRINSICS.expand(2, 3, 3)
    speed = torch.tensor([[8.0, torch.nan, 9.0], [torch.nan] * 3])
    _, together = net(frames, cameras, speed=speed)
    _, unknown = net(frames, cameras)
    state = None
    for step in range(3):
        _, state = net(frames[:, step], cameras, state, speed=speed[:, step])
    assert all(map(torch.equal, together, state))
    assert torch.equal(together.mean[1], unknown.mean[1])
    place = layout(6).speed
    assert MotionConfig().speed + together.mean[0, place].item() == pytest.approx(9.0, abs=0.4)
    assert unknown.mean[0, place] == 0


def test_gradients_flow_from_the_view_to_image_and_weights():
    net, frames = model(), images(1, 2).requires_grad_()
    out, _ = net(frames, INTRINSICS[None], None)
    out.calibration.extrinsics.pitch[:, -1].sum().backward(retain_graph=True)
    assert frames.grad[:, 1].abs().sum() > 0  # through network, lines and filter alone
    assert frames.grad[:, 0].abs().sum() > 0  # and through time
    frames.grad = None
    out.bev.sum().backward()
    assert frames.grad.isfinite().all()
    assert net.segmenter.gain.grad.abs() > 0


def test_lens_is_taken_out_of_the_segments():
    distortion = torch.tensor([[-0.2, 0.03, 0.0, 0.0, 0.0]], dtype=torch.float64)
    straight, _ = model()(images(1) * 0, INTRINSICS[None], None)
    bent, _ = model(distortion=distortion)(images(1) * 0, INTRINSICS[None], None, distortion=distortion)
    torch.testing.assert_close(
        bent.calibration.extrinsics.stack(), straight.calibration.extrinsics.stack(), atol=1e-5, rtol=0
    )


def test_every_frame_has_the_camera_and_the_lens_of_its_row():
    cameras = torch.stack([INTRINSICS, INTRINSICS * torch.tensor([[1.2], [1.2], [1.0]], dtype=torch.float64)])
    lenses = torch.tensor([[-0.2, 0.03, 0, 0, 0], [0.1, 0.0, 0, 0, 0]], dtype=torch.float64)
    net, frames = model(), images(2, 2)
    both, _ = net(frames, cameras, None, distortion=lenses)
    for row in range(2):
        own, _ = net(frames[row, None], cameras[row, None], None, distortion=lenses[row, None])
        torch.testing.assert_close(both.segments.endpoints[row], own.segments.endpoints[0])
        torch.testing.assert_close(both.bev[row], own.bev[0])


def test_network_sees_its_width_and_the_rest_does_not():
    net = model(network_width=64)
    net(images(1), INTRINSICS[None], None)
    assert net.segmenter.seen == [(1, 3, 32, 64)]


@pytest.mark.parametrize(
    ("image", "size"),
    [
        ((720, 1280), (320, 576)),  # what the network was trained for
        ((512, 1024), (288, 576)),
        ((480, 640), (448, 576)),
        ((375, 1242), (224, 768)),  # KITTI
        ((590, 1640), (256, 704)),  # CULane
        ((188, 624), (160, 576)),  # no more than it has itself
    ],
)
def test_a_wide_image_has_about_as_many_pixels(image, size):
    assert resized_size(image, 576, 320 * 576) == size
    assert resized_size(image, 576, None) == (32 * round(576 * image[0] / image[1] / 32), 576)


def test_the_order_of_an_image_in_memory_changes_nothing():
    layer = LaneBEV.from_pretrained().eval()
    image = torch.rand(1, 3, 96, 160, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        found = [
            layer.boundary_vertices(image.contiguous(memory_format=order))[0]
            for order in (torch.contiguous_format, torch.channels_last)
        ]
    assert torch.equal(*found)


def test_the_pose_is_less_sure_by_the_networks_factor():
    plain, _ = model()(images(1), INTRINSICS[None], None)
    widened, _ = model(pose_sigma_scale=2.0)(images(1), INTRINSICS[None], None)
    torch.testing.assert_close(widened.calibration.covariance, 4 * plain.calibration.covariance)
    assert torch.equal(widened.calibration.extrinsics.stack(), plain.calibration.extrinsics.stack())
    assert small().pose_sigma_scale == 1.6  # as the segmenter says


def test_parts_that_number_other_boundaries_are_refused():
    net = LaneSegmenter(replace(SMALL, num_boundaries=4))
    with pytest.raises(
        ValueError, match=r"num_boundaries: expected the same of segmenter and calibrator, got 4 and 6"
    ):
        LaneBEV(net, LineExtractor(), JointCalibrator())
    LaneBEV(net, LineExtractor(), JointCalibrator(num_boundaries=4))


def test_pretrained_of_any_number_of_boundaries_gets_a_calibrator_of_as_many(tmp_path):
    net = LaneSegmenter(replace(SMALL, num_boundaries=4))
    save_segmenter(net, tmp_path / "four.safetensors")
    made = LaneBEV.from_pretrained(tmp_path / "four.safetensors")
    assert made.calibrator.config.num_boundaries == 4
    assert LaneBEV.from_pretrained().calibrator.config.num_boundaries == 6


@pytest.mark.parametrize("calibrator", [TwoStageCalibrator, JointCalibrator])
def test_no_part_needs_a_device_with_double_precision(calibrator):
    made = LaneBEV.from_pretrained(calibrator=calibrator())
    assert {name for name, part in made.named_buffers() if part.dtype == torch.float64} == set()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@CALIBRATORS
def test_what_is_done_to_the_output_is_not_done_to_the_state(calibrator, dtype):
    state = calibrator.initial_state(1, dtype=dtype)
    for seed in range(3):
        out, state = calibrator(lanes(seed=seed), K[None], state, 1 / 30)
    before = [part.clone() for part in state]
    for part in (*out.extrinsics, out.covariance, out.status, out.inliers):
        part.fill_(7)
    for old, new in zip(before, state, strict=True):
        torch.testing.assert_close(new, old, rtol=0, atol=0)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_image_that_is_not_finite_spoils_no_other_row_and_no_gradient(value):
    made = small().double()
    image = images(2)
    image[0, 1, 3, 5] = value
    out, _ = made(image, INTRINSICS.expand(2, 3, 3), made.initial_state(2, dtype=torch.float64))
    out.logits[1].square().mean().backward()
    assert all(bool(part.grad.isfinite().all()) for part in made.parameters() if part.grad is not None)
    assert not out.segments.weight[0].any()
    assert int(out.calibration.status[0]) == Status.UNINITIALISED
    alone, _ = made(image[1:], INTRINSICS[None], made.initial_state(1, dtype=torch.float64))
    torch.testing.assert_close(alone.bev, out.bev[1:])


@pytest.mark.parametrize("value", [float("nan"), 0.0])
@CALIBRATORS
def test_a_camera_that_cannot_be_used_spoils_no_gradient_behind_a_lens(calibrator, value):
    made, bad = small(calibrator).double(), torch.full((3, 3), value).double()
    lens = torch.tensor([[-0.1, 0.01, 0.0, 0.0]] * 2, dtype=torch.float64)
    state = made.initial_state(2, dtype=torch.float64)
    out, _ = made(images(2), torch.stack([bad, INTRINSICS]), state, distortion=lens)
    (out.segments.endpoints[1].sum() + out.segments.sigma[1].sum() + out.bev[1].sum()).backward()
    assert all(bool(part.grad.isfinite().all()) for part in made.parameters() if part.grad is not None)
    assert not out.segments.weight[0].any()


@CALIBRATORS
def test_cameras_of_whole_numbers_are_named(calibrator):
    with pytest.raises(ValueError, match=r"intrinsics: expected floating point, got torch.int64"):
        calibrator(lanes(), K[None].long(), calibrator.initial_state(1), 1 / 30)


def test_a_lens_that_is_no_pinhole_needs_its_coefficients():
    net, image, pose = model(), torch.zeros(1, 3, 72, 128), Extrinsics.from_values(0.0, 0.0, 0.0, 1.5)
    for call in (net, lambda *given, **lens: net.warp(*given, pose, **lens)):
        with pytest.raises(ValueError, match="distortion: expected 4 coefficients for a fisheye lens, got 0"):
            call(image, INTRINSICS[None], model="fisheye")
        with pytest.raises(ValueError, match="model: expected one of pinhole, fisheye, omni, got 'fish'"):
            call(image, INTRINSICS[None], model="fish")


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"image: expected \(B, 3, H, W\)"):
        model()(torch.zeros(3, 72, 128), INTRINSICS[None], None)


SMALL = SegmenterConfig(base_width=8, decoder_width=8, pose_sigma_scale=1.6)


def small(calibrator=None):
    """A real network, untrained, and a real extractor, float32."""
    torch.manual_seed(0)
    net = LaneSegmenter(SMALL).eval()
    calibrator = calibrator or TwoStageCalibrator(num_hypotheses=20)
    return LaneBEV(net, LineExtractor.for_network(SMALL), calibrator, BEVWarp(GRID))


@CALIBRATORS
def test_under_autocast_the_network_alone_is_of_half_precision(calibrator):
    net, image = small(calibrator), images(1).float()
    with torch.autocast("cpu", torch.bfloat16):
        out, state = net(image, INTRINSICS[None].float())
    assert out.logits.dtype == torch.bfloat16
    assert out.bev.dtype == out.segments.endpoints.dtype == torch.float32
    assert out.calibration.covariance.dtype == state[0].dtype == torch.float32
    expected, _ = net.warp(image, INTRINSICS[None].float(), out.calibration.extrinsics)
    assert torch.equal(out.bev, expected)


@CALIBRATORS
def test_calibrators_take_an_empty_batch(calibrator):
    segments = LaneSegments(*(v[:0] for v in lanes()))
    out, state = calibrator(segments, K.expand(0, 3, 3), calibrator.initial_state(0), 0.1, 3.7)
    assert out.covariance.shape == (0, 4, 4)
    assert out.inliers.shape == segments.weight.shape
    assert state.status.shape == (0,)


@pytest.mark.parametrize("shape", [(0,), (0, 2)])
def test_an_empty_batch_goes_all_the_way(shape):
    out, state = small()(images(*shape).float(), INTRINSICS.expand(0, 3, 3))
    assert out.bev.shape == (*shape, 3, *GRID.shape)
    assert out.calibration.covariance.shape == (*shape, 4, 4)
    assert state.status.shape == (0,)


def test_views_of_an_empty_batch_on_large_grids():
    grid, none = BEVGrid(resolution=0.2), Extrinsics.unstack(torch.zeros(0, 4))
    bev, valid = BEVWarp(grid)(torch.zeros(0, 3, 36, 64), K.float().expand(0, 3, 3), none)
    assert (bev.shape, valid.shape) == ((0, 3, *grid.shape), (0, 1, *grid.shape))
    image, _ = ImageFromBEV(grid)(bev, K.float().expand(0, 3, 3), none, (360, 640))
    assert image.shape == (0, 3, 360, 640)


def test_a_model_of_half_precision_resizes_too():
    net = small().bfloat16()
    net.network_width = 96
    out, _ = net(images(1).bfloat16(), INTRINSICS[None].float())
    assert out.bev.dtype == out.logits.dtype == torch.bfloat16
    assert out.calibration.covariance.dtype == torch.float32


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_images_of_another_precision_than_the_network(dtype):
    net, image = small(), images(1).to(dtype)
    out, _ = net(image, INTRINSICS[None].float())
    same, _ = net(image.float(), INTRINSICS[None].float())
    assert torch.equal(out.logits, same.logits)
    assert out.bev.dtype == dtype


def test_gradients_flow_under_autocast():
    net, frames = model().float(), images(1).float().requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        out, _ = net(frames, INTRINSICS[None].float())
        out.calibration.extrinsics.pitch.sum().backward()
    assert frames.grad.isfinite().all()
    assert frames.grad.abs().sum() > 0


def test_a_camera_in_double_precision_goes_with_single_precision_images():
    out, state = small()(images(1).float(), INTRINSICS[None], distortion=torch.zeros(1, 5))
    assert out.bev.dtype == torch.float32
    assert out.calibration.covariance.dtype == state.direction_mean.dtype == torch.float64
    kept, _ = small()(images(1).float(), INTRINSICS[None], small().initial_state(1))
    assert kept.calibration.covariance.dtype == torch.float32


@pytest.mark.slow
def test_exports_saves_and_equals_eager(tmp_path):
    net, dt = small(), torch.tensor([0.05])
    arguments = (images(1).float(), INTRINSICS[None].float(), net.initial_state(1), dt)
    with torch.no_grad():
        torch.export.save(torch.export.export(net, arguments), tmp_path / "net.pt2")
        exported = torch.export.load(tmp_path / "net.pt2").module()
        (found, state), (expected, _) = exported(*arguments), net(*arguments)
    assert type(state) is type(arguments[2])
    torch.testing.assert_close(found.bev, expected.bev)
    torch.testing.assert_close(found.calibration.covariance, expected.calibration.covariance)


@pytest.mark.parametrize("part", [TwoStageCalibrator(), JointCalibrator(), MountEstimator()])
def test_states_are_loaded_by_torch_as_they_were_saved(part, tmp_path):
    state = part.initial_state(2)
    torch.save(state, tmp_path / "state.pt")
    loaded = torch.load(tmp_path / "state.pt", weights_only=True)
    assert type(loaded) is type(state)
    assert all(map(torch.equal, loaded, state))


def test_arguments_are_checked():
    for bad in (torch.ones(3), torch.ones(2, 2), torch.ones(1, 2, 3)):
        with pytest.raises(ValueError, match=r"dt: expected a float, \(2,\) or \(2, 3\), got"):
            model()(images(2, 3), INTRINSICS.expand(2, 3, 3), None, bad)
    for nothing in ((1, 0, 3, 72, 128), (1, 3, 0, 128)):
        with pytest.raises(ValueError, match="image: expected frames with pixels, got"):
            model()(torch.zeros(nothing), INTRINSICS[None])
    with pytest.raises(ValueError, match=r"image: expected floating point in \[0, 1\], got torch.uint8"):
        model()((255 * images(1)).to(torch.uint8), INTRINSICS[None])
    with pytest.raises(ValueError, match=r"distortion: expected \(1, D\), got \(5,\)"):
        model()(images(1), INTRINSICS[None], distortion=torch.zeros(5, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"state.direction_mean: expected \(2, ...\)"):
        model()(images(2), INTRINSICS.expand(2, 3, 3), model().initial_state(1))


def test_rows_of_another_drive_begin_anew():
    """Within T frames and between calls; other rows go on as they were."""
    net, frames, cameras = model(), images(2, 4), INTRINSICS.expand(2, 3, 3)
    reset = torch.tensor([[False, False, True, False], [False] * 4])
    mixed, last = net(frames, cameras, reset=reset)
    through, end = net(frames, cameras)
    first, _ = net(frames[:1, 2:], cameras[:1])
    torch.testing.assert_close(mixed.calibration.covariance[:1, 2:], first.calibration.covariance)
    torch.testing.assert_close(mixed.calibration.covariance[1], through.calibration.covariance[1])
    assert (mixed.calibration.covariance[0, 2] - through.calibration.covariance[0, 2]).abs().max() > 0
    _, state = net(frames[:, :2], cameras)
    later, again = net(frames[:, 2:], cameras, state, reset=torch.tensor([True, False]))
    torch.testing.assert_close(later.calibration.covariance, mixed.calibration.covariance[:, 2:])
    torch.testing.assert_close(again.direction_mean, last.direction_mean)
    torch.testing.assert_close(last.direction_mean[1], end.direction_mean[1])


def test_gradients_go_back_over_as_many_frames_as_asked():
    net, cameras = model(), INTRINSICS[None]
    for truncation, reaches in ((None, 5), (1, 1), (2, 1), (3, 2), (10, 5)):
        frames = images(1, 5).requires_grad_()
        out, _ = net(frames, cameras, truncation=truncation)
        out.calibration.extrinsics.pitch[:, -1].sum().backward()
        moved = frames.grad.flatten(2).abs().sum(-1)[0] > 0
        assert moved.tolist() == [False] * (5 - reaches) + [True] * reaches
    _, state = net(images(1).requires_grad_(), cameras)
    out, _ = net(images(1), cameras, state, truncation=1)
    assert state[0].requires_grad
    plain = out.calibration.extrinsics.pitch
    assert torch.autograd.grad(plain.sum(), net.segmenter.gain)[0] != 0  # of this frame


@pytest.mark.parametrize("stages", [["segmenter"], ["extractor"], ["calibrator"], list(STAGES)])
def test_frozen_stages_do_not_learn(stages):
    net, frames = model(frozen=stages), images(1, 2).requires_grad_()
    assert net.train().warp.training != ("warp" in stages)
    assert all(part.training != (name in stages) for name, part in net.named_children())
    out, _ = net(frames, INTRINSICS[None])
    free, _ = model()(frames, INTRINSICS[None])
    assert torch.equal(out.bev, free.bev)
    assert not out.calibration.extrinsics.pitch.requires_grad
    assert out.bev.requires_grad == ("warp" not in stages)
    if "warp" not in stages:
        out.bev.sum().backward()
        assert frames.grad.abs().sum() > 0  # through the resampling
        assert net.segmenter.gain.grad is None
    if "segmenter" not in stages:
        out.logits.sum().backward()
        assert net.segmenter.gain.grad != 0


def test_the_view_can_be_left_out():
    net, frames = model(), images(2, 2)
    without, _ = net(frames, INTRINSICS.expand(2, 3, 3), bev=False)
    whole, _ = net(frames, INTRINSICS.expand(2, 3, 3))
    assert without.bev is None
    assert without.valid is None
    assert torch.equal(without.bev_from_image, whole.bev_from_image)
    assert torch.equal(without.calibration.extrinsics.pitch, whole.calibration.extrinsics.pitch)


def test_arguments_of_training_are_checked():
    with pytest.raises(ValueError, match=r"frozen: expected some of segmenter, .* got head, neck"):
        model(frozen=["head", "neck", "warp"])
    with pytest.raises(ValueError, match="truncation: expected 1 frame or more, or None, got 0"):
        model()(images(1), INTRINSICS[None], truncation=0)
    for bad in (torch.zeros(2), torch.zeros(3, dtype=torch.bool), torch.zeros(2, 2, dtype=torch.bool)):
        with pytest.raises(ValueError, match=r"reset: expected bool \(2,\) or \(2, 3\), got"):
            model()(images(2, 3), INTRINSICS.expand(2, 3, 3), reset=bad)
    with pytest.raises(TypeError, match=r"reset: expected a torch\.Tensor, got bool"):
        model()(images(1), INTRINSICS[None], reset=True)
