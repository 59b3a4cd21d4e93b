"""Images that are upside down: lanes determine no pose, and the run says why."""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from lanebev import LaneBEV
from lanebev.app.config import RunConfig
from lanebev.app.drive.build import make_tracker
from lanebev.app.drive.observers import LaneFileObserver, NetworkObserver
from lanebev.app.drive.upside_down import upside_down_remark
from lanebev.io.opening import open_source
from lanebev.observation.polylines import LaneLine, vertices_from_lines
from tests.app.straight_road import CAMERA, HEIGHT, WIDTH

TRACKER = make_tracker(RunConfig(source="images", fov=60.0), CAMERA)
LINES = [LaneLine(np.array([[x, 230.0], [205.0, 120.0]])) for x in (60.0, 350.0)]


class Bright(LaneBEV):
    """Sees two boundaries in an image whose lower half is the brighter one."""

    def __init__(self):
        torch.nn.Module.__init__(self)
        self.pose_sigma_scale, self.frozen = 1.0, ()

    def boundary_vertices(self, image, vanishing_point=None):
        upper, lower = image[0].chunk(2, dim=1)
        return None, vertices_from_lines(LINES if lower.mean() > upper.mean() else [], CAMERA)


@pytest.fixture
def source(tmp_path):
    for number in range(10):
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        image[: HEIGHT // 2] = 200 - number
        Image.fromarray(image).save(tmp_path / f"{number}.png")
    (tmp_path / "3.png").write_bytes(b"cut")
    return open_source(str(tmp_path))


def test_lanes_that_are_seen_in_turned_images_only_are_said(source):
    observer = NetworkObserver(Bright(), CAMERA)
    remark = upside_down_remark(observer, TRACKER, source, 0, 10)
    assert remark.startswith(
        "images: lanes determine a pose in 100% of sampled images turned by 180 degrees, in 0% of these"
    )
    assert upside_down_remark(observer, TRACKER, source, 6, 10) == ""
    assert upside_down_remark(observer, TRACKER, source, 0, 7) == ""
    assert upside_down_remark(LaneFileObserver.__new__(LaneFileObserver), TRACKER, source, 0, 10) == ""


def test_upright_images_without_lanes_are_not_turned(source, tmp_path):
    for number in range(10):
        Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / f"{number}.png")
    assert upside_down_remark(NetworkObserver(Bright(), CAMERA), TRACKER, source, 0, 10) == ""


def test_a_video_that_is_deleted_during_the_run_is_not_read_again(tmp_path):
    path = tmp_path / "drive.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (WIDTH, HEIGHT))
    for _ in range(10):
        video.write(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    video.release()
    source = open_source(str(path))
    path.unlink()
    assert upside_down_remark(NetworkObserver(Bright(), CAMERA), TRACKER, source, 0, 10) == ""
