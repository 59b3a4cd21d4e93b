"""Times of images in a file beside them."""

import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from lanebev.app.config import RunConfig
from lanebev.app.drive.sources import make_source
from lanebev.io.images.time_files import times_from_file
from lanebev.io.opening import open_source

TIMES = [0.0, 0.1034, 0.2069, 0.31, 0.4135, 0.517]
NANOSECONDS = [1_403_636_579_763_555_584 + round(1e9 * time) for time in TIMES]
KITTI = [f"2011-09-26 23:59:{59.9 + time:012.9f}" for time in TIMES[:1]]
KITTI += [f"2011-09-27 00:00:{time - 0.1:012.9f}" for time in TIMES[1:]]
FILES = {
    "KITTI raw": ("../timestamps.txt", KITTI),
    "KITTI odometry": ("../times.txt", [f"{time:.6e}" for time in TIMES]),
    "TUM mono": ("../times.txt", [f"{i:05d} {1446828471 + time:.6f} 0.5" for i, time in enumerate(TIMES)]),
    "nanoseconds": ("timestamps.txt", [str(each) for each in NANOSECONDS]),
    "table": ("frame_timestamps.csv", ["frame,time", *(f"{i},{time}" for i, time in enumerate(TIMES))]),
    "titles": ("times.csv", ["speed;timestamp", *(f"{9 + i}.5;{time}" for i, time in enumerate(TIMES))]),
    "exposure": ("times.csv", ["t,exposure_time,timezone", *(f"{time},0.01,1" for time in TIMES)]),
    "decimal commas": ("times.txt", [str(time).replace(".", ",") for time in TIMES]),
    "of Python's logging": ("times.txt", [f"2026-11-30 10:15:30,{1000 * time:03.0f}" for time in TIMES]),
    "with names": ("times.csv", ["#s,name", *(f"{time},{i:04d}.png" for i, time in enumerate(TIMES))]),
    "camera and nanoseconds": ("timestamps.txt", [f"0,{each}" for each in NANOSECONDS]),
}


def _images(folder, names=range(6)):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("L", (64, 48), 100).save(folder / f"{name:04d}.png")
    return folder


@pytest.mark.parametrize(("name", "lines"), FILES.values(), ids=FILES)
def test_a_file_beside_images_has_their_times(tmp_path, name, lines):
    folder = _images(tmp_path / "drive" / "data")
    (folder / name).write_text("\n".join(lines) + "\n")
    source = open_source(str(folder))
    milliseconds = name == "times.txt" and ":" in lines[0]
    np.testing.assert_allclose(source.times, TIMES, atol=6e-4 if milliseconds else 1e-6)
    assert float(source.fps) == pytest.approx(1 / 0.1035, abs=0.05 if milliseconds else 0.02)
    assert source.problem == ""
    contradicted = open_source(str(folder), Fraction(30))
    assert contradicted.times == ()
    rate = r"9.7\d*" if milliseconds else r"9.6\d+"
    words = rf": a file of times beside it states {rate} frames per second, --fps 30 was given$"
    assert re.search(words, contradicted.problem)


def test_numbers_of_images_after_dates_are_no_milliseconds(tmp_path):
    folder = _images(tmp_path / "data")
    (folder / "times.txt").write_text("".join(f"2026-11-30 10:15:{i:02d},{97 + i}\n" for i in range(6)))
    np.testing.assert_array_equal(open_source(str(folder)).times, range(6))


def test_of_more_times_those_of_the_images_numbers_are_taken(tmp_path):
    folder = _images(tmp_path / "data", [1, 3, 4])
    (folder / "times.txt").write_text("\n".join(map(str, TIMES)))
    np.testing.assert_allclose(
        open_source(str(folder)).times, np.array(TIMES)[[1, 3, 4]] - TIMES[1], atol=1e-9
    )


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("0\n0.1\n", "it has 2 times for 6 images"),
        ("0\n0.1\nlater\n0.3\n0.4\n0.5\n", "expected a time for each image, got the line 'later'"),
        ("0\n100\n200\n300\n400\n500\n", "its times are not those of a drive, in seconds"),
        ("0\n33\n66\n100\n133\n166\n", "its times are not those of a drive, in seconds"),
        ("0.5\n0.4\n0.3\n0.2\n0.1\n0\n", "its times are not those of a drive, in seconds"),
    ],
)
def test_a_file_that_is_not_used_is_said(tmp_path, text, why):
    folder = _images(tmp_path / "data")
    (tmp_path / "times.txt").write_text(text)
    source = open_source(str(folder))
    assert source.times == ()
    said = f"{folder}: times.txt beside them is not used: {why}"
    assert said in make_source(RunConfig(str(folder), fov=60.0)).problem
    assert make_source(RunConfig(str(folder), fov=60.0, fps=10)).problem == ""
    assert make_source(RunConfig(str(folder), fov=60.0, stills=True)).problem == ""


@given(st.text(), st.integers(2, 4))
def test_any_text_gives_times_or_words(tmp_path_factory, text, count):
    folder = tmp_path_factory.mktemp("images")
    (folder / "times.txt").write_text(text, encoding="utf-8", errors="replace")
    times, why = times_from_file([str(folder / f"{i}.png") for i in range(count)])
    assert len(times) in (0, count)
    assert (times == ()) == (why != "")
    assert "\n" not in why
