"""Dates and times of day in images' names: the order of the frames, and their times."""

from datetime import datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from lanebev.app.config import RunConfig
from lanebev.app.drive.sources import make_source
from lanebev.io.images import name_clocks
from lanebev.io.images.names import in_natural_order, times_from_names
from lanebev.io.opening import open_source

FORMS = [
    "%Y-%m-%d_%H-%M-%S.{ms:03d}.jpg",
    "%Y-%m-%dT%H:%M:%S.{ms:03d}000Z.png",
    "frame_%Y%m%dT%H%M%S.{ms:03d}.png",
    "IMG_%Y%m%d_%H%M%S_{ms:03d}.jpg",
    "PXL_%Y%m%d_%H%M%S{ms:03d}.jpg",
    "%Y%m%d%H%M%S{ms:03d}.jpg",
    "center_%Y_%m_%d_%H_%M_%S_{ms:03d}.jpg",  # Udacity's simulator
    "%d-%m-%Y_%H-%M-%S.{ms:03d}.jpg",
    "%m-%d-%Y %Hh%Mm%S,{ms:03d}s.jpg",
    "%y%m%d_%H%M%S{ms:03d}_Camera_5.jpg",  # ApolloScape
    "a/%H-%M-%S.{ms:03d}.jpg",
    "%Y-%m-%d/%H-%M-%S.{ms:03d}.jpg",
    "{i:05d}_%Y.%m.%d-%H.%M.%S.{ms:03d}_front.jpg",
    "{i}_%d%m%Y-%H%M%S,{ms}.jpg",  # milliseconds without zeros before them
    "vlcsnap-%Y-%m-%d-%Hh%Mm%Ss{ms:03d}.png",
    "Screenshot %Y-%m-%d at %I.%M.%S.{ms:03d} %p.png",
]
EVENINGS = [datetime(2026, 11, 30, 23, 59, 58, 800_000), datetime(2024, 2, 28, 23, 59, 59, 10_000)]


def _names(form, start, steps):
    moments = [start + timedelta(seconds=float(step)) for step in np.cumsum([0.0, *steps])]
    return [
        moment.strftime(form).format(ms=round(moment.microsecond / 1000), i=number)
        for number, moment in enumerate(moments)
    ]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("start", [*EVENINGS, datetime(2026, 11, 29, 12, 59, 59)])
def test_times_of_day_are_those_of_the_frames_also_over_midnight(form, start):
    steps = [0.1] * 10 + [0.3] + [0.1] * 20  # two frames were lost
    names = _names(form, start, steps)
    assert in_natural_order(names[::-1]) == names
    np.testing.assert_allclose(times_from_names(names), np.cumsum([0.0, *steps]), atol=1e-9)


@given(
    st.sampled_from(FORMS),
    st.datetimes(datetime(2001, 1, 1), datetime(2030, 1, 1)).filter(lambda each: each.hour or each.minute),
    st.lists(st.integers(20, 400), min_size=60, max_size=80),  # more than a second, as counters fill none
)
def test_any_drive_has_its_times(form, start, milliseconds):
    start = start.replace(microsecond=1000 * (start.microsecond // 1000))
    steps = np.array(milliseconds) / 1000
    names = _names(form, start, steps)
    order = np.random.default_rng(len(names)).permutation(len(names))
    assert in_natural_order(names[place] for place in order) == names
    np.testing.assert_allclose(times_from_names(names), np.cumsum([0.0, *steps]), atol=1e-6)


@pytest.mark.parametrize(
    ("digits", "times"),
    [
        (["3", "53", "103", "153", "203"], [0.003, 0.053, 0.103, 0.153, 0.203]),  # milliseconds
        (["5", "105", "205", "305", "405", "505", "605"], [0.005 + number / 10 for number in range(7)]),
        (["2499", "32499", "62499", "92499", "122499"], [0.002499 + 0.03 * number for number in range(5)]),
        (["125", "25", "375", "5", "625", "75", "875"], [number / 8 for number in range(1, 8)]),  # Go's
        (["05", "1", "15", "2"], [0.05, 0.1, 0.15, 0.2]),
        (["6", "85"], [0.6, 0.85]),
    ],
)
def test_digits_after_the_seconds_are_read_so_that_the_steps_are_even(digits, times):
    names = [f"2026-11-29_10-15-30.{each}.jpg" for each in digits]
    assert in_natural_order(names[::-1]) == names
    np.testing.assert_allclose(times_from_names(names), np.subtract(times, times[0]), atol=1e-9)


@pytest.mark.parametrize(
    "form",
    ["frame_%Y%m%dT%H%M%S.png", "%Y%m%d%H%M%S.jpg", "%Y-%m-%d %H.%M.%S.jpg", "%d.%m.%Y-%I-%M-%S%p.jpg"],
)
def test_whole_seconds_of_one_frame_each_are_times(form):
    names = _names(form, EVENINGS[0], [1, 1, 2, 1])
    assert in_natural_order(names[::-1]) == names
    assert times_from_names(names) == (0, 1, 2, 4, 5)


@pytest.mark.parametrize(
    "names",
    [
        [f"20261129_{number:06d}.jpg" for number in range(40)],  # a date and the numbers of images
        [f"20261129_{number:06d}.jpg" for number in range(12340, 12420)],
        [f"20261129_101530_{number:03d}.jpg" for number in range(0, 90, 5)],  # when a clip began
        [f"20261129_1015{number // 30:02d}_{number:03d}.jpg" for number in range(200)],
        [f"20261129_1015{number // 30:02d}_{number % 30:03d}.jpg" for number in range(200)],
        [f"2026-11-29_10-15-30_{number:04d}.jpg" for number in range(30)],
        [f"20261129_1015{number // 30:02d}.{number % 30:02d}.jpg" for number in range(200)],
        [f"20261129_101530.{number:03d}.jpg" for number in range(1, 140)],
        [f"1700000000.{number}.jpg" for number in range(1, 30)],
        [f"2026{number:09d}.jpg" for number in range(20)],
        [f"2026-11-29_10-15-30.{20 * number:03d}_cam{number % 2}.jpg" for number in range(30)],
        [f"2026-13-29_10-15-{number:02d}.jpg" for number in range(30)],  # no month
        [f"01-02-{number:02d}.jpg" for number in range(30)],  # three numbers
        [f"20261129_{number:09d}.jpg" for number in range(0, 3000, 10)],
        [f"2011_09_26/{number:06d}_003.jpg" for number in range(50)],  # the number of the camera at the end
        [f"2011-09-26/{number}.jpg" for number in range(100000, 100060)],  # not the first minute after ten
        [f"20261129_{number}.jpg" for number in range(231500, 231560, 10)],
        [f"{number:03d}/010203_{number:09d}.jpg" for number in range(0, 900, 10)],
        [f"{scene}_{view}_2_{number:06d}.jpg" for scene in (0, 22) for view in (1, 2) for number in range(9)],
        [f"tile_{x}_{y}_{z}_128.png" for x in (0, 22) for y in range(12) for z in range(40)],
        [f"aachen_000121_{number:06d}_leftImg8bit.png" for number in range(19)],
    ],
)
def test_numbers_that_may_be_others_are_no_times(names):
    assert times_from_names(names) == ()
    assert in_natural_order(names[::-1]) == names


def test_the_time_since_1970_counts_where_the_time_of_day_is_that_of_the_drive():
    names = [f"n015-2018-07-24-11-22-45+0800__CAM_FRONT__153240292{number}612460.jpg" for number in (7, 8, 9)]
    assert times_from_names(names) == (0, 1, 2)


def test_names_are_searched_for_times_once(tmp_path, monkeypatch):
    folder = _folder(tmp_path / "a", _names("%Y%m%d_%H%M%S.jpg", EVENINGS[0], [1, 1, 70, 1]))
    searched = []
    times = name_clocks._times
    monkeypatch.setattr(name_clocks, "_times", lambda *given: searched.append(given) or times(*given))
    assert "jump" in make_source(RunConfig(folder, "c")).problem
    assert len(searched) == 1


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["315975689237425436", "315975689387425438", "315975689537425437"], [0, 0.15, 0.3]),  # Argoverse 2
        (["ring_front_center_315966070546666304", "ring_front_center_315966070579999304"], [0, 0.033333]),
        (["150723473694744600", "150723473704737600"], [0, 0.09993]),  # OpenLane
        (["15616458249936530", "15616458250936530"], [0, 0.1]),  # DDAD
        (["1241893239199111666", "1241893239399111666"], [0, 0.2]),  # Lyft
        (["1404677221_0109632700_color_rect", "1404677221_0176298700_color_rect"], [0, 0.066666]),  # LLAMAS
        (["1700000000_012345678", "1700000000_062345678"], [0, 0.05]),
        (["1700000000123456789_cam0", "1700000000173456789_cam0"], [0, 0.05]),
        (["1700000000123456789_left", "1700000000173456789_right"], []),  # of two cameras
        (["1700000000_123456_left", "1700000000_173456_right"], []),
        (["133760000000333333", "133760000000666666"], []),  # 0.1 µs since 1601
        (["415975689237425436", "415975689387425438"], [0, 0.15]),
        (["1700000000.910", "1700000000.960", "1700000001.10", "1700000001.60"], [0, 0.05, 0.1, 0.15]),  # ms
        (["1700000000.966700", "1700000001.33", "1700000001.33360"], [0, 0.033333, 0.06666]),  # µs, "%ld.%ld"
    ],
)
def test_whole_numbers_of_time_are_as_data_sets_write_them(names, times):
    np.testing.assert_allclose(times_from_names([f"{name}.jpg" for name in names]), times, atol=1e-6)


def _folder(path, names):
    path.mkdir()
    for name in names:
        Image.fromarray(np.full((4, 6, 3), 99, np.uint8)).save(path / name)
    return str(path)


def test_a_folder_has_the_times_and_the_rate_of_its_names(tmp_path):
    folder = _folder(tmp_path / "a", _names(FORMS[7], EVENINGS[0], [0.05] * 30))
    source = open_source(folder)
    assert source.fps == 20
    np.testing.assert_allclose([frame.time for frame in source], np.arange(31) / 20, atol=1e-9)
    assert make_source(RunConfig(folder, "c")).problem == ""
    given_rate = make_source(RunConfig(folder, "c", fps=10.0))
    assert given_rate.times == ()
    assert given_rate.problem.endswith("its names state 20 frames per second, --fps 10 was given")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (
            [f"20261129_1015{number // 12:02d}_{number:05d}.jpg" for number in range(5, 55)],
            "the times in their names are whole seconds, with 12 images in each, 30 frames per second are "
            "assumed; state --fps",
        ),
        (
            ["20261129_101530.jpg", "20261129_101531.jpg", "20261129_101631.jpg", "20261129_101831.jpg"],
            "the times in their names jump, as from 20261129_101631.jpg to 20261129_101831.jpg, which are "
            "taken for frames one after another; give each part a run; {}: no times are read from their "
            "names, 30 frames per second are assumed; state --fps",
        ),
        (
            [f"2026-11-29_10-15-3{number // 10}.{number % 10}1_cam{number % 2}.jpg" for number in range(30)],
            "numbers beside the times in their names may be those of cameras, as from "
            "2026-11-29_10-15-30.01_cam0.jpg to 2026-11-29_10-15-30.11_cam1.jpg, 30 frames per second are "
            "assumed; give the images of one as a quoted glob",
        ),
    ],
)
def test_why_times_in_names_are_not_those_of_the_frames(tmp_path, names, words):
    folder = _folder(tmp_path / "a", names)
    assert make_source(RunConfig(folder, "c")).problem == f"{folder}: {words.format(folder)}"
