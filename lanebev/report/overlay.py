"""The overlay: a frame with its detections and estimate, and its bird's-eye views."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.geometry.road import horizon_line, road_from_image_points
from lanebev.geometry.vanishing_point import vanishing_point
from lanebev.observation.segments import LaneSegments
from lanebev.report.lettering import Colour, Picture, text_width, write_text
from lanebev.report.measure import select_inliers
from lanebev.types import Calibration, Extrinsics, Status
from lanebev.view.grid import BEVGrid

BOUNDARY_COLOURS = (
    (186, 140, 255), (80, 170, 255), (0, 214, 160), (255, 190, 0), (255, 112, 96), (255, 150, 214),
)  # fmt: skip
"""RGB of boundaries 0..5, distinguishable also without red and green, on asphalt and on paper."""

PANEL_HEIGHT = 720
_WIDEST = 4  # times its height, of a picture that fills it
_HORIZON, _INK, _QUIET, _BACKGROUND = (255, 255, 255), (235, 238, 242), (150, 158, 168), (18, 20, 24)
_STATUS_COLOURS = {
    Status.TRACKING: (0, 214, 160), Status.COASTING: (255, 190, 0), Status.LOST: (255, 92, 80),
}  # fmt: skip
_SUBPIXEL = 4  # bits of cv2's fixed-point coordinates
_HEAD, _LEFT = 44, 34  # px of a panel above its view, and left of it


@dataclass(frozen=True)
class Panel:
    """A bird's-eye view, the words above it, and pose and vertical curvature it was made with, (1,) each."""

    title: str
    bev: Picture
    extrinsics: Extrinsics
    vertical_curvature: Tensor | None = None


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
        segments: segments of batch size 1, undistorted.
        calibration: calibration of batch size 1, on the CPU.
        headline: what frame this is.
        views: e.g. with a fixed and with the estimated pose. Outliers are drawn on the input only.
        grid: grid of the views.
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
    colour = _STATUS_COLOURS.get(status, _QUIET)
    _draw_banner(shown, headline, status.name, colour, _numbers(calibration))
    if reasons:
        _draw_note(shown, reasons)
    used = select_inliers(segments, calibration.inliers)
    return [shown, *(_bev_panel(view, grid, camera, used) for view in views)]


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
    return f"{angles}   height {height:.3f} m ±{2 * std[3]:.3f}   (±2σ)"


def _draw_boundaries(
    shown: Picture, camera: Camera, segments: LaneSegments, inliers: Tensor, scale: float
) -> None:
    """Draw vertices as dots, each boundary's as one line through them; outliers are grey."""
    ends = _to_image(camera, segments.endpoints[0].flatten(0, 1)).reshape(-1, 2, 2) * scale
    there = segments.weight[0] > 0
    used = there & (inliers[0] > 0.5)
    _dots(shown, _fixed(ends[there & ~used].flatten(0, 1)), 2, _QUIET)
    lines = list(_polylines(ends, segments.boundary[0], used))
    soft = shown.copy()
    for colour, points in lines:
        cv2.polylines(soft, [points], False, colour, 7, cv2.LINE_AA, _SUBPIXEL)
    cv2.addWeighted(soft, 0.45, shown, 0.55, 0, dst=shown)
    for colour, points in lines:
        cv2.polylines(shown, [points], False, colour, 1, cv2.LINE_AA, _SUBPIXEL)
        _dots(shown, points, 3, colour)


def _polylines(
    ends: Tensor, boundary: Tensor, kept: Tensor
) -> Iterator[tuple[tuple[int, int, int], NDArray[np.int32]]]:
    """Return colour and vertices (P, 2), top to bottom, of each boundary; ends (N, 2, 2), kept (N,)."""
    of = boundary[kept].numpy()
    points = _fixed(ends[kept].flatten(0, 1)).reshape(-1, 2, 2)
    for index in np.unique(of).tolist():
        own = points[of == index].reshape(-1, 2)
        yield BOUNDARY_COLOURS[index % len(BOUNDARY_COLOURS)], own[own[:, 1].argsort(kind="stable")]


def _draw_horizon(shown: Picture, camera: Camera, extrinsics: Extrinsics, scale: float) -> None:
    a, b, c = horizon_line(extrinsics, camera.intrinsics[None].to(extrinsics.pitch))[0].tolist()
    if abs(b) < 1e-6:
        return
    x = torch.linspace(0, camera.image_size[1], 65, dtype=torch.float64)[:-1]
    points = _to_image(camera, torch.stack([x, -(a * x + c) / b], dim=-1)) * scale
    dashes = points.reshape(-1, 2, 2)
    dashes = dashes[dashes.isfinite().all(-1).all(-1)]
    ends = _fixed(dashes.flatten(0, 1)).reshape(-1, 2, 2)
    cv2.polylines(shown, list(ends), False, _HORIZON, 1, cv2.LINE_AA, _SUBPIXEL)


def _draw_vanishing_point(shown: Picture, camera: Camera, extrinsics: Extrinsics, scale: float) -> None:
    lens = (camera.intrinsics[None], camera.distortion[None], camera.model)
    point = vanishing_point(extrinsics.pitch, extrinsics.yaw, *lens) * scale
    if torch.isfinite(point).all():
        place = _fixed(point)
        centre = tuple(place[0].tolist())
        cv2.circle(shown, centre, 9 << _SUBPIXEL, (0, 0, 0), 4, cv2.LINE_AA, _SUBPIXEL)
        cv2.circle(shown, centre, 9 << _SUBPIXEL, _HORIZON, 2, cv2.LINE_AA, _SUBPIXEL)
        _dots(shown, place, 2, _HORIZON)


def _draw_banner(shown: Picture, headline: str, status: str, colour: Colour, numbers: str) -> None:
    """Draw frame, status and numbers on a dark strip at the top."""
    _darken(shown[:44])
    write_text(shown, (12, 12), headline, _INK, 18)
    x = 12 + text_width(headline, 18) + 24
    write_text(shown, (x, 12), status, colour, 18, bold=True)
    room = shown.shape[1] - 12
    size = next((s for s in (17, 15, 13) if x + 150 + text_width(numbers, s) < room), 0)
    if size:
        write_text(shown, (room, 13), numbers, _INK, size, anchor="ra")
    else:  # a narrow picture: a second strip below
        _darken(shown[44:76])
        write_text(shown, (12, 50), numbers, _INK, 15)


def _draw_note(shown: Picture, text: str) -> None:
    """Draw a line of text on a dark strip at the bottom."""
    _darken(shown[-34:])
    write_text(shown, (12, PANEL_HEIGHT - 27), text, _INK, 16)


def _darken(strip: Picture) -> None:
    strip[:] = cv2.addWeighted(strip, 0.3, np.full_like(strip, _BACKGROUND), 0.7, 0)


def _bev_panel(view: Panel, grid: BEVGrid, camera: Camera, segments: LaneSegments) -> Picture:
    """Draw the view below its title, with thin boundaries and a scale of metres ahead on its left."""
    height = PANEL_HEIGHT - _HEAD
    width = round(view.bev.shape[1] * height / view.bev.shape[0])
    panel = _empty_panel(view.title, width, grid.z).copy()
    method = cv2.INTER_AREA if height < 0.5 * view.bev.shape[0] else cv2.INTER_LINEAR
    bev = cv2.resize(view.bev, (width, height), interpolation=method)
    _draw_bev_boundaries(bev, view, grid, camera, segments)
    panel[_HEAD:, _LEFT:] = bev
    return panel


@lru_cache(maxsize=8)
def _empty_panel(title: str, width: int, z: tuple[float, float]) -> Picture:
    """Draw a panel without its view, of this width; z: near and far, m."""
    height = PANEL_HEIGHT - _HEAD
    panel = np.full((PANEL_HEIGHT, _LEFT + width, 3), _BACKGROUND, np.uint8)
    write_text(panel, (_LEFT, 12), title, _INK, 18)
    for metres in range(10 * math.ceil(z[0] / 10), math.floor(z[1]) + 1, 10):
        y = _HEAD + (z[1] - metres) / (z[1] - z[0]) * height
        panel[min(round(y), PANEL_HEIGHT - 1), _LEFT - 6 : _LEFT] = _QUIET
        write_text(panel, (_LEFT - 8, max(y, _HEAD + 8)), str(metres), _QUIET, 13, anchor="rm")
    write_text(panel, (_LEFT - 8, PANEL_HEIGHT - 10), "m", _QUIET, 13, anchor="rm")
    return panel


def _draw_bev_boundaries(
    bev: Picture, view: Panel, grid: BEVGrid, camera: Camera, segments: LaneSegments
) -> None:
    intrinsics = camera.intrinsics[None].to(segments.endpoints)
    points, valid = road_from_image_points(
        segments.endpoints.flatten(1, 2), intrinsics, view.extrinsics, view.vertical_curvature
    )
    ends = grid.bev_from_road_points(points[0]).reshape(-1, 2, 2) * (bev.shape[0] / grid.shape[0])
    kept = (segments.weight[0] > 0) & valid[0].reshape(-1, 2).all(-1)
    soft = bev.copy()
    for colour, line in _polylines(ends, segments.boundary[0], kept):
        cv2.polylines(soft, [line], False, colour, 1, cv2.LINE_AA, _SUBPIXEL)
    cv2.addWeighted(soft, 0.7, bev, 0.3, 0, dst=bev)


def _to_image(camera: Camera, points: Tensor) -> Tensor:
    """Convert undistorted pixels (N, 2) to pixels as taken (N, 2)."""
    return camera.distort_points(points.to(camera.intrinsics))


def _fixed(points: Tensor) -> NDArray[np.int32]:
    """Convert pixels, centres at integers, to cv2's fixed point."""
    bounded = points.nan_to_num(-1e4).clamp(-3e4, 3e4)
    return np.asarray((bounded * (1 << _SUBPIXEL)).round().to(torch.int32).numpy())


def _dots(shown: Picture, points: NDArray[np.int32], radius: int, colour: Colour) -> None:
    """Draw filled circles at (P, 2) points of :func:`_fixed`."""
    for x, y in points.tolist():
        cv2.circle(shown, (x, y), radius << _SUBPIXEL, colour, -1, cv2.LINE_AA, _SUBPIXEL)
