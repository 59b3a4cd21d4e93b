"""Frames with the images of a stereo camera side by side are noticed; others are not."""

from fractions import Fraction

import cv2
import numpy as np
import pytest
from PIL import Image

from lanebev import Camera
from lanebev.app.drive.build import match_image_size
from lanebev.io.opening import open_source
from lanebev.io.side_by_side import halves_remark, row_correlation
from lanebev.io.video.writer import VideoWriter

REMARK = "its halves show the same, as of two cameras side by side; cut out one"


def _scene(seed, width=400, height=160):
    """A view with bright sky, dark road, and blobs on both."""
    blobs = np.random.default_rng(seed).normal(size=(height, width, 3)) * 600
    grey = np.where(np.arange(height) < height // 2, 190.0, 70.0)[:, None, None]
    return (grey + cv2.GaussianBlur(blobs, (0, 0), 8)).clip(0, 255).astype(np.uint8)


def _stereo(seed, near=20):
    """Two views of a scene, shifted by a disparity that grows from far to near (px)."""
    scene = _scene(seed)
    shift = np.linspace(0, near, len(scene)).astype(int)
    right = np.stack([row[s : s + 320] for row, s in zip(scene, shift, strict=True)])
    return np.concatenate([scene[:, :320], right], axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_halves_of_two_cameras_are_noticed(seed):
    assert halves_remark(_stereo(seed)) == REMARK
    assert (
        halves_remark(_stereo(seed)[:, ::3]) == ""
    )  # less than twice as wide as high: one camera's, whatever it shows
    assert halves_remark(_scene(seed, 640)) == ""
    mirrored = np.concatenate([_scene(seed)[:, :320], _scene(seed)[:, 319::-1]], axis=1)
    assert halves_remark(mirrored) == ""  # a road is much like its mirror image
    assert halves_remark(np.full((160, 640, 3), 90, np.uint8)) == ""


def test_correlation_of_rows():
    one = np.array([[1.0, 2.0, 3.0], [9.0, 9.0, 9.0]])
    assert row_correlation(one, 5 * one + 2) == pytest.approx(1)
    assert row_correlation(one, -one) == pytest.approx(-1)
    assert row_correlation(one, np.array([[1.0, 0.0, 1.0], [0.0, 0.0, 0.0]])) == 0


def test_sources_say_it_and_a_camera_of_one_half_is_told_the_remedy(tmp_path):
    (tmp_path / "images").mkdir()
    Image.fromarray(_stereo(0)).save(tmp_path / "images" / "0.png")
    with VideoWriter(tmp_path / "drive.mp4", Fraction(10)) as writer:
        writer.write(_stereo(0))
    for source in (tmp_path / "images", tmp_path / "drive.mp4"):
        assert REMARK in open_source(str(source)).problem
    camera = Camera.from_fov(60.0, 320, 160)
    with pytest.raises(ValueError, match=r"got one for 320 x 160; .* two cameras side by side\? cut out one"):
        match_image_size(camera, open_source(str(tmp_path / "drive.mp4")))
