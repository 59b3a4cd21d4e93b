"""Words on pictures."""

import numpy as np
import pytest
from PIL import Image, ImageDraw

from lanebev.report.lettering import _font, text_width, write_text


@pytest.mark.parametrize("anchor", ["la", "ra", "rm"])
def test_text_is_what_pillow_draws(anchor):
    picture = np.full((60, 200, 3), (40, 90, 140), np.uint8)
    drawing = ImageDraw.Draw(whole := Image.fromarray(picture.copy()))
    drawing.text((100, 20), "yaw -0.10°", fill=(250, 200, 30), font=_font(18), anchor=anchor)
    write_text(picture, (100, 20), "yaw -0.10°", (250, 200, 30), 18, anchor=anchor)
    difference = np.abs(picture.astype(int) - np.asarray(whole))
    assert difference.max() <= 2
    assert np.ptp(picture, axis=(0, 1)).min() > 100  # it is there


@pytest.mark.parametrize("name", ["\udcff.png", "a\nb", "\x00", ""])
def test_any_name_can_be_written(name):
    picture = np.zeros((30, 90, 3), np.uint8)
    write_text(picture, (5, 5), name, (255, 255, 255), 18)
    assert picture.any() == bool(name)
    assert (text_width(name, 18) > 0) == bool(name)


@pytest.mark.parametrize("space", ["\u202f", "\xa0", "\n"])  # the first one is in names of macOS
def test_any_space_is_written_as_a_space(space):
    pictures = np.zeros((2, 30, 90, 3), np.uint8)
    for picture, name in zip(pictures, (f"1{space}AM", "1 AM"), strict=True):
        write_text(picture, (5, 5), name, (255, 255, 255), 18)
    np.testing.assert_array_equal(*pictures)


def test_text_is_cut_at_the_border():
    picture = np.zeros((30, 40, 3), np.uint8)
    for place in ((-8, 5), (30, 5), (5, -8), (5, 24), (300, 5), (5, 300), (-300, 5), (5, -300)):
        write_text(picture, place, "wide", (255, 255, 255), 18)
    assert picture.any()
    assert text_width("wide", 18, bold=True) > text_width("wide", 18) > 30
