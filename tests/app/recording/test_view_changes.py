"""Frames of another view than the ones before: mirrored, turned, of another camera."""

import cv2
import numpy as np
import pytest

from lanebev.app.recording.view_changes import ViewChanges

SIZE = (96, 160)


def _world(seed):
    """A wide picture of smooth noise, of which every frame shows a part a little further to the right."""
    noise = np.random.default_rng(seed).normal(size=(SIZE[0], 1600))
    smooth = cv2.GaussianBlur(noise, (0, 0), 12)
    grey = 128 + 50 * smooth / smooth.std()
    return np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)


WORLDS = [_world(0), _world(1)]


def _view(number, world=0):
    return WORLDS[world][:, 4 * number : 4 * number + SIZE[1]]


def _remark(images, steps=None):
    changes = ViewChanges()
    for number, image in enumerate(images):
        changes.add(number, image, 0.1 if steps is None else steps[number])
    return changes.remark()


DRIVE = [_view(number) for number in range(30)]


def _lit(gain):
    """The drive with images that are darker or brighter from one frame to the next, clipped at white."""
    return [*DRIVE[:15], *((image * gain).clip(0, 255).astype(np.uint8) for image in DRIVE[15:])]


@pytest.mark.parametrize(
    ("images", "steps"),
    [
        (DRIVE, None),
        (_lit(0.6), None),
        (_lit(0.1), None),
        (_lit(1.7), None),
        ([*DRIVE[:12], np.full_like(DRIVE[0], 255), *DRIVE[13:]], None),  # a flash of light
        ([*DRIVE[:12], None, None, *DRIVE[14:]], None),
        ([*DRIVE[:10], *map(_view, range(40, 60))], [*[0.1] * 10, 3.0, *[0.1] * 19]),  # a pause
        ([DRIVE[number // 2] for number in range(30)], None),  # every frame twice
        ([_view(12 * number) for number in range(30)], None),  # one frame a second
        ([np.full((*SIZE, 3), 7 * number, np.uint8) for number in range(30)], None),
        (list(np.random.default_rng(0).integers(0, 255, (30, *SIZE, 3), dtype=np.uint8)), None),
        ([], None),
    ],
)
def test_a_drive_of_one_camera_has_no_remark(images, steps):
    assert _remark(images, steps) == ""


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        (np.s_[:, ::-1], "mirrored"),
        (np.s_[::-1], "upside down"),
        (np.s_[::-1, ::-1], "turned by 180 degrees"),
    ],
)
def test_images_that_are_turned_from_one_frame_to_the_next(turn, words):
    turned = [*DRIVE[:12], *(image[turn] for image in DRIVE[12:])]
    assert _remark(turned) == f"frame 12 is {words} against the one before; give each part a run"
    back = [*turned[:20], *DRIVE[20:]]
    assert _remark(back).startswith(f"frame 12, the first of 2 such, is {words} against the one before;")


def test_a_cut_to_another_drive_or_camera():
    joined = [*DRIVE[:17], *(_view(number, 1) for number in range(17, 30))]
    words = "shows another view than the one before: are drives or cameras joined? give each a run"
    assert _remark(joined) == f"frame 17 {words}"
    assert _remark([*joined, *DRIVE]) == f"frame 17, the first of 2 such, {words}"


def test_images_of_two_cameras_in_turn():
    in_turn = [_view(number, number % 2) for number in range(30)]
    assert _remark(in_turn).endswith("are they of two cameras in turn? give the images of one")
    assert _remark(in_turn[:8]) == ""  # too few
