"""The lane boundaries of one frame as curves on the calibrated road, on rows of the image."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.estimation.joint.frame.boundary_curves import boundary_polylines, fit_boundaries
from lanebev.observation.polylines import BoundaryRows, image_rows
from lanebev.observation.segments import LaneSegments
from lanebev.types import NUM_BOUNDARIES, Calibration, Status

_LEAST_SUPPORT = 1.0  # sum of segments' weights that a boundary needs to be drawn
_LEAST_REACH = 60.0  # m ahead that a boundary is drawn at least: all lead to one horizon
_POINTS = 96  # number of points of a curve


def lane_curves(
    segments: LaneSegments, calibration: Calibration, camera: Camera, vertical_curvature: Tensor | None = None
) -> BoundaryRows:
    """Fit a curve to every boundary, with the calibrated pose and one curvature for all.

    A boundary that is seen in pieces is drawn as one, and what fits no road is left out.

    Args:
        segments: segments of batch size 1, in undistorted pixels.
        calibration: calibration of batch size 1.
        camera: the lens.
        vertical_curvature: (1,) 1/m of the road, or None for a plane.

    Returns:
        (L, R) px of the image as taken; none of them where the pose is not known.
    """
    rows = image_rows(camera.image_size[0])
    if int(calibration.status[0]) not in (Status.TRACKING, Status.COASTING):
        return BoundaryRows(rows, np.full((NUM_BOUNDARIES, len(rows)), np.nan))
    intrinsics = camera.intrinsics[None].to(segments.endpoints)
    pose = calibration.extrinsics
    curves = fit_boundaries(
        segments, intrinsics, pose, least_support=_LEAST_SUPPORT, vertical_curvature=vertical_curvature
    )
    far = curves.extent[..., 1].clamp(min=_LEAST_REACH)
    curves = curves._replace(extent=torch.stack([torch.ones_like(far), far], dim=-1))
    lines, shown = boundary_polylines(curves, intrinsics, pose, _POINTS, vertical_curvature)
    return BoundaryRows(rows, curves_on_rows(lines[0], shown[0], camera))


def curves_on_rows(lines: Tensor, shown: Tensor, camera: Camera) -> NDArray[np.float64]:
    """Interpolate one frame's curves on the rows of ``lanes.json``.

    Args:
        lines: (L, P, 2) undistorted px.
        shown: (L, P) bool.
        camera: the lens.

    Returns:
        (L, R) px of the image as taken, NaN where there is no curve.
    """
    rows = image_rows(camera.image_size[0])
    x = np.full((len(lines), len(rows)), np.nan)
    for own, line, there in zip(x, lines, shown, strict=True):
        points = camera.distort_points(line[there]).double().numpy()
        if len(points) > 1:
            order = np.argsort(points[:, 1])
            across = np.interp(rows, points[order, 1], points[order, 0], np.nan, np.nan)
            own[:] = np.where((across >= 0) & (across <= camera.image_size[1] - 1), across, np.nan)
    return x
