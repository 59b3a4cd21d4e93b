"""Arrows, words and signs painted in lanes: a table of pictures, sampled with the pixel's exact footprint."""

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lanebev.render.raster.base.select import indices_where, put, take
from lanebev.render.scene.places.street import TEXTS

GLYPH_LENGTH, GLYPH_WIDTH = 5.0, 2.0  # m of a picture along and across the road
_ROWS, _COLUMNS, _FINE = 200, 80, 4  # texels of 2.5 cm, drawn four times finer
_FINE_SIZE = (_ROWS * _FINE, _COLUMNS * _FINE)
_FINE_PER_METRE = (_COLUMNS * _FINE / GLYPH_WIDTH, _ROWS * _FINE / GLYPH_LENGTH)  # across and along

Picture = npt.NDArray[np.uint8]
Outline = list[tuple[float, float]]

_HEAD: Outline = [(-0.45, 3.0), (0.45, 3.0), (0.0, 5.0)]
_STEM: Outline = [(-0.1, 0.0), (0.1, 0.0), (0.1, 3.1), (-0.1, 3.1)]
_SLIM: Outline = [(-0.06, 0.0), (0.06, 0.0), (0.06, 3.4), (-0.06, 3.4)]
_SLIM_HEAD: Outline = [(-0.3, 3.2), (0.3, 3.2), (0.0, 5.0)]
_BEND: list[Outline] = [  # to the left
    [(0.12, 0.0), (0.3, 0.0), (0.3, 3.0), (0.12, 3.3)],
    [(0.3, 2.9), (0.24, 3.5), (-0.35, 4.1), (-0.35, 3.5), (0.1, 2.9)],
    [(-0.95, 3.75), (-0.3, 2.6), (-0.3, 5.0)],
]
_SIDE: list[Outline] = [  # a smaller bend beside a stem, to the left
    [(0.05, 1.5), (0.05, 2.1), (-0.45, 2.7), (-0.45, 2.2)],
    [(-0.95, 2.45), (-0.42, 1.5), (-0.42, 3.4)],
]
_MERGE: list[Outline] = [
    [(0.35, 0.0), (0.52, 0.0), (0.35, 2.2), (-0.15, 3.3), (-0.3, 3.1), (0.2, 2.0)],
    [(0.2, 3.3), (-0.55, 2.7), (-0.5, 5.0)],
]


def _mirrored(outlines: list[Outline]) -> list[Outline]:
    return [[(-x, y) for x, y in outline] for outline in outlines]


def _texels(outline: Outline) -> npt.NDArray[np.int32]:
    """Convert points (P, 2) m of a glyph to texels of its fine picture."""
    points: npt.NDArray[np.float64] = np.array(outline) + np.array([0.5 * GLYPH_WIDTH, 0.0])
    return (points * _FINE_PER_METRE).round().astype(np.int32)


def _filled(outlines: list[Outline]) -> Picture:
    picture = np.zeros(_FINE_SIZE, np.uint8)
    for outline in outlines:
        cv2.fillPoly(picture, [_texels(outline)], 255)
    return picture


def _stroked(lines: list[Outline], wide: int, rings: list[tuple[float, float, float, float]]) -> Picture:
    picture = np.zeros(_FINE_SIZE, np.uint8)
    for line in lines:
        cv2.polylines(picture, [_texels(line)], False, 255, wide)
    for x, y, a, b in rings:
        radii = (int(a * _FINE_PER_METRE[0]), int(b * _FINE_PER_METRE[1]))
        cv2.ellipse(picture, _texels([(x, y)])[0].tolist(), radii, 0, 0, 360, 255, wide)
    return picture


def _written(text: str) -> Picture:
    """Draw a word, upright for the driver, 1.6 m wide and 2.4 to 4 m long."""
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 6.0, 36)
    canvas = np.zeros((high + 60, wide + 60), np.uint8)
    cv2.putText(canvas, text, (30, high + 25), cv2.FONT_HERSHEY_SIMPLEX, 6.0, 255, 36)
    columns = int(_COLUMNS * _FINE * (0.45 if len(text) == 1 else 0.85))
    rows = int(_ROWS * _FINE * (0.5 if len(text) > 2 else 0.75))
    canvas = cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA)[::-1]
    picture = np.zeros(_FINE_SIZE, np.uint8)
    left = (picture.shape[1] - columns) // 2
    picture[:rows, left : left + columns] = canvas
    return picture


def _pictures() -> list[Picture]:
    teeth: list[Outline] = [[(x - 0.25, 0.0), (x + 0.25, 0.0), (x, 1.2)] for x in (-0.66, 0.0, 0.66)]
    bicycle: list[Outline] = [
        [(-0.45, 0.9), (-0.15, 2.1), (0.3, 2.1), (0.0, 0.9), (-0.45, 0.9)],
        [(0.0, 0.9), (-0.2, 2.5), (-0.35, 2.5)],
        [(0.45, 0.9), (0.27, 2.6), (0.45, 2.7)],
    ]
    diamond: list[Outline] = [[(0.0, 0.3), (0.42, 2.4), (0.0, 4.5), (-0.42, 2.4), (0.0, 0.3)]]
    cross: list[Outline] = [[(-0.97, 0.1), (0.97, 4.9)], [(0.97, 0.1), (-0.97, 4.9)]]
    rim: list[Outline] = [[(-0.97, 0.1), (0.97, 0.1), (0.97, 4.9), (-0.97, 4.9), (-0.97, 0.1)]]
    return [
        _filled([_STEM, _HEAD]),
        _filled([_SLIM, _SLIM_HEAD]),
        _filled(_BEND),
        _filled(_mirrored(_BEND)),
        _filled([_STEM, _HEAD, *_SIDE]),
        _filled([_STEM, _HEAD, *_mirrored(_SIDE)]),
        _filled([[*_STEM[:2], (0.1, 1.9), (-0.1, 1.9)], *_SIDE, *_mirrored(_SIDE)]),
        _filled(_MERGE),
        _filled(_mirrored(_MERGE)),
        _filled(teeth),
        _stroked(bicycle, 14, [(-0.45, 0.9, 0.3, 0.75), (0.45, 0.9, 0.3, 0.75)]),
        _stroked(diamond, 20, []),
        _stroked([*cross, *rim], 18, []),
        *(_written(text) for text in TEXTS),
    ]


@lru_cache(maxsize=8)
def _integral_table(device: torch.device) -> Tensor:
    """Compute the glyphs' integral images, (G · (ROWS + 1) · (COLUMNS + 1),).

    At (g, r, c) is the paint of glyph g in rows < r and columns < c.
    """
    small = [cv2.resize(p, (_COLUMNS, _ROWS), interpolation=cv2.INTER_AREA) for p in _pictures()]
    paint = torch.from_numpy(np.stack(small).astype(np.float64)) / 255
    table = torch.nn.functional.pad(paint.cumsum(1).cumsum(2), (1, 0, 1, 0))
    return table.float().flatten().to(device)


def glyph_coverage(glyph: Tensor, x: Tensor, y: Tensor, reach_x: Tensor, reach_y: Tensor) -> Tensor:
    """Compute the share of a pixel that a glyph's paint covers: the exact mean over the pixel's footprint.

    Args:
        glyph: (...,) int64; negative is none.
        x: (...,) m right of the glyph's middle.
        y: (...,) m beyond its near end.
        reach_x: (...,) m per pixel across.
        reach_y: (...,) m per pixel along.

    Returns:
        (...,) in [0, 1].
    """
    covered = torch.zeros_like(x)
    painted = indices_where(glyph >= 0)  # few
    x, y, reach_x, reach_y = (take(t, painted) for t in (x, y, reach_x, reach_y))
    value = _mean_paint(take(glyph, painted), x, y, reach_x, reach_y)
    put(covered.view(1, -1), painted, value[None])
    return covered


def _mean_paint(glyph: Tensor, x: Tensor, y: Tensor, reach_x: Tensor, reach_y: Tensor) -> Tensor:
    """Average the paint of glyphs over pixels, see :func:`glyph_coverage`; no glyph is negative."""
    table = _integral_table(x.device)
    across, along = _COLUMNS / GLYPH_WIDTH, _ROWS / GLYPH_LENGTH
    wide, tall = (reach_x * across).clamp(min=1.0), (reach_y * along).clamp(min=1.0)
    column, row = (x + 0.5 * GLYPH_WIDTH) * across, y * along
    base = glyph * ((_ROWS + 1) * (_COLUMNS + 1))

    def painted_below(r: Tensor, c: Tensor) -> Tensor:
        r, c = r.clamp(0, _ROWS), c.clamp(0, _COLUMNS)
        r0, c0 = r.floor().clamp(max=_ROWS - 1), c.floor().clamp(max=_COLUMNS - 1)
        dr, dc = r - r0, c - c0
        at = base + r0.long() * (_COLUMNS + 1) + c0.long()
        low = table.take(at) * (1 - dc) + table.take(at + 1) * dc
        high = table.take(at + _COLUMNS + 1) * (1 - dc) + table.take(at + _COLUMNS + 2) * dc
        return low * (1 - dr) + high * dr

    r0, r1, c0, c1 = row - 0.5 * tall, row + 0.5 * tall, column - 0.5 * wide, column + 0.5 * wide
    inside = painted_below(r1, c1) - painted_below(r0, c1) - painted_below(r1, c0) + painted_below(r0, c0)
    return (inside / (wide * tall)).clamp(0, 1)
