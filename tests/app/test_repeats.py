"""Frames that are shown twice, and drives in which none is."""

import numpy as np
import pytest

from lanebev.app.repeats import RepeatedFrames, repeated


def _drive(pattern, noise=0.1):
    """Images that move by a column with each new letter of a pattern, each compressed anew."""
    random = np.random.default_rng(0)
    scene = random.integers(0, 256, (48, 200, 3))
    shown = RepeatedFrames()
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
        ("abcdefffffffffff", 2),  # it stops: two frames are near a moving one
    ],
)
def test_repeated_frames_are_counted(pattern, count):
    shown = _drive(pattern)
    assert int(repeated(np.array(shown._changes)).sum()) == count
    said = shown.remark()
    assert bool(said) == (count > 4)
    if said:
        assert said.startswith(f"{count} of {len(pattern)} frames repeat the one before")


def test_lost_frames_and_short_drives_are_no_repetition():
    shown = RepeatedFrames()
    assert shown.remark() == ""
    for image in (None, np.zeros((48, 64, 3), np.uint8), None, np.full((48, 64, 3), 9, np.uint8)):
        shown.add(image)
    assert shown.remark() == ""
