"""The prior of the maps is drawn where the predicted boundaries are, and is off where it may be wrong."""

from __future__ import annotations

import math

import pytest
import torch

from lanebev import Camera, Extrinsics
from lanebev.geometry.road import road_from_image_points
from lanebev.testing.moments import CAMERA, FPS, IMAGE, PLACES, WIDTH, moments, observe
from lanebev.types import Status
from tools.bench_time_prior import main, summarise
from tools.time_prior import PriorCalibrator, draw, predicted_rays

STRIDE = 10
SIZE = (IMAGE[0] // STRIDE, IMAGE[1] // STRIDE)
GAIN, PENALTY = 2.0, 1.0


def followed(frames: int = 12) -> PriorCalibrator:
    """A calibrator that has followed a straight road."""
    camera = Camera.from_parameters(1050, 1050, 959.5, 509.5, IMAGE[1], IMAGE[0])
    calibrator = PriorCalibrator((GAIN, PENALTY), camera, IMAGE)
    state = calibrator.initial_state(1, dtype=torch.float64)
    drive = moments(frames / FPS, motion=lambda _: (0.02, 0.01, 0.005, 1.5))
    for _, segments in observe(drive, 1, 0.3, 12, 0, torch.float64):
        _, state = calibrator(segments, CAMERA[None], state, 1 / FPS, WIDTH)
    return calibrator


def test_rays_meet_the_road_at_the_boundaries():
    calibrator = followed()
    pose = torch.tensor([0.03, -0.02, 0.01, 1.4], dtype=torch.float64)
    mean = torch.zeros_like(calibrator.last.mean)
    mean[0, :4], mean[0, 4] = pose, 0.3
    state = calibrator.last._replace(mean=mean)
    z = torch.tensor([5.0, 20.0, 60.0], dtype=torch.float64)
    rays = predicted_rays(state, PLACES, z).flatten(0, 1)
    pixels = (rays / rays[:, 2:] @ CAMERA.mT)[None, :, :2]
    road, ahead = road_from_image_points(pixels, CAMERA[None], Extrinsics.unstack(pose[None]))
    assert ahead.all()
    expected = torch.stack(torch.broadcast_tensors(0.3 + PLACES[:, None], z), dim=-1)
    torch.testing.assert_close(road.reshape(6, 3, 2), expected)


def test_a_drawn_boundary_falls_off_across_it():
    upright = torch.tensor([[30.0, 39.0], [30.0, 0.0]])
    diagonal = torch.tensor([[39.0, 39.0], [0.0, 0.0]])
    nowhere = torch.full((2, 2), torch.nan)
    drawn = draw(torch.stack([upright, diagonal, nowhere]), torch.tensor([1.0, 0.5, 1.0]), (40, 60))
    assert drawn[0, 20, 30] == 1
    assert float(drawn[0, 20, 33]) == pytest.approx(math.exp(-2))  # three cells are two standard deviations
    assert float(drawn[1, 20, 23]) == pytest.approx(0.5 * math.exp(-1), abs=1e-5)  # 3/√2 cells off it
    assert not drawn[2].any()


def test_the_prior_rises_on_the_boundaries_alone():
    calibrator = followed()
    logits = torch.zeros(1, 7, *SIZE)
    change = calibrator.add_prior(logits)[0]
    assert not change[0].any()  # the background
    assert float(change.max()) == pytest.approx(GAIN, abs=0.1)
    assert float(change[1:].min()) == pytest.approx(-PENALTY, abs=1e-4)
    row = 80  # of the map
    left, right = change[3:5, row].argmax(-1).tolist()
    middle = torch.tensor([[[STRIDE * (left + right) / 2, STRIDE * row]]], dtype=torch.float64)
    pose = Extrinsics.unstack(calibrator.last.mean[:, :4])
    road, _ = road_from_image_points(middle, CAMERA[None], pose)
    assert float(road[0, 0, 0]) == pytest.approx(float(calibrator.last.mean[0, 4]), abs=0.05)


def test_there_is_no_prior_where_it_may_be_wrong():
    calibrator, logits = followed(), torch.zeros(1, 7, *SIZE)
    kept = calibrator.last
    calibrator.last = kept._replace(status=torch.full_like(kept.status, int(Status.COASTING)))
    assert calibrator.add_prior(logits) is logits
    mean = kept.mean.clone()
    mean[0, 4] = 0.5 * WIDTH  # over a line
    calibrator.last = kept._replace(mean=mean)
    assert calibrator.add_prior(logits) is logits
    calibrator.last = kept
    assert calibrator.add_prior(logits).any()
    calibrator.initial_state(1)
    assert calibrator.add_prior(logits) is logits


def drive(error: float, tracking: bool) -> dict:
    """The sums and errors of a drive of two frames."""
    rows = torch.tensor([10.0, 9.0, 4.0, 1.0, 2.0])
    one = torch.full((4,), error, dtype=torch.float64)
    return {"rows": rows, "poses": [(one, torch.tensor(error), torch.tensor(tracking))] * 2}


def test_figures_of_known_drives():
    found = summarise([drive(0.1, True), drive(0.3, True), drive(0.2, True), drive(9.0, False)])
    assert found["recall"] == pytest.approx(0.9)
    assert found["recall behind vehicles"] == pytest.approx(0.25)
    assert found["false"] == pytest.approx(0.2)
    assert found["roll, deg"] == pytest.approx(math.degrees(0.2))
    assert found["height, cm"] == pytest.approx(20)
    assert found["NEES/dof, mean"] == pytest.approx(0.2)
    assert found["TRACKING"] == pytest.approx(0.75)


def test_without_a_frame_tracking_the_figures_of_the_pose_are_unknown():
    found = summarise([drive(9.0, False)])
    assert found["recall"] == pytest.approx(0.9)
    assert found["TRACKING"] == 0
    assert math.isnan(found["pitch, deg"])
    assert math.isnan(found["NEES/dof, median"])


def test_fewer_frames_than_the_warm_up_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["bench_time_prior", "--frames", "10"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "--frames: expected more than the warm-up of 10, got 10" in capsys.readouterr().err
