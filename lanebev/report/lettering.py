"""Draw text on pictures, in place."""

from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Picture = NDArray[np.uint8]
Colour = tuple[int, ...]


def write_text(
    picture: Picture,
    place: tuple[float, float],
    text: str,
    colour: Colour,
    size: int,
    bold: bool = False,
    anchor: str = "la",
) -> None:
    """Write a line of text on a picture, in place; what does not fit is cut.

    Args:
        picture: (H, W, 3) RGB.
        place: x, y px of the anchor.
        text: one line.
        colour: RGB.
        size: px.
        bold: the bold font.
        anchor: anchor of the text, as Pillow names it: "la" is the left end of its ascender line.
    """
    mask, (left, top) = _letters(_printable(text), size, bold, anchor)
    x, y = round(place[0]) + left, round(place[1]) + top
    rows, columns = slice(max(y, 0), y + mask.shape[0]), slice(max(x, 0), x + mask.shape[1])
    under = picture[rows, columns]
    share = mask[rows.start - y :, columns.start - x :][: under.shape[0], : under.shape[1], None]
    under[:] = under + share * (np.array(colour, np.float32) - under) + 0.5


def text_width(text: str, size: int, bold: bool = False) -> float:
    """Return the width of a line of text, px."""
    return _font(size, bold).getlength(_printable(text))


def _printable(text: str) -> str:
    """Return a text with plain spaces, and a sign for what no font has, such as bytes that are no letters."""
    spaced = (" " if letter.isspace() else letter for letter in text)
    return "".join(letter if letter.isprintable() else "\ufffd" for letter in spaced)


@lru_cache(maxsize=64)
def _letters(text: str, size: int, bold: bool, anchor: str) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """Return the share of ink in each pixel, and the offset of its upper left corner from the anchor, px."""
    font = _font(size, bold)
    left, top, right, bottom = (round(side) for side in font.getbbox(text, anchor=anchor))
    mask = Image.new("L", (max(right - left, 1), max(bottom - top, 1)))
    ImageDraw.Draw(mask).text((-left, -top), text, fill=255, font=font, anchor=anchor)
    share = np.asarray(mask, np.float32) / np.float32(255)
    return share, (left, top)


@lru_cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"  # matplotlib brings them
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, size)
