"""A drive on a straight road and a run on it."""

from fractions import Fraction

import numpy as np
import pytest
import yaml
from PIL import Image

from lanebev.io.video.writer import VideoWriter
from tests.app.straight_road import FRAMES, HEIGHT, WIDTH, lane_lines, run


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with a camera file, a video, images, and lanes for both."""
    root = tmp_path_factory.mktemp("data")
    fields = {
        "fx": 330,
        "fy": 330,
        "cx": (WIDTH - 1) / 2,
        "cy": (HEIGHT - 1) / 2,
        "width": WIDTH,
        "height": HEIGHT,
    }
    (root / "camera.yaml").write_text(yaml.safe_dump(fields))
    noise = np.random.default_rng(0)
    (root / "images").mkdir()
    with VideoWriter(root / "drive.mp4", Fraction(25)) as writer:
        for i in range(FRAMES):
            image = noise.integers(60, 90, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            writer.write(image)
            Image.fromarray(image).save(root / "images" / f"{i}.png")
    (root / "video_lanes.json").write_text("\n".join(lane_lines(f"x/{i}" for i in range(FRAMES))))
    names = [f"images/{i}.png" for i in range(FRAMES)]
    (root / "lanes.json").write_text("\n".join(lane_lines(names)))
    return root


@pytest.fixture(scope="module")
def drive(data, tmp_path_factory):
    """Outputs of a run on the video."""
    out = tmp_path_factory.mktemp("out") / "drive"
    assert run(data, source="drive.mp4", lanes="video_lanes.json", out=out) == 0
    return out
