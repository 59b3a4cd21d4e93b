"""``lanebev run --hilly``, and outputs that follow the road's vertical curvature."""

import json
from fractions import Fraction

import numpy as np
import pytest
import torch

from lanebev import Camera, Extrinsics
from lanebev.app.config import RunConfig
from lanebev.app.drive.build import make_tracker
from lanebev.app.run import run
from lanebev.io.lanes import read_lanes
from lanebev.io.video.writer import VideoWriter
from lanebev.observation.segments import segments_from_lines
from lanebev.report.measure import measure_boundaries
from tests.drawn_road import PLACES, boundary, on_rows

HEIGHT, WIDTH, FRAMES, FPS = 480, 832, 12, 25
CAMERA = Camera.from_parameters(660, 660, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
POSE = Extrinsics.from_values(0.03, -0.01, 0.01, 1.4)
CREST = torch.tensor([1 / 2000], dtype=torch.float64)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folder of a black drive over a crest of R = 2 km, and the exact rows of its boundaries."""
    folder = tmp_path_factory.mktemp("crest")
    CAMERA.to_file(folder / "camera.yaml")
    with VideoWriter(folder / "drive.mp4", Fraction(FPS)) as writer:
        for _ in range(FRAMES):
            writer.write(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
    z = torch.logspace(0.6, 1.7, 60, dtype=torch.float64)
    rows = list(range(HEIGHT // 2, HEIGHT, 4))
    seen = [boundary(CAMERA, place, z, POSE, vertical_curvature=CREST) for place in PLACES]
    lanes = [on_rows(pixels, rows, WIDTH) for pixels in seen]
    fields = {"lanes": lanes, "h_samples": rows, "boundary": [1, 2, 3, 4]}
    lines = [json.dumps({"raw_file": f"drive.mp4/{k:06d}", **fields}) for k in range(FRAMES)]
    (folder / "lanes.json").write_text("\n".join(lines))
    return folder


def settings(data, out, **more):
    files = {"camera": str(data / "camera.yaml"), "lanes": str(data / "lanes.json"), "out": str(out)}
    return RunConfig(str(data / "drive.mp4"), lane_width=3.7, no_video=True, **files, **more)


@pytest.mark.parametrize("smooth", [False, True])
def test_lanes_are_equally_wide_over_a_crest(data, tmp_path, smooth):
    """The widths of the page are measured on the curved road: on the plane at the camera lanes fan out."""
    report = run(settings(data, tmp_path / "out", smooth=smooth, hilly=True))
    assert report.facts["--hilly"] == "yes"
    last = report.rows[-1]
    pose = Extrinsics.from_values(*np.radians([last.pitch_deg, last.yaw_deg, last.roll_deg]), last.height_m)
    frame = read_lanes(tmp_path / "out" / "lanes.json")[-1]
    segments = segments_from_lines([frame.lines], CAMERA)
    on_plane = measure_boundaries(segments, CAMERA.intrinsics[None], pose)
    off = [np.abs(widths[1:4] - 3.7).max() for widths in (report.after[-1], on_plane.widths)]
    assert off[0] < 0.02
    assert off[1] > 0.04


def test_roads_of_the_settings(data, tmp_path):
    for hilly, std in ((False, 1e-6), (True, 2e-5)):
        tracker = make_tracker(settings(data, tmp_path, hilly=hilly), CAMERA)
        assert tracker.calibrator.config.motion.vertical_curvature_std == std


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"calibrator": "two-stage"}, "hilly: expected --calibrator joint, got two-stage"),
        ({"backend": "onnxruntime", "exported": "x"}, "hilly: expected --backend torch, got onnx"),
    ],
)
def test_it_needs_a_calibrator_that_knows_hills(data, tmp_path, values, message):
    with pytest.raises(ValueError, match=message):
        settings(data, tmp_path, hilly=True, **values)
