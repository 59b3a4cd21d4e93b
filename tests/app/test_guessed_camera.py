"""Runs by those who know little of the camera, and by those who know how it is mounted."""

import math

import numpy as np
import pytest
import torch

from lanebev import Camera, Extrinsics, LaneBEV, Session, Status
from lanebev.app.config import FOV_FOCAL_STD, RunConfig
from lanebev.app.drive.build import make_camera, make_tracker
from lanebev.app.drive.observers import NetworkObserver
from lanebev.estimation.joint.frame_prior import FramePrior, prior_of_mount
from lanebev.estimation.reasons import Reason
from lanebev.geometry.road import lane_width_covariance
from lanebev.io.frames import Frame
from lanebev.observation.polylines import LaneLine, vertices_from_lines
from lanebev.render import Drive
from tests.drawn_road import PLACES, polylines

CONFIG = RunConfig("a", fov=60.0)
SIZE, POSE = (720, 1280), (0.05, 0.03, 0.01, 1.5)


def lines(camera, pose=POSE, places=PLACES):
    """Polylines of lane boundaries."""
    return [LaneLine(points) for points in polylines(camera, pose, places, count=60)]


def tracked(config, camera, drawn, frames=3):
    tracker = make_tracker(config, camera)
    for _ in range(frames):
        estimate = tracker.drive_frame(vertices_from_lines(drawn, camera), 1 / 30, 1.0)
    return tracker, estimate.calibration


@pytest.mark.parametrize("assumed", [40.0, 60.0, 90.0])
def test_a_guessed_field_of_view_is_within_three_sigma(assumed):
    """Lanes of a camera of 60 degrees; no drive can tell the focal length, so the sigmas must say it."""
    config = RunConfig("a", fov=assumed)
    camera = make_camera(config, SIZE)
    drawn = lines(Camera.from_fov(60.0, 1280, 720))
    tracker, calibration = tracked(config, camera, drawn)
    sigma = calibration.covariance[0].diagonal().sqrt()
    error = (calibration.extrinsics.stack()[0] - torch.tensor(POSE)).abs()
    assert (error <= 3 * sigma).all()
    share = math.tan(math.radians(assumed / 2)) / math.tan(math.radians(30))
    assert float(calibration.extrinsics.pitch) == pytest.approx(share * POSE[0], rel=0.05)
    assert sigma[0] > 0.9 * FOV_FOCAL_STD * float(calibration.extrinsics.pitch)
    mount = tracker.mount
    assert mount.covariance[0, 0, 0].sqrt() > 0.9 * FOV_FOCAL_STD * float(mount.extrinsics.pitch)

    sure = tracked(RunConfig("a", fov=assumed, focal_std=0.0), camera, drawn)[1]
    assert torch.equal(sure.extrinsics.stack(), calibration.extrinsics.stack())
    assert sure.covariance[0, 0, 0].sqrt() < 0.1 * sigma[0]


def test_stills_have_the_sigmas_of_the_settings_too():
    camera = Camera.from_fov(60.0, 1280, 720)
    found = []
    for settings in ({}, {"focal_std": 0.1}, {"lane_width_std": 0.37}):
        tracker = make_tracker(RunConfig("a", "b", lane_width=3.7, **settings), camera)
        still = tracker.still(vertices_from_lines(lines(camera), camera), 1.0)
        assert still.reasons == Reason.NONE
        found.append(still.calibration.covariance[0].diagonal())
    known, by_focal, by_width = found
    assert float(by_focal[0] - known[0]) == pytest.approx((0.1 * POSE[0]) ** 2, rel=0.05)
    assert float(by_width[3] - known[3]) == pytest.approx((0.1 * POSE[3]) ** 2, rel=0.05)
    assert torch.equal(by_width[:3], known[:3])


def test_a_lane_width_that_nobody_stated_is_unsure():
    """Lanes of 3.25 m, of which only the first user tells."""
    camera = Camera.from_fov(60.0, 1280, 720)
    drawn = lines(camera, places=(-4.875, -1.625, 1.625, 4.875))
    errors = []
    for settings in ({"lane_width": 3.25}, {"lane_width_std": 0.0}, {}):
        calibration = tracked(RunConfig("a", "b", **settings), camera, drawn)[1]
        error = abs(float(calibration.extrinsics.height) - POSE[3])
        errors.append(error / float(calibration.covariance[0, 3, 3].sqrt()))
    stated, wrongly_sure, unsure = errors
    assert stated < 1
    assert wrongly_sure > 3
    assert 1 < unsure < 3


@pytest.mark.parametrize(
    "widths",
    [
        {},
        {"lane_width": 3.5},
        {"lane_width_std": 0.1},
        {"lane_width": 3.5, "lane_width_std": 0.1},
        {"lane_width": None, "lane_width_std": 0},
    ],
)
def test_a_session_is_as_sure_of_the_lane_width_as_a_run(widths):
    camera = Camera.from_fov(60.0, 1280, 720)
    drawn = lines(camera)
    tracker, by_run = tracked(RunConfig("a", "b", **widths), camera, drawn)
    session = Session(camera, **widths)
    for k in range(3):
        live = session(polylines=[line.points for line in drawn], stamp=k / 30)
    assert by_run.extrinsics.height.item() == pytest.approx(live.extrinsics.height.item(), abs=1e-9)
    torch.testing.assert_close(live.calibration.covariance, by_run.covariance, atol=1e-12, rtol=1e-6)
    torch.testing.assert_close(live.mount.covariance, tracker.mount.covariance, atol=1e-12, rtol=1e-6)


def test_lane_width_is_a_share_of_height_alone():
    found = lane_width_covariance(torch.tensor([1.5, 2.0]), 0.1)
    expected = torch.zeros(2, 4, 4)
    expected[:, 3, 3] = torch.tensor([0.0225, 0.04])
    torch.testing.assert_close(found, expected)


def test_prior_of_a_mount():
    prior = prior_of_mount((0.02, 0.1, -0.03, 1.7), (0.01, math.inf, 0.002, 0.0))
    usual = FramePrior()
    assert (prior.pitch, prior.roll, prior.height) == (0.02, -0.03, 1.7)
    assert (prior.yaw, prior.yaw_std) == (usual.yaw, usual.yaw_std)
    assert prior.pitch_std > 0.01
    assert 0.002 < prior.roll_std < usual.roll_std
    assert prior.roll_range == pytest.approx(3 * prior.roll_std)


def test_a_mount_decides_what_one_lane_leaves_open(tmp_path):
    """Roll of a camera that sees its own lane only."""
    camera = Camera.from_fov(60.0, 1280, 720)
    pose = (0.05, 0.03, 0.06, 1.5)
    text = "mount: {valid: false, roll_deg: 3.4, roll_std_deg: 0.05, height_m: 1.5, height_std_m: 0.01}\n"
    (tmp_path / "calibration.yaml").write_text(text)
    drawn = lines(camera, pose, (-1.85, 1.85))
    errors, sigmas = [], []
    for mount in (None, str(tmp_path / "calibration.yaml")):
        tracker = make_tracker(RunConfig("a", "b", mount=mount), camera)
        calibration = tracker.still(vertices_from_lines(drawn, camera), 1.0).calibration
        errors.append(abs(float(calibration.extrinsics.roll) - pose[2]))
        sigmas.append(float(calibration.covariance[0, 2, 2]) ** 0.5)
    assert errors[1] < 0.01 < errors[0]
    assert sigmas[1] < 0.5 * sigmas[0]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "camera: expected --camera FILE, or --fov DEG if no file is at hand, got none"),
        ({"camera": "c", "fov": 60.0}, "fov: expected --camera or --fov, got both"),
        ({"fov": 180.0}, "fov: expected a horizontal field of view of 10 to 179 degrees, got 180"),
        ({"fov": np.nan}, "fov: expected a horizontal field of view"),
        ({"fov": 60.0, "focal_std": -0.1}, "focal std: expected a share of the focal length .*, got -0.1"),
        ({"fov": 60.0, "lane_width_std": np.inf}, "lane width std: expected 0 to 2 m, got inf"),
        ({"fov": 60.0, "rectified": True}, "rectified: expected a camera file"),
        ({"fov": 60.0, "mount": "m", "calibrator": "two-stage"}, "mount: expected --calibrator joint"),
    ],
)
def test_settings_check_themselves(values, message):
    with pytest.raises(ValueError, match=message):
        RunConfig("a", **values)


@pytest.mark.slow
@pytest.mark.parametrize("fov", [50.0, 70.0])
def test_a_guess_of_60_degrees_is_within_three_sigma_from_pixels(fov):
    mount = Extrinsics.from_values(*POSE)
    drive = Drive(3, (360, 640), 12, 20.0, Camera.from_fov(fov, 640, 360), mount=mount, weather="clear")
    camera = Camera.from_fov(60.0, 640, 360)
    observer, tracker = NetworkObserver(LaneBEV.from_pretrained(), camera), make_tracker(CONFIG, camera)
    for number in range(len(drive)):
        rendered = drive.frame(number)
        image = (255 * rendered.image[0].permute(1, 2, 0)).round().byte().numpy()
        seen = observer(Frame(number, number / 20, 1 / 20, "", image))
        estimate = tracker.drive_frame(seen.vertices, 1 / 20, seen.pose_sigma_scale)
    calibration = estimate.calibration
    error = calibration.extrinsics.stack()[0] - rendered.extrinsics.stack()[0].double()
    sigma = calibration.covariance[0].diagonal().sqrt()
    assert int(calibration.status[0]) == Status.TRACKING
    assert (error.abs() <= 3 * sigma).all(), (error / sigma).tolist()
    assert sigma[0] < 0.03
