"""A careless caller's mistake is one error that names the argument and what was expected."""

import math
import warnings

import numpy as np
import pytest
import torch
from torch import nn

import lanebev
from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics, LaneSegments
from lanebev.view.matrices import ego_from_camera, image_from_ego, lift_splat_inputs

K = torch.tensor([[[500.0, 0, 319.5], [0, 500, 179.5], [0, 0, 1]]])
SMALL_K = torch.tensor([[[75.0, 0, 47.5], [0, 75, 31.5], [0, 0, 1]]])  # of IMAGE
POSE = Extrinsics.unstack(torch.tensor([[0.02, 0.01, 0.0, 1.5]]))
POSE_TWICE = Extrinsics.unstack(POSE.stack().expand(2, 4))
NUMBERS = Extrinsics(0.02, 0.01, 0.0, 1.5)
POINTS = torch.tensor([[[300.0, 300.0]]])
GRID = BEVGrid(resolution=1.0)
SEGMENTS = LaneSegments(
    torch.rand(1, 8, 2, 2), torch.zeros(1, 8, dtype=torch.int64), torch.ones(1, 8), torch.ones(1, 8)
)
IMAGE = torch.rand(1, 3, 64, 96)
CALIBRATORS = (lanebev.JointCalibrator(), lanebev.TwoStageCalibrator())


@pytest.mark.parametrize("calibrator", CALIBRATORS, ids=lambda each: type(each).__name__)
@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"segments": tuple(SEGMENTS)},
            TypeError,
            r"segments: expected lanebev.LaneSegments\(...\), got tuple",
        ),
        (
            {"segments": LaneSegments(*(part.numpy() for part in SEGMENTS))},
            TypeError,
            r"segments.endpoints: expected a torch.Tensor, got numpy.ndarray; .* torch.from_numpy",
        ),
        (
            {"segments": SEGMENTS._replace(endpoints=SEGMENTS.endpoints.bfloat16())},
            ValueError,
            "segments.endpoints: expected float32 or float64, got torch.bfloat16, which rounds them",
        ),
        (
            {"segments": SEGMENTS._replace(endpoints=SEGMENTS.endpoints.long())},
            ValueError,
            "segments.endpoints: expected floating point, got torch.int64",
        ),
        ({"intrinsics": K.numpy()}, TypeError, "intrinsics: expected a torch.Tensor, got numpy.ndarray"),
        (
            {"intrinsics": K[0]},
            ValueError,
            r"intrinsics: expected \(1, 3, 3\), got \(3, 3\); give it to every row by .expand\(1, 3, 3\)",
        ),
        ({"state": None}, ValueError, r"state: expected \w+, begun by initial_state\(batch_size\)"),
        ({"dt": None}, TypeError, "dt: expected a number or a torch.Tensor, got NoneType"),
        ({"dt": "0.1"}, TypeError, "dt: expected a number or a torch.Tensor, got str"),
        ({"lane_width": 370}, ValueError, "lane_width: expected 1 to 10 m, got 370"),
        ({"lane_width": 0.3}, ValueError, "lane_width: expected 1 to 10 m, got 0.3"),
        ({"lane_width": [3.7]}, TypeError, "lane_width: expected a number or a torch.Tensor, got list"),
    ],
)
def test_calibrators(calibrator, arguments, error, message):
    usual = {"segments": SEGMENTS, "intrinsics": K, "state": calibrator.initial_state(1), "dt": 0.1}
    with pytest.raises(error, match=message):
        calibrator(**(usual | arguments))


@pytest.mark.parametrize(
    "part", [*CALIBRATORS, lanebev.MountEstimator()], ids=lambda each: type(each).__name__
)
def test_states(part):
    with pytest.raises(TypeError, match=r"batch_size: expected a whole number, got 0.5"):
        part.initial_state(0.5)
    with pytest.raises(ValueError, match="batch_size: expected 0 or more, got -1"):
        part.initial_state(-1)
    with pytest.raises(
        ValueError, match=r"dtype: expected torch.float32 or torch.float64, got torch.float16"
    ):
        part.initial_state(1, dtype=torch.float16)


def test_mount():
    mount = lanebev.MountEstimator()
    with pytest.raises(
        TypeError, match=r"calibration: expected a calibrator's lanebev.Calibration, got Extrinsics"
    ):
        mount(POSE, mount.initial_state(1), 0.1)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"boundary": SEGMENTS.boundary + 6}, ValueError, "segments.boundary: expected 0 to 5, got 6"),
        ({"boundary": SEGMENTS.boundary - 1}, ValueError, "segments.boundary: expected 0 to 5, got -1"),
        ({"boundary": SEGMENTS.boundary.float()}, ValueError, "segments.boundary: expected int64"),
        ({"weight": 2 * SEGMENTS.weight}, ValueError, "segments.weight: expected 0 to 1, got 2"),
        ({"sigma": 0 * SEGMENTS.sigma}, ValueError, "segments.sigma: expected positive finite px, got 0"),
        ({"endpoints": SEGMENTS.endpoints / 0}, ValueError, "segments.endpoints: expected finite px, got"),
        ({"endpoints": SEGMENTS.endpoints[0]}, ValueError, r"expected \(1, 8, 2, 2\), got \(8, 2, 2\)"),
        (
            {"weight": np.ones((1, 8))},
            TypeError,
            "segments.weight: expected a torch.Tensor, got numpy.ndarray",
        ),
    ],
)
def test_segments_say_what_is_wrong_with_them(change, error, message):
    assert SEGMENTS.check() is SEGMENTS
    with pytest.raises(error, match=message):
        SEGMENTS._replace(**change).check()


def test_padding_may_hold_anything():
    padding = LaneSegments(
        SEGMENTS.endpoints * torch.nan, SEGMENTS.boundary - 1, 0 * SEGMENTS.weight, -SEGMENTS.sigma
    )
    assert padding.check() is padding


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: lanebev.bev_from_image(POSE, K.numpy(), GRID),
            TypeError,
            "intrinsics: expected a torch.Tensor",
        ),
        (lambda: lanebev.bev_from_image(NUMBERS, K, GRID), TypeError, "extrinsics.pitch: .* got float"),
        (lambda: lanebev.bev_from_image(K, POSE, GRID), TypeError, "extrinsics: expected lanebev.Extrinsics"),
        (lambda: lanebev.bev_from_image(POSE, K, (10, 10)), TypeError, "grid: expected lanebev.BEVGrid"),
        (lambda: BEVGrid(resolution="1"), TypeError, "resolution: expected m as a number, got str"),
        (lambda: BEVGrid(x="ab"), TypeError, r"x\[0\]: expected m as a number, got str"),
        (lambda: BEVGrid(x=10), TypeError, r"x: expected \(low, high\) in m, got 10"),
        (lambda: Extrinsics.unstack([0, 0, 0, 1.5]), TypeError, "values: expected a torch.Tensor, got list"),
        (
            lambda: lanebev.road_from_image_points(POINTS.numpy(), K, POSE),
            TypeError,
            "points: .* numpy.ndarray",
        ),
        (lambda: lanebev.road_from_image_points(POINTS, K, NUMBERS), TypeError, "extrinsics.pitch: .* float"),
        (lambda: lanebev.image_from_road_points(POINTS, K, NUMBERS), TypeError, "extrinsics.pitch: .* float"),
        (lambda: Camera(K[0].numpy(), K[0, 0, :0], "pinhole", (360, 640)), TypeError, "intrinsics: .* numpy"),
        (lambda: Camera(K[0], [], "pinhole", (360, 640)), TypeError, "distortion: .* got list"),
        (
            lambda: Camera.from_fov(60, 640, 360).undistort_points(np.ones((5, 2))),
            TypeError,
            "points: .* numpy",
        ),
        (
            lambda: Camera.from_fov(60, 640, 360).undistort_points(torch.ones(5, 2).long()),
            ValueError,
            "points: expected floating point, got torch.int64",
        ),
        (lambda: Camera.from_fov("60", 640, 360), TypeError, "fov: expected degrees as a number, got str"),
        (
            lambda: Camera.from_parameters(500, None, 320, 180, 640, 360),
            TypeError,
            "fy: expected px as a number, got NoneType",
        ),
        (
            lambda: LaneSegments.from_polylines(5, Camera.from_fov(60, 640, 360)),
            TypeError,
            r"polylines: expected a list of \(P, 2\) px, or a dict by boundary, got int",
        ),
        (
            lambda: LaneSegments.from_polylines(["ab"], Camera.from_fov(60, 640, 360)),
            ValueError,
            r"polylines\[0\]: expected \(P, 2\) px, got 'ab'",
        ),
        (
            lambda: LaneSegments.from_polylines([[[1, 2], [3]]], Camera.from_fov(60, 640, 360)),
            ValueError,
            r"polylines\[0\]: expected \(P, 2\) px, got \[\[1, 2\], \[3\]\]",
        ),
        (
            lambda: LaneSegments.from_polylines([], Camera.from_fov(60, 640, 360), sigma=-1.0),
            ValueError,
            "sigma: expected more than 0 px, got -1.0",
        ),
        (
            lambda: image_from_ego(POSE, K, torch.eye(3)),
            ValueError,
            r"ego_from_road_matrix: expected \(4, 4\) or \(1, 4, 4\), got \(3, 3\)",
        ),
        (
            lambda: lift_splat_inputs(POSE, K, image_transform=torch.eye(4)),
            ValueError,
            r"image_transform: expected \(3, 3\) or \(1, 3, 3\), got \(4, 4\)",
        ),
        (
            lambda: image_from_ego(POSE, K, np.eye(4)),
            TypeError,
            "ego_from_road_matrix: expected a torch.Tensor",
        ),
        (lambda: ego_from_camera(NUMBERS), TypeError, "extrinsics.pitch: .* got float"),
        (
            lambda: Camera.from_fov(60, 640, 360).scaled(2),
            TypeError,
            r"image_size: expected \(height, width\)",
        ),
    ],
)
def test_geometry(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((IMAGE.numpy(), K, POSE), TypeError, "image: expected a torch.Tensor, got numpy.ndarray"),
        ((IMAGE, K.numpy(), POSE), TypeError, "intrinsics: expected a torch.Tensor, got numpy.ndarray"),
        ((IMAGE, K, NUMBERS), TypeError, "extrinsics.pitch: expected a torch.Tensor, got float"),
        ((IMAGE, K, POSE.stack()), TypeError, r"extrinsics: expected lanebev.Extrinsics\(.* got Tensor"),
        (
            (IMAGE, K, Extrinsics(*(each[0] for each in POSE))),
            ValueError,
            r"extrinsics.pitch: expected \(1,\)",
        ),
        (
            (IMAGE, K, POSE, torch.zeros(5)),
            ValueError,
            r"distortion: expected \(1, D\), got \(5,\); give it to every row by .expand\(1, 5\)",
        ),
        ((IMAGE, K, POSE, torch.zeros(2, 5)), ValueError, r"distortion: expected \(1, D\), got \(2, 5\)$"),
        ((IMAGE, K, POSE, [0.1, 0, 0, 0]), TypeError, "distortion: expected a torch.Tensor, got list"),
        (
            (IMAGE, K, POSE, None, ["omni"]),
            TypeError,
            r"model: expected one name .*, got \['omni'\]; call once",
        ),
        (
            (IMAGE, K, POSE, None, "pinhole", 96),
            TypeError,
            r"image_size: expected \(height, width\) in px, got 96",
        ),
        (
            (IMAGE, K, POSE, None, "pinhole", (64, 96), 0),
            ValueError,
            "strides: expected more than 0 px, got 0",
        ),
        ((IMAGE, K, POSE, None, "pinhole", (64, 96), "8"), TypeError, "strides: .* as numbers, .* got str"),
    ],
)
def test_warp(arguments, error, message):
    with pytest.raises(error, match=message):
        BEVWarp(GRID)(*arguments)


class Changed(nn.Module):
    """Changes what a network returns."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def forward(self, logits):
        return self.change(logits)


@pytest.fixture(scope="module")
def model():
    network = lanebev.LaneSegmenter(lanebev.SegmenterConfig(base_width=4, decoder_width=8)).eval()
    extractor = lanebev.LineExtractor.for_network(network.config)
    return lanebev.LaneBEV(network, extractor, lanebev.TwoStageCalibrator(), BEVWarp(GRID))


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (IMAGE.numpy(), TypeError, "image: expected a torch.Tensor, got numpy.ndarray"),
        (255 * IMAGE, ValueError, r"image: expected values in \[0, 1\], got 2\d\d.*; divide bytes by 255"),
        (
            (IMAGE - 0.45) / 0.225,
            ValueError,
            r"in \[0, 1\], got -[12]\..*; leave out the normalisation, which",
        ),
        (2 * IMAGE - 1, ValueError, r"in \[0, 1\], got -[01]\..*; leave out the normalisation, which"),
        ((255 * IMAGE).byte(), ValueError, r"image: expected floating point in \[0, 1\], got torch.uint8"),
        (IMAGE.movedim(1, -1), ValueError, r"image: expected \(B, 3, H, W\) or"),
        (IMAGE[0], ValueError, r"image: expected \(B, 3, H, W\) or"),
    ],
)
def test_lanebev_images(model, image, error, message):
    with pytest.raises(error, match=message):
        model(image, SMALL_K)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (
            {"calibrator": "two-stage"},
            TypeError,
            r"calibrator: expected a module, such as lanebev.JointCalibrator\(\), got 'two-stage'",
        ),
        ({"calibrator": lanebev.JointCalibrator}, TypeError, "calibrator: expected a module, .* got <class"),
        ({"warp": GRID}, TypeError, r"warp: expected a module, such as lanebev.BEVWarp\(\), got BEVGrid"),
        ({"frozen": True}, TypeError, r"frozen: expected a list of names, got True; write \['segmenter'\]"),
        ({"network_width": 0}, ValueError, "network_width: expected a whole number of px above 0, .* got 0"),
        ({"network_width": 320.5}, ValueError, "network_width: expected a whole number of px above 0"),
        ({"network_pixels": -1}, ValueError, "network_pixels: expected a whole number of px above 0"),
        ({"pose_sigma_scale": 0}, ValueError, "pose_sigma_scale: expected more than 0 and finite, got 0"),
    ],
)
def test_lanebev_parts(model, settings, error, message):
    parts = {"segmenter": model.segmenter, "extractor": model.extractor, "calibrator": model.calibrator}
    with pytest.raises(error, match=message):
        lanebev.LaneBEV(**(parts | settings))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda logits: logits.softmax(1),
            "logits: expected those before the softmax, got probabilities; le",
        ),
        (lambda logits: logits[:, :5], r"logits: expected 1 \+ 6 channels, .* got 5; .* num_boundaries=4"),
    ],
)
def test_a_network_of_ones_own_that_cannot_be_meant_is_named(model, change, message):
    """Else no boundary is found, or boundaries are numbered from the left of another lane."""
    network = nn.Sequential(model.segmenter, Changed(change))
    net = lanebev.LaneBEV(network, model.extractor, lanebev.JointCalibrator(), model.warp)
    with pytest.raises(ValueError, match=message):
        net(IMAGE, SMALL_K)


def test_an_interval_that_is_no_number(model):
    with pytest.raises(TypeError, match=r"dt: expected a number or a torch.Tensor, got NoneType"):
        model(IMAGE, SMALL_K, dt=None)


def test_images_with_swapped_sides_are_doubted(model):
    with pytest.warns(UserWarning, match=r"middle of images with swapped sides; give \(B, C, H, W\)"):
        model(torch.rand(1, 3, 96, 64), SMALL_K)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model(torch.rand(1, 3, 64, 96), SMALL_K)


@pytest.mark.parametrize("dt", [33, torch.tensor([33.0])])
def test_milliseconds_are_doubted(model, dt):
    _, state = model(IMAGE, SMALL_K)
    with pytest.warns(
        UserWarning, match="dt: expected seconds .*, got more than 5 in all frames; of milliseco"
    ):
        model(IMAGE, SMALL_K, state, dt)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model(IMAGE, SMALL_K, state, torch.tensor(1.0))
        model(IMAGE.expand(2, -1, -1, -1), SMALL_K.expand(2, -1, -1), dt=dt)  # of a first frame


def test_intervals_are_doubted_once(model):
    _, state = model(IMAGE, SMALL_K)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for dt in (30.0, 31.0, 32.5):
            model(IMAGE, SMALL_K, state, dt)
    assert len([each for each in caught if "dt: " in str(each.message)]) == 1


def test_intervals_that_do_not_count_are_not_doubted(model):
    _, state = model(IMAGE, SMALL_K)
    clip = IMAGE[:, None].expand(-1, 2, -1, -1, -1)
    reset = torch.tensor([[True, False]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model(IMAGE, SMALL_K, state, math.inf)
        model(IMAGE, SMALL_K, state, 33.0, reset=torch.tensor([True]))
        model(clip, SMALL_K, state, torch.tensor([[33.0, 0.1]]), reset=reset)
    with pytest.warns(UserWarning, match="dt: expected seconds"):
        model(clip, SMALL_K, state, torch.tensor([[0.1, 33.0]]), reset=reset)


def test_a_speed_that_does_not_fit(model):
    with pytest.raises(ValueError, match=r"speed: expected a float, \(1,\) or \(1, 1\), got \(2,\)"):
        model(IMAGE, SMALL_K, speed=torch.ones(2))
    own = lanebev.LaneBEV(model.segmenter, model.extractor, nn.Identity(), model.warp)
    with pytest.raises(
        TypeError, match="speed: expected a calibrator with a method with_speed, got Identity"
    ):
        own(IMAGE, SMALL_K, speed=5.0)


def test_tensors_on_different_devices_are_named(model):
    """Meta stands for a GPU."""
    with pytest.raises(
        ValueError, match=r"intrinsics: expected on cpu like the image, got on meta; move it there"
    ):
        model(IMAGE, SMALL_K.to("meta"))
    with pytest.raises(ValueError, match="reset: expected on cpu like the image, got on meta"):
        model(IMAGE, SMALL_K, reset=torch.tensor([True]).to("meta"))
    pose = POSE._replace(height=POSE.height.to("meta"))
    with pytest.raises(ValueError, match=r"extrinsics.height: expected on cpu like the image, got on meta"):
        BEVWarp(GRID)(IMAGE, K, pose)
    for calibrator in CALIBRATORS:
        state = calibrator.initial_state(1, device="meta")
        with pytest.raises(ValueError, match="state: expected on cpu like the intrinsics, got on meta"):
            calibrator(SEGMENTS, K, state, 0.1)


def test_intrinsics_of_a_larger_image_are_doubted(model):
    """Of an image that was made smaller, or of that of a feature map whose image_size was forgotten."""
    features, doubt = torch.rand(1, 4, 45, 80), "a principal point at or beyond its lower right corner"
    for view in (BEVWarp(GRID), lanebev.CanonicalView(K[0], (360, 640), POSE)):
        with pytest.warns(UserWarning, match=doubt):
            view(features, K, POSE)
    with pytest.warns(UserWarning, match=doubt):
        model(torch.rand(1, 3, 180, 320), K, bev=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        BEVWarp(GRID)(features, K, POSE, image_size=(360, 640))
        BEVWarp(GRID)(torch.rand(1, 3, 180, 640), K, POSE)  # without the lower half
        BEVWarp(GRID)(features.expand(2, 4, 45, 80), torch.cat([K, K / 8]), POSE_TWICE)


@pytest.mark.parametrize("scale", [0.5, 0.25, 1 / 96], ids=["half the size", "a quarter", "shares of a side"])
def test_intrinsics_of_a_smaller_image_are_doubted(model, scale):
    """Pitch and yaw would be tens of degrees off, and called TRACKING."""
    smaller = torch.cat([scale * SMALL_K[:, :2], SMALL_K[:, 2:]], 1)
    with pytest.warns(
        UserWarning, match="in pixels, got a principal point at or beyond its upper left corner"
    ):
        model(IMAGE, smaller, bev=False)
    with pytest.warns(UserWarning, match="upper left corner"):
        BEVWarp(GRID)(IMAGE, torch.linalg.inv(SMALL_K), POSE)


def test_an_image_of_more_contrast_is_no_normalised_one(model):
    assert model(0.5 + 1.8 * (IMAGE - 0.5), SMALL_K)[0].logits.isfinite().all()


@pytest.mark.parametrize(
    ("part", "name"),
    [
        (lanebev.LaneSegmenter, "config: expected a lanebev.SegmenterConfig"),
        (lanebev.LineExtractor, "config: expected a lanebev.LineConfig"),
        (lanebev.TwoStageCalibrator, "config: expected a lanebev.TwoStageConfig"),
        (lanebev.MountEstimator, "config: expected a lanebev.MountConfig"),
        (BEVWarp, "grid: expected a lanebev.BEVGrid"),
        (lanebev.ImageFromBEV, "grid: expected a lanebev.BEVGrid"),
    ],
)
def test_parts_take_a_config_or_none(part, name):
    with pytest.raises(TypeError, match=f"{name} or None, got int"):
        part(5)


def test_plane_heights_and_widths():
    with pytest.raises(TypeError, match=r"plane_heights: expected a list of heights in m, got 1.0"):
        BEVWarp(GRID, 1.0)
    with pytest.raises(ValueError, match="base_width: expected at least 1, got 0"):
        lanebev.SegmenterConfig(base_width=0)
    with pytest.raises(ValueError, match=r"logits: expected floating point, got torch.int64"):
        lanebev.LineExtractor()(torch.zeros(1, 7, 16, 24).long(), (64, 96))


def test_lanebev_frozen():
    with pytest.raises(TypeError, match=r"frozen: expected a list of names, got 'segmenter'; write \['seg"):
        lanebev.LaneBEV.from_pretrained(frozen="segmenter")


def test_lanebev_cameras(model):
    with pytest.raises(TypeError, match=r"intrinsics: expected a torch.Tensor, got numpy.ndarray"):
        model(IMAGE, K.numpy())
    with pytest.raises(ValueError, match=r"intrinsics: expected \(1, 3, 3\), got \(3, 3\)"):
        model(IMAGE, K[0])
    with pytest.raises(TypeError, match=r"logits: expected a torch.Tensor, got numpy.ndarray"):
        model.extractor(np.zeros((1, 7, 16, 24)), (64, 96))


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ((2.0, 0.0, 0.0, 1.5), ValueError, "pitch: expected rad within ±pi/2, got 2; see math.radians"),
        ((0.0, 0.0, math.nan, 1.5), ValueError, "roll: expected rad"),
        ((0.0, 0.0, 0.0, math.inf), ValueError, "height: expected m above the road, .*, got inf"),
        ((0.0, 0.0, 0.0, -1.5), ValueError, "height: expected m above the road, .*, got -1.5"),
        (("0", 0.0, 0.0, 1.5), TypeError, "pitch: expected a number, got str"),
    ],
)
def test_extrinsics_from_values(values, error, message):
    with pytest.raises(error, match=message):
        Extrinsics.from_values(*values)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_intrinsics_of_half_precision_are_refused(model, dtype):
    """They would be off by up to 4 px, pitch and yaw by several standard deviations."""
    with pytest.raises(ValueError, match="intrinsics: expected float32 or float64, got torch"):
        model(torch.zeros(1, 3, 64, 64), torch.eye(3, dtype=dtype)[None])
