"""Frames that are shown twice, and drives in which none is."""

import math

import numpy as np
import pytest

from lanebev.app.recording.repeats import RepeatedFrames, repeated


def _drive(pattern, folder=None, noise=0.1):
    """Images that move by a column with each new letter of a pattern, each compressed anew."""
    random = np.random.default_rng(0)
    scene = random.integers(0, 256, (48, 200, 3))
    shown = RepeatedFrames(folder)
    place = 0
    for number, letter in enumerate(pattern):
        place += bool(number) and letter != pattern[number - 1]
        image = scene[:, place : place + 64] + (random.random((48, 64, 1)) < noise)
        shown.add(image.clip(0, 255).astype(np.uint8))
    return shown


@pytest.mark.parametrize(
    ("pattern", "count"),
    [
        ("aabbccddee" * 2, 10),  # each frame twice
        ("abccdefgghij" * 3, 6),  # 12 frames of 10
        ("aaabbbcccddd", 8),
        ("abcdefghijkl", 0),
        ("aaaaaaaaaaaa", 0),  # the car stands
        ("abcdefffffffffff", 0),  # it stops: the two frames near a moving one are few
    ],
)
def test_repeated_frames_are_counted(tmp_path, pattern, count):
    said = _drive(pattern).remark()
    assert said.startswith(f"{count} of {len(pattern)} frames repeat the one before" if count else "")
    assert bool(said) == bool(count)
    assert _drive(pattern, tmp_path).remark() == said  # kept on disk


def test_a_frozen_video_is_said_and_a_standing_car_is_not():
    assert (
        _drive("abc" + 9 * "d", noise=0.0)
        .remark()
        .startswith("8 of 12 frames show the image of the one before: is")
    )
    assert _drive("abc" + 9 * "d", noise=0.5).remark() == ""


@pytest.mark.parametrize(
    ("changes", "count"),
    [
        ([math.nan, 5, 0.4, 5, 0.4, 5], 2),
        ([math.nan, 5, 5, 0.5, 0.5, 0.5, 0.5], 2),  # it stops: two frames are near a moving one
        ([math.nan, 0.9, 0.1, 0.9, 0.1], 0),  # all but stands
        ([math.nan, 5, math.nan, 5, 1.1, 5], 0),  # a lost frame is none
    ],
)
def test_a_frame_that_changes_far_less_than_its_neighbours_is_repeated(changes, count):
    assert int(repeated(np.array(changes)).sum()) == count


def test_lost_frames_and_short_drives_are_no_repetition():
    shown = RepeatedFrames()
    assert shown.remark() == ""
    for image in (None, np.zeros((48, 64, 3), np.uint8), None, np.full((48, 64, 3), 9, np.uint8)):
        shown.add(image)
    assert shown.remark() == ""
