"""Parts of a long drive: where they are cut, and that joined rows are those of the drive."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from lanebev.app.config import RunConfig
from lanebev.app.fleet.joining import Part, duration, join_parts, joined_rows, parts_of
from lanebev.app.fleet.manifest import Drive
from lanebev.app.fleet.plan import Outcome, drive_outcome, tasks_of
from lanebev.io.covariances import read_covariances, write_covariances
from lanebev.io.results import ExtrinsicsRow, read_extrinsics, write_extrinsics
from lanebev.io.video import VideoWriter


def test_parts_cover_the_drive_and_overlap():
    assert parts_of(0, 100, 30, 10) == [Part(0, 30), Part(20, 60), Part(50, None)]
    assert parts_of(5, 40, 30, 10) == [Part(5, None)]
    assert parts_of(0, 61, 30, 40) == [Part(0, 30), Part(0, None)]
    assert parts_of(0, float("inf"), 30, 10) == [Part(0, None)]


def _rows(times, number=0.0):
    return [
        ExtrinsicsRow(
            i, time - times[0], 1.0, 2.0, 3.0, number + time, 0.1, 0.1, 0.1, 0.01, "TRACKING", 9, ""
        )
        for i, time in enumerate(times)
    ]


@pytest.fixture
def cut():
    """Irregular times of a drive, its parts, and the rows of each; the height says part and time."""
    times = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.2, 400)).round(6)
    times -= times[0]
    parts = parts_of(0.0, float(times[-1]), 15.0, 4.0)
    assert len(parts) == 3
    own = [times[(times >= part.start) & (times < (part.end or np.inf))].tolist() for part in parts]
    return times, parts, [_rows(each, 1000.0 * number) for number, each in enumerate(own)]


def test_joined_rows_are_those_of_the_drive(cut, tmp_path):
    times, parts, rows = cut
    folders = [tmp_path / f"part-{number}" for number in range(3)]
    for folder, own in zip(folders, rows, strict=True):
        folder.mkdir()
        write_extrinsics(folder / "extrinsics.csv", own)
        write_covariances(folder / "covariance.csv", [np.eye(4) * row.height_m for row in own])
    assert join_parts(tmp_path / "drive", parts, folders) == len(times)
    joined = read_extrinsics(tmp_path / "drive" / "extrinsics.csv")
    assert [row.frame for row in joined] == list(range(len(times)))
    np.testing.assert_allclose([row.time_s for row in joined], times, atol=5e-6)
    heights = np.array([row.height_m for row in joined])
    np.testing.assert_allclose(heights % 1000, times, atol=1e-5)
    np.testing.assert_array_equal(
        heights // 1000, np.searchsorted([part.end for part in parts[:-1]], times, "right")
    )
    np.testing.assert_allclose(
        read_covariances(tmp_path / "drive" / "covariance.csv")[:, 2, 2], heights, rtol=1e-8
    )


def test_parts_that_do_not_fit_are_refused(cut):
    _, parts, rows = cut
    with pytest.raises(ValueError, match="part 1: expected frames in common"):
        joined_rows([parts[0], replace_start(parts[1]), parts[2]], rows)
    late = [row._replace(time_s=1.1 * row.time_s) for row in rows[2]]
    with pytest.raises(ValueError, match="part 2: expected the times of the part before"):
        joined_rows(parts, [*rows[:2], late])


def replace_start(part):
    return part._replace(start=part.end)


def test_a_long_video_is_some_tasks(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", Fraction(5)) as writer:
        for _ in range(50):
            writer.write(np.zeros((32, 32, 3), np.uint8))
    assert duration(tmp_path / "a.mp4") == pytest.approx(10.0, abs=0.2)
    assert duration(tmp_path / "none.mp4") == float("inf")
    config = RunConfig(str(tmp_path / "a.mp4"), "c.yaml", end=9.0)
    drive = Drive("one", "c", "unknown", "", config)
    first, second, third = tasks_of([drive], tmp_path, 3.0, 1.0)["one"]
    assert (first.config.start, first.config.end) == (0.0, 3.0)
    assert (second.config.start, second.config.end) == (2.0, 6.0)
    assert (third.config.start, third.config.end, third.name) == (5.0, 9.0, "one, part 2")
    assert third.config.out == str(tmp_path / "drives" / "one" / "part-002")
    (whole,) = tasks_of([drive], tmp_path, 30.0, 1.0)["one"]
    assert (whole.name, whole.parts, whole.config) == ("one", (), replace(config, out=whole.config.out))
    good = [Outcome(f"one, part {i}", frames=10, seconds=1.0) for i in range(3)]
    assert drive_outcome("one", (first, second, third), good) == Outcome("one", frames=30, seconds=3.0)
    bad = [good[0], Outcome("one, part 1", failure="no"), good[2]]
    assert drive_outcome("one", (first, second, third), bad).failure == "part 1: no"
