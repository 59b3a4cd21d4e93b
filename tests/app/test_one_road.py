"""LaneBEV and Session frame by frame, a run, and a run on its ``lanes.json`` are the same calibration."""

from dataclasses import replace
from fractions import Fraction

import cv2
import numpy as np
import pytest
import torch

from lanebev import Camera, FarView, LaneBEV, Session
from lanebev.app.config import RunConfig
from lanebev.app.drive.build import make_calibrator
from lanebev.app.run import run
from lanebev.estimation.still import calibrate_still
from lanebev.io.images.pixels import write_png
from lanebev.io.opening import open_source
from lanebev.io.results import extrinsics_row
from lanebev.io.video.writer import VideoWriter
from lanebev.render import Drive
from lanebev.tensors import map_tensors

torch.set_num_threads(1)  # a run divides the threads among frames, and sums over threads round otherwise
FRAMES, LANE_WIDTH = 5, 3.6
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Folder of a rendered drive behind a lens: camera.yaml and drive.mp4."""
    folder = tmp_path_factory.mktemp("drive")
    made = Drive(10, (180, 320), FRAMES, 20.0)
    camera = replace(
        made.camera, distortion=torch.tensor([-0.2, 0.05, 1e-3, -1e-3, 0.0], dtype=torch.float64)
    )
    camera.to_file(folder / "camera.yaml")
    pixels = torch.cartesian_prod(torch.arange(180.0), torch.arange(320.0)).flip(-1).double()
    ideal = camera.undistort_points(pixels)[0].view(180, 320, 2).float().numpy()
    with VideoWriter(folder / "drive.mp4", Fraction(20), crf=16) as writer:
        for i in range(FRAMES):
            image = (255 * made.frame(i).image[0].permute(1, 2, 0)).round().byte().numpy()
            writer.write(cv2.remap(image, ideal, None, cv2.INTER_LINEAR))
    return folder


def _numbers(rows):
    assert all(row.segments > 10 for row in rows)
    return np.array([row[2:10] for row in rows])


@pytest.mark.parametrize(
    ("calibrator", "far_view"), [("joint", None), ("two-stage", None), ("joint", FarView())]
)
def test_one_road(drive, tmp_path, calibrator, far_view):
    config = {"camera": str(drive / "camera.yaml"), "lane_width": LANE_WIDTH, "calibrator": calibrator}
    with_lanes, config["far_view"] = dict(config), far_view is not None
    by_run = run(RunConfig(str(drive / "drive.mp4"), out=str(tmp_path / "run"), **config))
    lanes = str(tmp_path / "run" / "lanes.json")
    by_lanes = run(
        RunConfig(str(drive / "drive.mp4"), out=str(tmp_path / "again"), lanes=lanes, **with_lanes)
    )

    camera = Camera.from_file(drive / "camera.yaml")
    model = LaneBEV.from_pretrained(calibrator=make_calibrator(calibrator), far_view=far_view).eval()
    lens = (camera.distortion[None], camera.model)
    session = Session(
        camera, model=model, calibrator=make_calibrator(calibrator), lane_width=LANE_WIDTH, colours="rgb"
    )
    state, rows, live = None, [], []
    for frame in open_source(str(drive / "drive.mp4")):
        result = session(frame.image, stamp=frame.time)
        weight = torch.ones(1, 11)  # Session does not tell them
        live.append(extrinsics_row(frame.number, frame.time, result.calibration, weight, ""))
        image = torch.from_numpy(frame.image.copy()).permute(2, 0, 1)[None] / 255
        with torch.inference_mode():
            out, state = model(image, camera.intrinsics[None], state, frame.dt, LANE_WIDTH, *lens)
        rows.append(extrinsics_row(frame.number, frame.time, out.calibration, out.segments.weight, ""))

    assert [row.status for row in live] == [row.status for row in rows]
    np.testing.assert_allclose(_numbers(live), _numbers(rows), atol=1e-6, rtol=0)
    assert [row.status for row in by_run.rows] == [row.status for row in rows]
    assert [row.segments for row in by_lanes.rows] == [row.segments for row in rows]
    np.testing.assert_allclose(_numbers(by_run.rows), _numbers(rows), atol=1e-6, rtol=0)
    np.testing.assert_allclose(_numbers(by_lanes.rows), _numbers(rows), atol=1e-6, rtol=0)


@pytest.mark.parametrize("calibrator", ["joint", "two-stage"])
def test_one_road_with_a_lane_width_that_nobody_stated(drive, tmp_path, calibrator):
    source, camera = str(drive / "drive.mp4"), str(drive / "camera.yaml")
    by_run = run(RunConfig(source, camera, str(tmp_path / "run"), calibrator=calibrator)).rows
    session = Session(Camera.from_file(camera), calibrator=make_calibrator(calibrator), colours="rgb")
    live = []
    for frame in open_source(source):
        result = session(frame.image, stamp=frame.time)
        weight = torch.ones(1, 11)
        live.append(extrinsics_row(frame.number, frame.time, result.calibration, weight, ""))
    np.testing.assert_allclose(_numbers(live), _numbers(by_run), atol=1e-6, rtol=0)
    assert all(row.height_std_m > 0.2 / 3.7 * row.height_m for row in live)


@pytest.mark.parametrize("calibrator", ["joint", "two-stage"])
def test_one_road_of_a_still(drive, tmp_path, calibrator):
    """The calls of docs/tutorials/embed.md give what a run on one image gives."""
    frame = next(iter(open_source(str(drive / "drive.mp4"))))
    write_png(tmp_path / "image.png", frame.image)
    config = {"camera": str(drive / "camera.yaml"), "lane_width": LANE_WIDTH, "calibrator": calibrator}
    (by_run,) = run(RunConfig(str(tmp_path / "image.png"), out=str(tmp_path / "run"), **config)).rows
    camera = Camera.from_file(drive / "camera.yaml")
    model = LaneBEV.from_pretrained(calibrator=make_calibrator(calibrator)).eval()
    image = torch.from_numpy(frame.image.copy()).permute(2, 0, 1)[None] / 255
    intrinsics = camera.intrinsics[None]
    with torch.inference_mode():
        out, _ = model(image, intrinsics, distortion=camera.distortion[None], model=camera.model)
        segments = map_tensors(lambda part: part.double() if part.is_floating_point() else part, out.segments)
        still = calibrate_still(model.calibrator, segments, intrinsics, lane_width=LANE_WIDTH)
        still = model.calibrator.scale_still(still, model.pose_sigma_scale)
    row = extrinsics_row(0, 0.0, still, segments.weight, "")
    assert row.status == by_run.status == "TRACKING"
    np.testing.assert_allclose(_numbers([row]), _numbers([by_run]), atol=1e-6, rtol=0)
