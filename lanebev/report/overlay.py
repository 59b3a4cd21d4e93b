"""The overlay: a frame with what was seen and believed in it, and its bird's-eye view before and after."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.geometry.road import horizon_line, road_from_image_points
from lanebev.geometry.rotation import vanishing_dir_from_pitch_yaw
from lanebev.observation.segments import LaneSegments
from lanebev.types import Calibration, Extrinsics, Status
from lanebev.view.grid import BEVGrid

Picture = NDArray[np.uint8]

BOUNDARY_COLOURS = (
    (186, 140, 255), (80, 170, 255), (0, 214, 160), (255, 190, 0), (255, 112, 96), (255, 150, 214),
)  # fmt: skip
"""RGB of boundaries 0..5, told apart also without red and green, on asphalt and on paper."""

PANEL_HEIGHT = 720
_WIDEST = 4  # times its height, of a picture that fills it
_HORIZON, _INK, _QUIET, _BACKGROUND = (255, 255, 255), (235, 238, 242), (150, 158, 168), (18, 20, 24)
_STATUS_COLOURS = {
    Status.TRACKING: (0, 214, 160), Status.COASTING: (255, 190, 0), Status.LOST: (255, 92, 80),
}  # fmt: skip
_SUBPIXEL = 4  # bits of cv2's fixed-point coordinates


@dataclass(frozen=True)
class Panel:
    """A bird's-eye view, the words above it, and the pose it was made with ((1,) each)."""

    title: str
    bev: Picture
    extrinsics: Extrinsics


def draw_frame(
    image: Picture,
    camera: Camera,
    segments: LaneSegments,
    calibration: Calibration,
    headline: str,
    views: tuple[Panel, ...],
    grid: BEVGrid,
    reasons: str = "",
) -> Picture:
    """Return the pictures of :func:`draw_panels` as one, (720, W', 3)."""
    return joined(draw_panels(image, camera, segments, calibration, headline, views, grid, reasons))


def draw_panels(
    image: Picture,
    camera: Camera,
    segments: LaneSegments,
    calibration: Calibration,
    headline: str,
    views: tuple[Panel, ...],
    grid: BEVGrid,
    reasons: str = "",
) -> list[Picture]:
    """Return the input with segments, boundaries, horizon and vanishing point, and its bird's-eye views.

    Args:
        image: (H, W, 3) as taken.
        camera: its lens.
        segments: of batch size 1, undistorted.
        calibration: of batch size 1, on the CPU.
        headline: what frame this is.
        views: e.g. before and after.
        grid: of the views.
        reasons: why the frame is not (fully) tracked, in words.

    Returns:
        (720, W, 3) each, the input first.
    """
    scale = PANEL_HEIGHT / max(image.shape[0], image.shape[1] / _WIDEST)
    size = (round(image.shape[1] * scale), max(1, round(image.shape[0] * scale)))
    shown = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    _draw_horizon(shown, camera, calibration.extrinsics, scale)
    _draw_boundaries(shown, camera, segments, calibration.inliers, scale)
    _draw_vanishing_point(shown, camera, calibration.extrinsics, scale)
    below = PANEL_HEIGHT - size[1]
    shown = cv2.copyMakeBorder(shown, 0, below, 0, 0, cv2.BORDER_CONSTANT, value=_BACKGROUND)
    status = Status(int(calibration.status[0]))
    shown = _banner(shown, headline, status.name, _STATUS_COLOURS.get(status, _QUIET), _numbers(calibration))
    if reasons:
        shown = _note(shown, reasons)
    return [shown, *(_bev_panel(view, grid, camera, segments) for view in views)]


def joined(panels: Sequence[Picture]) -> Picture:
    """Return pictures of equal height side by side, with a gap between them."""
    gap = np.full((panels[0].shape[0], 8, 3), _BACKGROUND, np.uint8)
    return np.concatenate([part for panel in panels for part in (panel, gap)][:-1], axis=1)


def _numbers(calibration: Calibration) -> str:
    pitch, yaw, roll, height = calibration.extrinsics.stack()[0].tolist()
    std = calibration.covariance[0].diagonal().clamp_min(0).sqrt().tolist()
    angles = "   ".join(
        f"{name} {math.degrees(value):+.2f}° ±{math.degrees(2 * sigma):.2f}"
        for name, value, sigma in zip(("pitch", "yaw", "roll"), (pitch, yaw, roll), std, strict=False)
    )
    return f"{angles}   height {height:.3f} m ±{2 * std[3]:.3f}"


def _draw_boundaries(
    shown: Picture, camera: Camera, segments: LaneSegments, inliers: Tensor, scale: float
) -> None:
    """Vertices as dots, each boundary's as one line through them; what was not believed is grey."""
    ends = _to_image(camera, segments.endpoints[0].flatten(0, 1)).reshape(-1, 2, 2) * scale
    there = segments.weight[0] > 0
    believed = there & (inliers[0] > 0.5)
    for point in ends[there & ~believed].flatten(0, 1):
        _dot(shown, point, 2, _QUIET)
    lines = list(_polylines(ends, segments.boundary[0], believed))
    soft = shown.copy()
    for colour, points in lines:
        cv2.polylines(soft, [_fixed(points)], False, colour, 7, cv2.LINE_AA, _SUBPIXEL)
    cv2.addWeighted(soft, 0.45, shown, 0.55, 0, dst=shown)
    for colour, points in lines:
        cv2.polylines(shown, [_fixed(points)], False, colour, 1, cv2.LINE_AA, _SUBPIXEL)
        for point in points:
            _dot(shown, point, 3, colour)


def _polylines(ends: Tensor, boundary: Tensor, kept: Tensor) -> Iterator[tuple[tuple[int, int, int], Tensor]]:
    """Colour and (P, 2) vertices from top to bottom of each boundary; ends (N, 2, 2), kept (N,)."""
    for index in sorted(set(boundary[kept].tolist())):
        points = ends[kept & (boundary == index)].flatten(0, 1)
        yield BOUNDARY_COLOURS[index % len(BOUNDARY_COLOURS)], points[points[:, 1].argsort()]


def _draw_horizon(shown: Picture, camera: Camera, extrinsics: Extrinsics, scale: float) -> None:
    a, b, c = horizon_line(extrinsics, camera.intrinsics[None].to(extrinsics.pitch))[0].tolist()
    if abs(b) < 1e-6:
        return
    x = torch.linspace(0, camera.image_size[1], 65, dtype=torch.float64)
    points = _to_image(camera, torch.stack([x, -(a * x + c) / b], dim=-1)) * scale
    for start, end in zip(points[:-1:2], points[1::2], strict=False):  # dashes
        if torch.isfinite(start + end).all():
            ends = _fixed(torch.stack([start, end]))
            cv2.polylines(shown, [ends], False, _HORIZON, 1, cv2.LINE_AA, _SUBPIXEL)


def _draw_vanishing_point(shown: Picture, camera: Camera, extrinsics: Extrinsics, scale: float) -> None:
    ray = vanishing_dir_from_pitch_yaw(extrinsics.pitch, extrinsics.yaw)[0].to(camera.intrinsics)
    pixel = camera.intrinsics @ ray
    point = _to_image(camera, (pixel[:2] / pixel[2])[None])[0] * scale
    if torch.isfinite(point).all():
        centre = tuple(_fixed(point[None])[0].tolist())
        cv2.circle(shown, centre, 9 << _SUBPIXEL, (0, 0, 0), 4, cv2.LINE_AA, _SUBPIXEL)
        cv2.circle(shown, centre, 9 << _SUBPIXEL, _HORIZON, 2, cv2.LINE_AA, _SUBPIXEL)
        _dot(shown, point, 2, _HORIZON)


def _banner(shown: Picture, headline: str, status: str, colour: tuple[int, ...], numbers: str) -> Picture:
    shown[:44] = (0.3 * shown[:44] + 0.7 * np.array(_BACKGROUND)).astype(np.uint8)
    drawing = ImageDraw.Draw(picture := Image.fromarray(shown))
    drawing.text((12, 12), headline, fill=_INK, font=_font(18))
    x = 12 + drawing.textlength(headline, font=_font(18)) + 24
    drawing.text((x, 12), status, fill=colour, font=_font(18, bold=True))
    room = shown.shape[1] - 12
    size = next((s for s in (17, 15, 13) if x + 150 + drawing.textlength(numbers, font=_font(s)) < room), 0)
    if size:
        drawing.text((room, 13), numbers, fill=_INK, font=_font(size), anchor="ra")
    else:  # a narrow picture: a second strip below
        shown = np.asarray(picture).copy()
        shown[44:76] = (0.3 * shown[44:76] + 0.7 * np.array(_BACKGROUND)).astype(np.uint8)
        drawing = ImageDraw.Draw(picture := Image.fromarray(shown))
        drawing.text((12, 50), numbers, fill=_INK, font=_font(15))
    return np.asarray(picture)


def _note(shown: Picture, text: str) -> Picture:
    """Return the picture with a line of text at the bottom, on a dark strip."""
    shown = shown.copy()
    shown[-34:] = (0.3 * shown[-34:] + 0.7 * np.array(_BACKGROUND)).astype(np.uint8)
    picture = Image.fromarray(shown)
    ImageDraw.Draw(picture).text((12, PANEL_HEIGHT - 27), text, fill=_INK, font=_font(16))
    return np.asarray(picture)


def _bev_panel(view: Panel, grid: BEVGrid, camera: Camera, segments: LaneSegments) -> Picture:
    """The view below its title, the boundaries thin in it, and a scale of metres ahead on its left."""
    head, left = 44, 34
    height = PANEL_HEIGHT - head
    width = round(view.bev.shape[1] * height / view.bev.shape[0])
    panel = np.full((PANEL_HEIGHT, left + width, 3), _BACKGROUND, np.uint8)
    bev = cv2.resize(view.bev, (width, height), interpolation=cv2.INTER_AREA)
    _draw_bev_boundaries(bev, view, grid, camera, segments)
    panel[head:, left:] = bev
    drawing = ImageDraw.Draw(picture := Image.fromarray(panel))
    drawing.text((left, 12), view.title, fill=_INK, font=_font(18))
    for metres in range(10 * math.ceil(grid.z[0] / 10), math.floor(grid.z[1]) + 1, 10):
        y = head + (grid.z[1] - metres) / (grid.z[1] - grid.z[0]) * height
        drawing.line([(left - 6, y), (left, y)], fill=_QUIET, width=1)
        drawing.text((left - 8, max(y, head + 8)), str(metres), fill=_QUIET, font=_font(13), anchor="rm")
    drawing.text((left - 8, PANEL_HEIGHT - 10), "m", fill=_QUIET, font=_font(13), anchor="rm")
    return np.asarray(picture)


def _draw_bev_boundaries(
    bev: Picture, view: Panel, grid: BEVGrid, camera: Camera, segments: LaneSegments
) -> None:
    intrinsics = camera.intrinsics[None].to(segments.endpoints)
    points, valid = road_from_image_points(segments.endpoints.flatten(1, 2), intrinsics, view.extrinsics)
    ends = grid.bev_from_road_points(points[0]).reshape(-1, 2, 2) * (bev.shape[0] / grid.shape[0])
    kept = (segments.weight[0] > 0) & valid[0].reshape(-1, 2).all(-1)
    soft = bev.copy()
    for colour, line in _polylines(ends, segments.boundary[0], kept):
        cv2.polylines(soft, [_fixed(line)], False, colour, 1, cv2.LINE_AA, _SUBPIXEL)
    cv2.addWeighted(soft, 0.7, bev, 0.3, 0, dst=bev)


def _to_image(camera: Camera, points: Tensor) -> Tensor:
    """(N, 2) undistorted px to (N, 2) px as taken."""
    return camera.distort_points(points.to(camera.intrinsics))


def _fixed(points: Tensor) -> NDArray[np.int32]:
    """Pixels, centres at integers, to cv2's fixed point."""
    bounded = points.nan_to_num(-1e4).clamp(-3e4, 3e4)
    return np.asarray((bounded * (1 << _SUBPIXEL)).round().to(torch.int32).numpy())


def _dot(shown: Picture, point: Tensor, radius: int, colour: tuple[int, ...]) -> None:
    centre = tuple(_fixed(point[None])[0].tolist())
    cv2.circle(shown, centre, radius << _SUBPIXEL, colour, -1, cv2.LINE_AA, _SUBPIXEL)


@lru_cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"  # matplotlib brings them
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, size)
