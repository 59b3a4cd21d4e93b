"""Live use: time, states, what another detector saw, resuming, and what is said in words."""

import math
import re
from copy import deepcopy

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, Camera, JointCalibrator, LaneBEV, Session, Status, TwoStageCalibrator
from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.layout import layout
from lanebev.estimation.reasons import REASON_WORDS, Reason, describe_reasons
from tests.calibrators import CALIBRATORS
from tests.drawn_road import PLACES, polylines

CAMERA = Camera.from_parameters(600, 600, 319.5, 179.5, 640, 360, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))
POSE = (0.03, -0.01, 0.02, 1.4)


def lines(pose=POSE, places=PLACES):
    """Polylines of lane boundaries in pixels as taken."""
    return polylines(CAMERA, pose, places)


def numbers(result):
    return [float(value) for value in result.extrinsics]


def test_polylines_give_the_pose_the_sigmas_and_the_mount():
    session = Session(CAMERA, lane_width=3.7)
    for k in range(20):
        result = session(polylines=lines(), stamp=100.0 + k / 20)
    assert result.status == Status.TRACKING
    assert result.reasons == []
    assert result.dt == pytest.approx(0.05)
    assert numbers(result) == pytest.approx(POSE, abs=2e-3)
    assert all(0 < float(value) < 0.02 for value in result.std)
    assert result.mount.progress.item() == pytest.approx(100 * (19 / 20 + 1 / 30) / 20, rel=0.3)
    assert result.mount_needs[0].startswith("pitch: needs 20 s of straight driving; 1 s so far")


def test_a_frame_without_lanes_says_so():
    session = Session(CAMERA)
    assert "no lane boundaries seen" in session(polylines=[], stamp=0.0).reasons
    session(polylines=lines(), stamp=0.1)
    result = session(stamp=0.2)
    assert result.status == Status.COASTING
    assert "no lane boundaries seen" in result.reasons


def test_a_stamp_that_does_not_advance_changes_nothing_and_says_so():
    session = Session(CAMERA)
    for k in range(5):
        before = session(polylines=lines(), stamp=0.1 * k)
    moved = (0.06, *POSE[1:])
    for stamp in (0.4, 0.2):
        result = session(polylines=lines(moved), stamp=stamp)
        assert result.status == Status.COASTING
        assert result.reasons[0].startswith("the time stamp does not advance")
        assert numbers(result) == pytest.approx(numbers(before), abs=1e-3)
    after = session(polylines=lines(), stamp=0.5)
    assert after.status == Status.TRACKING
    assert numbers(after) == pytest.approx(numbers(before), abs=1e-3)


def test_the_time_of_a_frame_that_is_refused_is_not_lost():
    session = Session(CAMERA)
    session(polylines=lines(), stamp=0.0)
    with pytest.raises(ValueError, match=r"expected \(P, 2\) px"):
        session(polylines=[np.zeros((5, 3))], stamp=0.1)
    assert session(polylines=lines(), stamp=0.2).dt == pytest.approx(0.2)


def test_a_clock_that_was_set_back_does_not_end_a_session():
    session = Session(CAMERA)
    for k in range(5):
        session(polylines=lines(), stamp=1e9 + 0.1 * k)
    session(polylines=lines(), stamp=50.0)
    for k in range(1, 4):
        result = session(polylines=lines(), stamp=50.0 + 0.1 * k)
    assert result.status == Status.TRACKING
    assert result.reasons == []


@pytest.mark.parametrize(
    ("step", "units"), [(33.0, "milli- or nanoseconds"), (1 / 30 / 60, "minutes or days")]
)
def test_other_units_of_time_are_noticed(caplog, step, units):
    session = Session(CAMERA)
    said = [session(polylines=lines(), stamp=step * k).reasons for k in range(8)]
    assert not any("expected seconds" in text for texts in said[:5] for text in texts)
    assert any(f"expected seconds, got {units}?" in text for text in said[6])
    assert len(caplog.records) == 1  # not in every frame


def test_a_camera_of_1000_frames_a_second_is_not_doubted(caplog):
    session = Session(CAMERA)
    said = [session(polylines=lines(), stamp=1e-3 * k).reasons for k in range(8)]
    assert not any("expected seconds" in text for texts in said for text in texts)
    assert not caplog.records


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda line: line, ""),
        (lambda line: line / 2, "of smaller images?"),
        (lambda line: line * 2, "of images of another size?"),
        (
            lambda line: line / np.array([640, 360]),
            "x and y of all .* shares of the sides .* pixels?",
        ),
        (lambda line: line / np.array([640, 1]), "x of all .* shares of the sides instead of pixels?"),
        (lambda line: line / np.array([1, 360]), "y of all .* shares of the sides instead of pixels?"),
        (lambda line: line - np.array([0, 110]), "of images whose top was cut off?"),
    ],
)
def test_polylines_in_pixels_of_other_images_are_noticed(caplog, tmp_path, change, words):
    session = Session(CAMERA)
    session.save(tmp_path / "new.safetensors")
    drawn = [change(line[(line >= 0).all(-1)]) for line in map(np.asarray, lines())]
    said = [session(polylines=drawn, stamp=k / 20).reasons for k in range(41)]
    assert len(caplog.records) == bool(words)  # once, as long as it lasts
    assert not any(text.startswith("polylines: ") for texts in said[:19] for text in texts)
    remarks = [text for text in said[-1] if text.startswith("polylines: ")]
    assert len(remarks) == bool(words)
    remedy = "give pixels of the camera's images, or a camera by"
    assert all(re.search(f"{words.replace('?', '[?]')} {remedy}", remark) for remark in remarks)
    for begin_anew in (lambda: session.load(tmp_path / "new.safetensors"), session.reset):
        begin_anew()
        again = session(polylines=drawn, stamp=0.0).reasons
        assert not any(text.startswith("polylines: ") for text in again)


def test_polylines_of_different_lanes_are_noticed():
    session = Session(CAMERA)
    said = [session(polylines=lines(places=(-1.85, 1.85, 3.35)), stamp=k / 20).reasons for k in range(21)]
    (remark,) = (text for text in said[-1] if text.startswith("lanes: "))
    assert "one lane is 2.7 times as wide as another" in remark  # 2.5, and some roll


def test_polylines_that_are_given_again_or_skip_a_number_are_noticed():
    """A slow detector's lines in each frame of the camera; classes as numbers, which doubled the height."""
    rng = np.random.default_rng(0)
    noisy = [[line + rng.normal(0, 0.3, line.shape) for line in map(np.asarray, lines())] for _ in range(20)]
    for repeats, numbers, said in (
        (1, (1, 2, 3, 4), ""),
        (3, (1, 2, 3, 4), "lanes: 13 of 20 frames have the lines of the frame before, to the last digit"),
        (1, (0, 2, 4), "lanes: no frame has boundary 1, so that 0 and 2 are taken to have 2 lanes"),
    ):
        session = Session(CAMERA)
        for k in range(20):
            drawn = dict(zip(numbers, noisy[k // repeats], strict=False))
            result = session(polylines=drawn, stamp=k / 20)
        remarks = [text for text in result.reasons if text.startswith("lanes: ")]
        assert len(remarks) == bool(said)
        assert all(text.startswith(said) for text in remarks)


def test_a_frozen_camera_and_one_that_is_slower_than_the_calls_are_noticed():
    images = np.random.default_rng(0).integers(0, 255, (40, 360, 640, 3), np.uint8)
    for shown, first in (
        (range(40), None),
        ([*range(16), *[15] * 24], 22),
        ([k // 3 for k in range(40)], 10),
    ):
        session = Session(CAMERA)
        found = [
            [text for text in session(images[k], i / 20, polylines=lines()).reasons if "frozen" in text]
            for i, k in enumerate(shown)
        ]
        assert next((i for i, texts in enumerate(found) if texts), None) == first
    assert found[-1][0].startswith("13 of the last 20 frames show the image of the one before: is the camera")
    session.reset()
    assert session(torch.rand(3, 360, 640), 2.0, polylines=lines()).reasons == ["started in this frame"]


def test_a_saved_session_goes_on_exactly(tmp_path):
    one, other = Session(CAMERA), Session(CAMERA)
    for k in range(6):
        one(polylines=lines(), stamp=k / 10)
    one.save(tmp_path / "state.safetensors")
    other.load(tmp_path / "state.safetensors")
    for k in range(6, 9):
        pair = [each(polylines=lines(), stamp=k / 10) for each in (one, other)]
        assert pair[0].dt == pair[1].dt
        assert torch.equal(pair[0].calibration.covariance, pair[1].calibration.covariance)
        assert torch.equal(pair[0].mount.extrinsics.stack(), pair[1].mount.extrinsics.stack())
    foreign = Session(Camera.from_parameters(500, 500, 319.5, 179.5, 640, 360))
    with pytest.raises(ValueError, match="expected the state of this camera"):
        foreign.load(tmp_path / "state.safetensors")
    with pytest.raises(ValueError, match=r"none\.safetensors: .*; leave out load to start anew"):
        other.load(tmp_path / "none.safetensors")


def test_a_state_of_lanes_of_another_width_is_noticed(tmp_path, caplog):
    one = Session(CAMERA, lane_width=3.7)
    one(polylines=lines(), stamp=0.0)
    one.save(tmp_path / "s")
    for same in (3.7, float(np.float32(3.7))):
        Session(CAMERA, lane_width=same).load(tmp_path / "s")
    assert caplog.records == []
    Session(CAMERA, lane_width=3.5).load(tmp_path / "s")
    assert "the state was saved with lanes 3.7 m wide, now they are 3.5 m" in caplog.text


def test_pixels_are_seen_in_either_order_of_colours_and_warped():
    pixels = np.random.default_rng(0).integers(0, 255, (360, 640, 3), dtype=np.uint8)
    grid = BEVGrid(x=(-5, 5), z=(5, 25), resolution=0.25)
    bgr = Session(CAMERA, grid=grid)(pixels, 0.0)
    rgb = Session(CAMERA, grid=grid, colours="rgb")(pixels[..., ::-1], 0.0)
    assert bgr.bev.shape == (80, 40, 3)
    np.testing.assert_array_equal(bgr.bev, rgb.bev[..., ::-1])
    assert torch.equal(bgr.extrinsics.stack(), rgb.extrinsics.stack())
    tensor = Session(CAMERA, grid=grid)(torch.from_numpy(pixels).permute(2, 0, 1), 0.0)
    np.testing.assert_array_equal(tensor.bev, bgr.bev)


def test_an_unsure_focal_length_widens_the_pose():
    sure, unsure = Session(CAMERA), Session(CAMERA, focal_std=0.1)
    for k in range(5):
        results = [each(polylines=lines(), stamp=k / 10) for each in (sure, unsure)]
    grown = (results[1].std.pitch ** 2 - results[0].std.pitch ** 2).sqrt().item()
    assert grown == pytest.approx(0.1 * math.sin(POSE[0]), rel=0.05)


@pytest.mark.parametrize(
    ("settings", "added"),
    [
        ({}, 0.2 / 3.7),
        ({"lane_width": 3.7, "lane_width_std": 0.1}, 0.1 / 3.7),
        ({"lane_width_std": 0.0}, 0.0),
        ({"lane_width": None, "calibrator": JointCalibrator()}, 0.2 / 3.7),
        ({"lane_width": None, "calibrator": TwoStageCalibrator()}, 0.2 / 3.7),
    ],
)
def test_height_is_as_unsure_as_the_lane_width(settings, added):
    """A width that is given is exact; one that is not has a standard deviation of 0.2 m."""
    calibrator = deepcopy(settings.get("calibrator"))
    sessions = Session(CAMERA, calibrator=calibrator, lane_width=3.7), Session(CAMERA, **settings)
    for k in range(5):
        exact, unsure = (each(polylines=lines(), stamp=k / 10) for each in sessions)
    assert torch.equal(exact.extrinsics.stack(), unsure.extrinsics.stack())
    for pair in ((exact, unsure), (exact.mount, unsure.mount)):
        covariances = [getattr(each, "calibration", each).covariance for each in pair]
        more = torch.zeros(1, 4, 4, dtype=torch.float64)
        more[0, 3, 3] = (added * float(pair[1].extrinsics.height)) ** 2
        torch.testing.assert_close(covariances[1], covariances[0] + more, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("kind", [JointCalibrator, TwoStageCalibrator])
def test_a_lane_width_std_of_the_calibrator_counts_once(kind):
    known = Session(CAMERA, calibrator=kind(), lane_width=3.7)
    own = Session(CAMERA, calibrator=kind(lane_width_std=0.2))
    for k in range(5):
        exact, unsure = (each(polylines=lines(), stamp=k / 10).calibration for each in (known, own))
    grown = (unsure.covariance - exact.covariance)[0, 3, 3].sqrt()
    assert float(grown) == pytest.approx(0.2 / 3.7 * float(exact.extrinsics.height), rel=1e-3)


def test_a_height_by_a_lane_width_that_nobody_stated_is_within_three_sigma():
    """Lanes of 3.25 m, of which nobody tells."""
    drawn = lines(places=(-4.875, -1.625, 1.625, 4.875))
    errors = []
    for settings in ({}, {"lane_width": 3.7}):
        session = Session(CAMERA, **settings)
        for k in range(5):
            result = session(polylines=drawn, stamp=k / 10)
        errors.append(float((result.extrinsics.height - POSE[3]) / result.std.height))
    assert 1 < errors[0] < 3 < errors[1]


def test_polylines_are_as_sure_as_they_are_said_to_be():
    """At the start, where nothing else is known, the pose is as unsure as the lines."""
    stds = [Session(CAMERA, polyline_sigma=s)(polylines=lines(), stamp=0.0).std.pitch.item() for s in (1, 2)]
    assert stds[1] == pytest.approx(2 * stds[0], rel=0.2)


def test_a_lost_frame_is_said():
    session = Session(CAMERA)
    session(polylines=lines(), stamp=0.0)
    assert session(stamp=0.1).reasons[0] == "no frame was given"
    assert "no frame was given" not in session(polylines=[], stamp=0.2).reasons


def test_careless_arguments_are_named():
    session = Session(CAMERA)
    with pytest.raises(ValueError, match=r"expected \(360, 640, 3\) uint8, .* float64; multiply by 255"):
        session(np.zeros((360, 640, 3)))
    with pytest.raises(ValueError, match=r"uint8, .* uint16; convert to bytes 0 to 255"):
        session(np.zeros((360, 640, 3), np.uint16))
    with pytest.raises(ValueError, match=r"of one with alpha take frame\[\.\.\., :3\]"):
        session(np.zeros((360, 640, 4), np.uint8))
    with pytest.raises(ValueError, match="channels go last, see np"):
        session(np.zeros((3, 360, 640), np.uint8))
    with pytest.raises(ValueError, match=r"got \(360, 640, 3\); channels go first, see torch"):
        session(torch.zeros(360, 640, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match="for a grey image repeat its channel"):
        session(np.zeros((360, 640), np.uint8))
    with pytest.raises(ValueError, match=r"frame: expected \(360, 640, 3\) uint8, the camera's size"):
        session(np.zeros((720, 1280, 3), np.uint8))
    with pytest.raises(TypeError, match=r"frame: expected a NumPy array or a tensor, got list; .* polyl"):
        session([0])
    line = [np.array([[320.0, 350.0], [320.0, 200.0]])]
    with pytest.raises(ValueError, match=r"frame: expected values in \[0, 1\], got 255; divide bytes by 255"):
        session(torch.full((3, 360, 640), 255.0), polylines=line)
    with pytest.raises(ValueError, match=r"frame: expected values in \[0, 1\], got -1; leave out the norm"):
        session(torch.full((3, 360, 640), -1.0), polylines=line)
    with pytest.raises(TypeError, match="stamp: expected seconds as a number, got str"):
        session(stamp="12")
    with pytest.raises(TypeError, match=r"camera: expected a lanebev.Camera, got str; see Camera.from_file"):
        Session("camera.yaml")
    with pytest.raises(TypeError, match=r"grid: expected a lanebev.BEVGrid or None, got float"):
        Session(CAMERA, grid=0.1)
    with pytest.raises(ValueError, match="polyline_sigma: expected more than 0 px, got 0"):
        Session(CAMERA, polyline_sigma=0)
    with pytest.raises(ValueError, match="there is no such file"):
        session.load("nowhere.safetensors")
    with pytest.raises(ValueError, match="stamp: expected finite seconds"):
        session(stamp=math.nan)
    with pytest.raises(ValueError, match="lane_width: expected 1 to 10 m"):
        Session(CAMERA, lane_width=370)
    with pytest.raises(ValueError, match="lane_width_std: expected 0 to 2 m, got -"):
        Session(CAMERA, lane_width_std=-0.1)
    with pytest.raises(ValueError, match=r"lane_width_std: expected it once, got 0.2 m beside the c.* 0.1 m"):
        Session(CAMERA, lane_width_std=0.2, calibrator=JointCalibrator(lane_width_std=0.1))
    with pytest.raises(ValueError, match="colours: expected 'bgr' or 'rgb'"):
        Session(CAMERA, colours="gray")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"model": "weights"}, TypeError, "model: expected a lanebev.LaneBEV or None, got str"),
        ({"calibrator": JointCalibrator}, TypeError, "Calibrator or None, got the class JointCalibrator"),
        ({"lane_width": "3.7"}, TypeError, "lane_width: expected a number, got str"),
        ({"lane_width_std": True}, TypeError, "lane_width_std: expected a number, got bool"),
        ({"lane_width": math.nan}, ValueError, "lane_width: expected 1 to 10 m, got nan"),
        ({"lane_width_std": math.nan}, ValueError, "lane_width_std: expected 0 to 2 m, got nan"),
        ({"focal_std": -0.1}, ValueError, "focal_std: expected a fraction of the focal length, 0 to 1, got"),
        ({"focal_std": 5}, ValueError, "0 to 1, got 5"),
        ({"device": "gpu"}, ValueError, "device: expected one that torch can use here, got gpu: "),
        ({"device": "cuda:99"}, ValueError, "device: expected one that torch can use here, got cuda:99: "),
    ],
)
def test_arguments_of_a_session_are_checked(arguments, error, message):
    with pytest.raises(error, match=message):
        Session(CAMERA, **arguments)


def test_a_doubtful_camera_is_said_once(caplog):
    session = Session(Camera.from_parameters(4.2, 4.2, 319.5, 179.5, 640, 360))  # mm
    session(stamp=0.0)
    (record,) = caplog.records
    assert record.message.startswith("camera: 178 degrees of view across, where cameras on cars have 25 to")


def test_missing_stamps_are_said_once(caplog):
    session = Session(CAMERA)
    assert [session(polylines=lines()).dt for _ in range(2)] == [1 / 30, 1 / 30]
    assert [record.message for record in caplog.records] == [
        "no time stamps are given: frames are assumed to be 1/30 s apart"
    ]


def test_a_speed_is_a_finite_number():
    session = Session(CAMERA)
    with pytest.raises(TypeError, match="speed: expected m/s as a number, or None, got str"):
        session(stamp=0.0, speed="20")
    with pytest.raises(ValueError, match="speed: expected finite m/s, or None if it is not known, got nan"):
        session(stamp=0.0, speed=math.nan)


def test_a_speed_in_kilometres_an_hour_is_noticed():
    said = [Session(CAMERA)(stamp=0.0, speed=speed).reasons for speed in (33.0, 120.0, -120.0)]
    remark = "speed: up to 120 m/s, 432 km/h; if it is in km/h, divide it by 3.6"
    assert [remark in reasons for reasons in said] == [False, True, True]


def test_a_given_speed_is_that_of_the_road_that_passes():
    sessions = Session(CAMERA), Session(CAMERA)
    for number in range(3):
        stamp = number / 30
        sessions[0](polylines=lines(), stamp=stamp, speed=None)
        sessions[1](polylines=lines(), stamp=stamp, speed=8.0)
    prior, known = (session.tracker.state for session in sessions)
    place = layout(6).speed
    assert prior.mean[0, place] == 0
    assert MotionConfig().speed + known.mean[0, place].item() == pytest.approx(8.0, abs=0.3)
    assert known.cov[0, place, place].sqrt() < 0.5


def test_a_session_uses_the_calibrator_of_its_model():
    model = LaneBEV.from_pretrained(calibrator=TwoStageCalibrator())
    session = Session(CAMERA, model=model)
    assert isinstance(session.tracker.calibrator, TwoStageCalibrator)
    own = JointCalibrator()
    assert Session(CAMERA, model=model, calibrator=own).tracker.calibrator is own


def test_a_model_without_a_calibrator_of_lanebev_needs_another():
    class Own(torch.nn.Module):
        def __deepcopy__(self, memo):
            raise AssertionError("copied in vain")

    model = LaneBEV.from_pretrained(calibrator=Own())
    with pytest.raises(TypeError, match=r"model: expected one with a lanebev.Calibrator, got .*Own; give"):
        Session(CAMERA, model=model)
    own = JointCalibrator()
    assert Session(CAMERA, model=model, calibrator=own).tracker.calibrator is own


def test_every_reason_has_words():
    assert set(REASON_WORDS) == {reason for reason in Reason if reason}
    assert describe_reasons(Reason.NONE) == []
    one_lane = Reason.ROLL_UNSEEN | Reason.LANE_CHANGE
    assert describe_reasons(one_lane) == ["roll not determined: one lane only", "lane change"]
    all_axes = Reason.ROLL_UNSEEN | Reason.HEIGHT_UNSEEN | Reason.DIRECTION_UNSEEN
    what = "pitch, yaw, height, roll not determined"
    assert describe_reasons(all_axes) == [f"{what}: one boundary only"]
    assert describe_reasons(all_axes | Reason.NO_SEGMENTS) == ["no lane boundaries seen"]


@CALIBRATORS
def test_reasons_before_the_first_frame(calibrator):
    assert calibrator.reasons(calibrator.initial_state(2)).tolist() == [Reason.NO_START] * 2
