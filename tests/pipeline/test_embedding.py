"""LaneBEV inside somebody else's module: built without memory, cast, mapped, padded, compiled."""

import copy
import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils.data import default_collate

from lanebev import (
    BEVGrid,
    BEVWarp,
    Camera,
    CanonicalView,
    Extrinsics,
    ImageFromBEV,
    LaneSegments,
    Status,
    TwoStageCalibrator,
    bev_from_image,
    road_from_image_points,
)
from lanebev.batch import replace_rows
from lanebev.tensors import identity
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes, no_lanes, stack_rows
from lanebev.weights import load_segmenter
from tests.calibrators import CALIBRATORS
from tests.pipeline.stand_ins import INTRINSICS as SMALL_K
from tests.pipeline.stand_ins import images, small_model
from tests.pipeline.stand_ins import model as stand_in

CAMERA = torch.tensor([[[100.0, 0.0, 63.5], [0.0, 100.0, 31.5], [0.0, 0.0, 1.0]]])
POSE = Extrinsics.unstack(torch.tensor([[0.02, 0.01, -0.01, 1.5]]))


def same_view(one, other):
    image = torch.rand(1, 3, 64, 128, generator=torch.Generator().manual_seed(1))
    (found, _), (expected, _) = (each.eval()(image, CAMERA) for each in (one, other))
    return torch.equal(found.logits, expected.logits) and torch.equal(found.bev, expected.bev)


@pytest.mark.parametrize("way", ["to_empty", "assign"])
def test_a_model_that_was_built_without_memory_computes_as_the_one_it_is_loaded_from(way):
    made = small_model()
    with torch.device("meta"):
        loaded = small_model(seed=1)
    if way == "to_empty":
        loaded.to_empty(device="cpu")
        for part in (*loaded.parameters(), *loaded.buffers()):
            if part.is_floating_point() and part is not loaded.calibrator.draws:
                torch.nn.init.constant_(part, 7.0)  # what new memory holds is anything
    loaded.load_state_dict(made.state_dict(), assign=way == "assign")
    assert torch.equal(loaded.calibrator.draws, made.calibrator.draws)
    assert same_view(loaded, made)


def test_shipped_weights_are_not_lost_under_the_device_meta():
    with torch.device("meta"):
        loaded = load_segmenter()
    for one, other in zip(loaded.parameters(), load_segmenter().parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_camera_keeps_its_numbers_under_the_device_meta():
    numbers = {"fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 179.5, "width": 640, "height": 360}
    with torch.device("meta"):
        camera = Camera.from_parameters(**numbers, distortion=(-0.1, 0.01, 0.0, 0.0))
        view = CanonicalView(camera.intrinsics, camera.image_size, POSE)
    expected = CanonicalView(Camera.from_parameters(**numbers).intrinsics, (360, 640), POSE)
    image = torch.rand(1, 2, 360, 640, generator=torch.Generator().manual_seed(0))
    assert camera.distortion.tolist() == [-0.1, 0.01, 0.0, 0.0]
    for one, other in zip(*(each(image, CAMERA, POSE) for each in (view, expected)), strict=True):
        assert torch.equal(one, other)


def test_a_pose_without_numbers_is_named():
    pose = Extrinsics(*(part.to("meta") for part in POSE))
    with pytest.raises(ValueError, match="extrinsics: expected numbers, got a tensor on the device meta"):
        CanonicalView(CAMERA[0], (360, 640), pose)
    with pytest.raises(ValueError, match="intrinsics: expected numbers, got a tensor on the device meta"):
        Camera(CAMERA[0].to("meta"), torch.zeros(0), "pinhole", (360, 640))


@pytest.mark.parametrize("kind", ["bev", "canonical"])
def test_a_view_is_exported_for_images_of_any_size(kind):
    grid = BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5)
    view = BEVWarp(grid) if kind == "bev" else CanonicalView(CAMERA[0], (64, 128), POSE)
    height, width = (torch.export.Dim(name, min=16, max=2000) for name in ("height", "width"))
    images = [
        torch.rand(1, 2, *size, generator=torch.Generator().manual_seed(0)) for size in ((64, 128), (90, 100))
    ]
    sizes = ({2: height, 3: width}, None, Extrinsics(*[None] * 4))
    program = torch.export.export(view, (images[0], CAMERA, POSE), dynamic_shapes=sizes).module()
    for image in images:
        for found, expected in zip(program(image, CAMERA, POSE), view(image, CAMERA, POSE), strict=True):
            torch.testing.assert_close(found, expected)


def test_a_module_of_half_precision_keeps_the_numbers_of_cameras_and_draws():
    camera = torch.tensor([[1050.0, 0.0, 959.5], [0.0, 1050.0, 509.5], [0.0, 0.0, 1.0]])
    view = CanonicalView(camera, (102, 192), POSE)
    image = torch.rand(1, 2, 102, 192, generator=torch.Generator().manual_seed(0))
    expected, _ = view(image, camera[None], POSE, image_size=(1020, 1920))
    found, _ = copy.deepcopy(view).bfloat16()(image, camera[None], POSE, image_size=(1020, 1920))
    assert torch.equal(found, expected)
    assert torch.equal(TwoStageCalibrator().half().draws, TwoStageCalibrator().draws)


def test_constants_of_fake_tensors_are_not_kept():
    """As a tool that estimates memory leaves them: their use would fail ever after."""
    with FakeTensorMode():
        assert identity(11, torch.float64, torch.device("cpu")).shape == (11, 11)
    assert torch.equal(identity(11, torch.float64, torch.device("cpu")), torch.eye(11).double())


@CALIBRATORS
def test_shapes_are_found_without_computing(calibrator):
    """By a tool that estimates memory; the model computes afterwards as before."""
    made = small_model().eval()
    made.calibrator = calibrator
    image = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(1))
    expected, state = made(image, CAMERA.expand(2, 3, 3))
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        given = type(state)(*map(mode.from_tensor, state))
        found, _ = made(mode.from_tensor(image), mode.from_tensor(CAMERA.expand(2, 3, 3)), given)
    for one, other in zip(
        (found.bev, *found.calibration[1:]), (expected.bev, *expected.calibration[1:]), strict=True
    ):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
    again, _ = made(image, CAMERA.expand(2, 3, 3))
    assert torch.equal(again.bev, expected.bev)


@pytest.mark.parametrize("way", ["real", "fake", "symbolic"])
def test_a_recorded_warp_equals_it_for_another_camera_and_pose(way):
    warp = BEVWarp(BEVGrid(x=(-6.0, 6.0), z=(2.0, 30.0), resolution=0.5))

    def view(image, camera, *pose):
        return warp(image, camera, Extrinsics(*pose))

    image = torch.rand(1, 3, 64, 128, generator=torch.Generator().manual_seed(1))
    recorded = make_fx(view, tracing_mode=way)(image, CAMERA, *POSE)
    other = (image.flip(-1), 1.5 * CAMERA, *Extrinsics.unstack(torch.tensor([[-0.03, 0.1, 0.05, 1.2]])))
    expected, found = view(*other), recorded(*other)
    assert not torch.equal(expected[1], view(image, CAMERA, *POSE)[1])
    assert torch.equal(found[1], expected[1])
    torch.testing.assert_close(found[0], expected[0], atol=1e-4, rtol=1e-4)


@CALIBRATORS
def test_mapped_rows_equal_those_of_a_batch(calibrator):
    """``torch.vmap``, and with it ``torch.func.grad`` of each sample; rows that start, see nothing, go on."""
    frames = [stack_rows(lanes(seed=seed), no_lanes(), lanes(seed=seed + 2)) for seed in range(2)]
    state = calibrator.initial_state(3, dtype=torch.float64)
    mapped = type(state)(*(part.unsqueeze(1) for part in state))

    def one(segments, before):
        given = type(segments)(*(part.unsqueeze(0) for part in segments))
        return calibrator(given, K[None], before, 1 / 30)

    for segments in frames:
        expected, state = calibrator(segments, K.expand(3, 3, 3), state, 1 / 30)
        found, mapped = torch.vmap(one)(segments, mapped)
        assert torch.equal(found.status[:, 0], expected.status)
        torch.testing.assert_close(found.extrinsics.stack()[:, 0], expected.extrinsics.stack())
        torch.testing.assert_close(found.covariance[:, 0], expected.covariance)
    assert expected.status.tolist() == [Status.TRACKING, Status.UNINITIALISED, Status.TRACKING]


@pytest.mark.slow
def test_gradients_of_each_sample_are_those_of_it_alone():
    made = small_model().eval()
    image = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(1))
    weights = {name: value.detach() for name, value in made.named_parameters()}

    def loss(values, sample):
        out, _ = torch.func.functional_call(made, values, (sample.unsqueeze(0), CAMERA))
        return out.logits.square().mean() + out.bev.mean()

    found = torch.vmap(torch.func.grad(loss), (None, 0))(weights, image)
    for row in range(2):
        expected = torch.func.grad(loss)(weights, image[row])
        for name, value in expected.items():
            torch.testing.assert_close(found[name][row], value, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("padding", ["nan", "zeros", "no time"])
@CALIBRATORS
def test_frames_that_pad_a_clip_change_nothing(calibrator, padding):
    """Drives of three frames and of one: weights of zero take the others out of the loss."""
    made = stand_in()
    made.calibrator = calibrator
    clips, dt = images(2, 3), torch.full((2, 3), 0.05, dtype=torch.float64)
    there = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    drives = [clips[:1], clips[1:, :1]]
    if padding == "nan":
        clips, dt = clips.clone(), dt.clone()
        clips[1, 1:], dt[1, 1:] = torch.nan, torch.nan
    if padding == "zeros":
        clips = torch.where(there[..., None, None, None] > 0, clips, 0.0)
    if padding == "no time":
        dt = dt * there

    def loss(out, weight=1.0):
        parts = (
            out.bev.mean((-3, -2, -1)),
            out.calibration.extrinsics.pitch,
            out.calibration.covariance.sum((-2, -1)),
        )
        return sum((part * weight).sum() for part in parts)

    out, state = made(clips, SMALL_K.expand(2, 3, 3), dt=dt)
    found = torch.autograd.grad(loss(out, there), made.segmenter.gain)[0]
    alone = sum(loss(made(drive, SMALL_K[None], dt=0.05)[0]) for drive in drives)
    assert found.isfinite()
    torch.testing.assert_close(found, torch.autograd.grad(alone, made.segmenter.gain)[0])
    assert all(bool(part.isfinite().all()) for part in state)
    assert out.valid[1, 1:].any() == (padding != "nan")


def test_a_view_of_an_image_that_is_not_finite_is_black_and_not_valid():
    image = images(2)
    image[1, 0, 5, 7] = torch.inf
    out, _ = stand_in()(image, SMALL_K.expand(2, 3, 3))
    assert out.valid[0].any()
    assert out.bev[0].any()
    assert not out.valid[1].any()
    assert not out.bev[1].any()


@pytest.mark.parametrize("curvature", [None, torch.full((2,), 1e-3)], ids=["plane", "crest"])
@pytest.mark.parametrize("distortion", [None, torch.zeros(2, 5)], ids=["no lens", "lens"])
@pytest.mark.parametrize("kind", [BEVWarp, CanonicalView, ImageFromBEV])
def test_a_camera_with_nan_sees_nothing_and_leaves_gradients_finite(kind, distortion, curvature):
    grid = BEVGrid(x=(-6.0, 6.0), z=(3.0, 30.0), resolution=0.5)
    make = {CanonicalView: lambda: CanonicalView(CAMERA[0], (64, 128), POSE)}
    view = make.get(kind, lambda: kind(grid))()
    image = torch.rand(2, 3, *(grid.shape if kind is ImageFromBEV else (64, 128)))
    cameras = CAMERA.repeat(2, 1, 1)
    if distortion is None:
        cameras[1] = torch.nan
    else:
        distortion = distortion.clone()
        distortion[1, 0] = torch.nan
    options = {} if kind is CanonicalView else {"vertical_curvature": curvature}
    if kind is ImageFromBEV:
        options["image_size"] = (64, 128)
    pose = POSE.stack().repeat(2, 1).requires_grad_()
    found, valid = view(image, cameras, Extrinsics.unstack(pose), distortion=distortion, **options)
    assert valid.flatten(1).any(1).tolist() == [True, False]
    assert found.flatten(1).ne(0).any(1).tolist() == [True, False]
    (gradient,) = torch.autograd.grad((found.mean((1, 2, 3)) * torch.tensor([1.0, 0.0])).sum(), pose)
    assert gradient.isfinite().all()
    assert gradient.ne(0).any(1).tolist() == [True, False]


@CALIBRATORS
def test_transposed_intrinsics_are_named_or_not_used(calibrator, monkeypatch):
    """Their pose was 18 degrees off with a standard deviation of 0.05 degrees."""
    state = calibrator.initial_state(2, dtype=torch.float64)
    cameras = torch.stack([K, K.mT])
    segments = stack_rows(lanes(seed=0), lanes(seed=1))
    with pytest.raises(
        ValueError, match=r"intrinsics: expected \[fx s cx; 0 fy cy; 0 0 1\], got its transpose"
    ):
        calibrator(segments, cameras, state, 1 / 30)
    with pytest.raises(ValueError, match=r"got its transpose; give intrinsics\.mT"):
        BEVWarp()(torch.rand(1, 3, 64, 128), CAMERA.mT, POSE)
    monkeypatch.setattr("lanebev.geometry.lens.readable", lambda _: False)  # as on a GPU
    found, _ = calibrator(segments, cameras, state, 1 / 30)
    assert found.status.tolist() == [Status.TRACKING, Status.UNINITIALISED]
    both, poses = torch.cat([CAMERA, CAMERA.mT]), Extrinsics.unstack(POSE.stack().repeat(2, 1))
    _, valid = BEVWarp()(torch.rand(2, 3, 64, 128), both, poses)
    assert valid.flatten(1).any(1).tolist() == [True, False]


@CALIBRATORS
def test_a_turned_image_with_its_camera_shows_the_same(calibrator):
    """Turned by 5 degrees, enlarged by 1.2 and shifted, as augmentation does it: A @ K is its camera."""
    cos, sin = 1.2 * math.cos(math.radians(5)), 1.2 * math.sin(math.radians(5))
    turn = torch.tensor([[cos, -sin, 30.0], [sin, cos, -20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    upright = lanes(seed=3)
    turned = upright._replace(endpoints=upright.endpoints @ turn[:2, :2].mT + turn[:2, 2])
    poses = []
    for segments, camera in ((upright, K), (turned, turn @ K)):
        state = calibrator.initial_state(1, dtype=torch.float64)
        found, _ = calibrator(segments, camera[None], state, 1 / 30)
        assert found.status.tolist() == [Status.TRACKING]
        poses.append(found.extrinsics)
    torch.testing.assert_close(poses[1].stack(), poses[0].stack(), rtol=0.0, atol=1e-4)
    grid = BEVGrid(resolution=0.5)
    plane = bev_from_image(poses[0], K[None], grid)
    torch.testing.assert_close(bev_from_image(poses[0], (turn @ K)[None], grid) @ turn, plane)
    points = torch.tensor([[[300.0, 250.0], [410.0, 260.0]]], dtype=torch.float64)
    there, _ = road_from_image_points(points, K[None], poses[0])
    moved, _ = road_from_image_points(points @ turn[:2, :2].mT + turn[:2, 2], (turn @ K)[None], poses[0])
    torch.testing.assert_close(moved, there)


@CALIBRATORS
def test_a_mirrored_image_shows_a_mirrored_road(calibrator):
    """With the camera mirrored too, yaw and roll have the opposite sign, and so has X in the view."""
    width, segments = 1280, lanes(seed=3)
    mirror = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    shift = torch.tensor([width - 1.0, 0.0], dtype=torch.float64)
    flipped = segments._replace(endpoints=segments.endpoints * mirror + shift, boundary=5 - segments.boundary)
    camera = K.clone()
    camera[0, 2] = width - 1 - camera[0, 2]
    one, _ = calibrator(segments, K[None], calibrator.initial_state(1, dtype=torch.float64), 1 / 30)
    other, _ = calibrator(flipped, camera[None], calibrator.initial_state(1, dtype=torch.float64), 1 / 30)
    signs = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(other.extrinsics.stack(), one.extrinsics.stack() * signs, rtol=0.0, atol=1e-4)

    image = torch.rand(1, 3, 720, width, dtype=torch.float64)
    lens = [0.1, -0.05, 0.002, -0.003, 0.01, 0.02, 0.01, 0.003, 0.004, -0.002, 0.003, 0.001, 0.02, -0.03]
    lens = torch.tensor([lens], dtype=torch.float64)
    changed = lens.clone()
    changed[:, [3, 8, 9, 13]] *= -1  # p2, s1, s2, τy
    half = 0.25  # m, of a cell: cells lie symmetrically about X = 0
    warp = BEVWarp(BEVGrid(x=(-8 + half, 8 + half), z=(4.0, 40.0), resolution=2 * half))
    view, valid = warp(image, K[None], one.extrinsics, lens)
    pose = Extrinsics.unstack(one.extrinsics.stack() * signs)
    mirrored, seen = warp(image.flip(-1), camera[None], pose, changed)
    assert torch.equal(seen.flip(-1), valid)
    torch.testing.assert_close(mirrored.flip(-1), view)


@CALIBRATORS
def test_states_that_were_stacked_or_cast_as_a_whole_are_named(calibrator):
    state = calibrator.initial_state(1, dtype=torch.float64)
    stacked = default_collate([state, state])
    segments = stack_rows(lanes(seed=0), lanes(seed=1))
    with pytest.raises(
        ValueError, match=r"state: expected \(2, D\), got \(2, 1, \d+\); join states by torch"
    ):
        calibrator(segments, K.expand(2, 3, 3), stacked, 1 / 30)
    cast = type(state)(*(part.double() for part in state))
    with pytest.raises(
        ValueError, match=r"state.status: expected int64, got torch.float64; cast only floating-point tensors"
    ):
        calibrator(lanes(seed=0), K[None], cast, 1 / 30)
    joined = type(state)(*map(torch.cat, zip(state, state, strict=True)))
    found, _ = calibrator(segments, K.expand(2, 3, 3), joined, 1 / 30)
    assert found.status.tolist() == [Status.TRACKING] * 2


def test_cameras_that_cannot_be_used_are_not_taken_for_transposed_ones():
    calibrator = TwoStageCalibrator()
    cameras = torch.stack([K * torch.nan, torch.zeros_like(K), torch.ones_like(K)])
    found, _ = calibrator(
        stack_rows(*(lanes(seed=seed) for seed in range(3))), cameras, calibrator.initial_state(3), 1 / 30
    )
    assert found.status.tolist() == [Status.UNINITIALISED] * 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_gradients_flow_through_rows_that_a_compiled_program_replaces():
    """Beside whole numbers, such as a status, ``torch.cond`` has no gradients (torch 2.13)."""
    torch.compiler.reset()

    def replaced(rows, numbers, counts):
        pose = Extrinsics(numbers, numbers.sin(), counts, numbers > 0)

        def function(given):
            return Extrinsics(given[0].exp(), given[1] * given[0], given[2] + 1, ~given[3])

        return replace_rows(rows, pose, function, pose)

    rows, counts = torch.tensor([True, False, True]), torch.tensor([1, 2, 3])
    results = []
    for function in (replaced, torch.compile(replaced, backend="aot_eager", fullgraph=True)):
        numbers = torch.tensor([0.3, -0.2, 0.5], requires_grad=True)
        out = function(rows, numbers, counts)
        results.append((*out, *torch.autograd.grad((out[0] + out[1]).sum(), numbers)))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("kind", [BEVWarp, CanonicalView, ImageFromBEV])
def test_a_pose_with_nan_shows_nothing_and_leaves_gradients_finite(kind):
    """As of somebody's own network that regresses it."""
    grid = BEVGrid(x=(-6.0, 6.0), z=(3.0, 30.0), resolution=0.5)
    view = CanonicalView(CAMERA[0], (64, 128), POSE) if kind is CanonicalView else kind(grid)
    image = torch.rand(2, 3, *(grid.shape if kind is ImageFromBEV else (64, 128)), requires_grad=True)
    options = {"image_size": (64, 128)} if kind is ImageFromBEV else {}
    values = POSE.stack().repeat(2, 1)
    values[1, 2] = torch.nan
    values.requires_grad_()
    found, valid = view(image, CAMERA.repeat(2, 1, 1), Extrinsics.unstack(values), **options)
    assert valid.flatten(1).any(1).tolist() == [True, False]
    assert found.flatten(1).ne(0).any(1).tolist() == [True, False]
    gradients = torch.autograd.grad(found.square().sum(), (image, values))
    assert all(each.isfinite().all() for each in gradients)
    assert gradients[1].ne(0).any(1).tolist() == [True, False]


@pytest.mark.filterwarnings("ignore")
@CALIBRATORS
def test_a_program_of_torch_jit_trace_computes_frames_of_every_kind(calibrator):
    """Recorded where no row has to start, it starts rows; of another number of rows too."""
    start = calibrator.initial_state(1, dtype=torch.float64)

    def frame(dt, *parts):
        segments, state = LaneSegments(*parts[:4]), type(start)(*parts[4:])
        out, after = calibrator(segments, K.expand(len(dt), 3, 3), state, dt)
        return out.extrinsics.stack(), out.covariance, out.status, *after

    with torch.no_grad():
        going = frame(torch.full((1,), 0.05), *lanes(seed=0), *start)
        recorded = torch.jit.trace(frame, (torch.full((1,), 0.05), *lanes(seed=1), *going[3:]))
        state = other = tuple(calibrator.initial_state(2, dtype=torch.float64))
        for segments in (stack_rows(lanes(seed=2), no_lanes()), stack_rows(no_lanes(), lanes(seed=3))):
            expected = frame(torch.full((2,), 0.1), *segments, *state)
            found = recorded(torch.full((2,), 0.1), *segments, *other)
            state, other = expected[3:], found[3:]
            for one, two in zip(found, expected, strict=True):
                torch.testing.assert_close(one, two)
    assert found[2].tolist() == [Status.COASTING, Status.TRACKING]
    points = lanes(seed=1).endpoints.requires_grad_()
    inputs = (torch.full((1,), 0.05), points, *lanes(seed=1)[1:], *start)
    one, two = (torch.autograd.grad(each(*inputs)[0].sum(), points) for each in (recorded, frame))
    torch.testing.assert_close(one, two)


@pytest.mark.filterwarnings("ignore")
def test_a_whole_model_is_recorded_by_torch_jit_trace():
    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.lanes = small_model().eval()

        def forward(self, image, camera):
            out, _ = self.lanes(image, camera)
            return out.bev, out.logits, out.calibration.covariance

    net, image = Net(), torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    net.lanes.network_width = 96
    with torch.no_grad():
        recorded = torch.jit.trace(net, (image[:1], CAMERA))
        for found, expected in zip(recorded(image[1:], CAMERA), net(image[1:], CAMERA), strict=True):
            torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


@CALIBRATORS
def test_a_model_on_the_device_meta_has_the_shapes_of_its_results(calibrator):
    """As a tool that counts operations runs it."""
    made = small_model().eval()
    made.calibrator = copy.deepcopy(calibrator)
    made = made.to("meta")
    out, state = made(torch.rand(2, 3, 64, 128, device="meta"), CAMERA.repeat(2, 1, 1).to("meta"))
    assert out.bev.shape == (2, 3, *made.warp.grid.shape)
    assert out.calibration.covariance.shape == (2, 4, 4)
    assert {part.device.type for part in state} == {"meta"}


@pytest.mark.slow
def test_clips_that_begin_drives_are_exported_with_a_free_batch_size():
    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.lanes = stand_in()

        def forward(self, clip, cameras):
            out, _ = self.lanes(clip, cameras)
            return out.bev, out.calibration.extrinsics.stack()

    net, batch = Net(), torch.export.Dim("batch", min=1)
    arguments = (images(2, 2), SMALL_K.repeat(2, 1, 1))
    program = torch.export.export(net, arguments, dynamic_shapes=({0: batch}, {0: batch})).module()
    other = (images(3, 2, seed=1), SMALL_K.repeat(3, 1, 1))
    for found, expected in zip(program(*other), net(*other), strict=True):
        torch.testing.assert_close(found, expected)


def test_shapes_of_poses_and_lenses_that_do_not_fit_are_named():
    clips, cameras = images(2, 3), SMALL_K.expand(2, 3, 3)
    with pytest.raises(ValueError, match=r"distortion: expected \(2, D\), got \(2, 3, 5\)"):
        stand_in()(clips, cameras, distortion=torch.zeros(2, 3, 5))
    collated = default_collate([POSE, POSE])
    with pytest.raises(ValueError, match=r"pitch: expected \(2,\), got \(2, 1\); join poses of one row each"):
        BEVWarp()(torch.rand(2, 3, 64, 128), CAMERA.repeat(2, 1, 1), collated)


def test_a_frozen_stage_that_is_to_learn_is_named():
    """Its gradients would silently be none."""
    net = stand_in(frozen=["segmenter"])
    net.requires_grad_(True)
    with pytest.raises(ValueError, match=r"segmenter: expected parameters without gradients, since it is"):
        net(images(1), SMALL_K[None])
    with torch.no_grad():
        net(images(1), SMALL_K[None])
    net.frozen = net.frozen - {"segmenter"}
    out, _ = net(images(1), SMALL_K[None])
    (gradient,) = torch.autograd.grad(out.logits.sum(), net.segmenter.gain)
    assert gradient != 0


def test_strides_that_are_not_those_of_the_maps_are_named():
    """Such as those of two maps in the wrong order, whose views would be of other places."""
    maps = [torch.rand(1, 2, 33, 60), torch.rand(1, 2, 17, 30)]  # of 33 rows by padding
    warp = BEVWarp(BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5))
    warp(maps, CAMERA, POSE, image_size=(256, 480), strides=(8, 16))
    expected = r"strides: expected about 7.76 px, since 33 rows of a map cover 256 px, got 16; give"
    with pytest.raises(ValueError, match=expected):
        warp(maps, CAMERA, POSE, image_size=(256, 480), strides=(16, 8))
    square = torch.nn.functional.pad(maps[0], (0, 0, 0, 27))  # of an image that was padded to a square
    expected, valid = warp(maps[0], CAMERA, POSE, image_size=(264, 480), strides=8)
    found, _ = warp(square, CAMERA, POSE, image_size=(264, 480), strides=8)
    torch.testing.assert_close(found[..., 20:, :], expected[..., 20:, :])
    assert valid[..., 20:, :].any()
    warp(torch.rand(1, 2, 3, 4), CAMERA, POSE, image_size=(64, 100), strides=32)


def test_a_view_in_the_layout_of_bevdet_has_an_object_in_its_cell():
    """Cells of mmdetection3d: x forward from 0, y to the left from -51.2 m, edges at the limits."""
    half = 0.4
    grid = BEVGrid(x=(-51.2 + half, 51.2 + half), z=(0.0 - half, 51.2 - half), resolution=2 * half)
    places = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([102.4, 51.2])
    for right, forward in places - torch.tensor([51.2, 0.0]):
        column, row = grid.bev_from_road_points(torch.stack([right, forward])).round().long()
        view = torch.zeros(1, 1, *grid.shape)
        view[0, 0, row, column] = 1.0
        expected = [math.floor((-right + 51.2) / 0.8), math.floor(forward / 0.8)]
        assert view.flip(-2, -1).mT[0, 0].nonzero().tolist() == [expected]


def test_a_map_of_the_frame_before_is_aligned_through_the_camera():
    """By odometry on a plane.

    The lanes turn by 2 degrees to the right, the car moves 1.7 m ahead and 0.4 m to the right of them, and
    turns to the right of them.
    """
    yaw, turn, right, ahead = 0.05, math.radians(2), 0.4, 1.7
    before = Extrinsics.from_values(0.0, yaw, 0.0, 1.5)
    now = Extrinsics.from_values(0.0, -0.02, 0.0, 1.45)
    heading = yaw + turn + 0.02  # by which the camera turned to the right, seen from above
    moved = torch.eye(4, dtype=torch.float64)  # camera before from camera now
    moved[0, 0] = moved[2, 2] = math.cos(heading)
    moved[0, 2], moved[2, 0] = math.sin(heading), -math.sin(heading)
    moved[0, 3] = math.cos(yaw) * right + math.sin(yaw) * ahead
    moved[1, 3] = 1.5 - 1.45
    moved[2, 3] = math.cos(yaw) * ahead - math.sin(yaw) * right
    found = now.road_from_camera() @ moved.inverse() @ before.camera_from_road()
    for across, forward in ((0.0, 0.0), (3.5, 20.0), (-2.0, 60.0)):
        x, z = across - right, forward - ahead  # turned by hand into the axes of the lanes now
        expected = [math.cos(turn) * x - math.sin(turn) * z, math.sin(turn) * x + math.cos(turn) * z]
        point = found[0] @ torch.tensor([across, 0.0, forward, 1.0], dtype=torch.float64)
        assert point[[0, 2]].tolist() == pytest.approx(expected)
