"""Boundaries of a road as a camera sees them, with which tests of several parts begin."""

import numpy as np
import torch

from lanebev import Extrinsics, image_from_road_points

PLACES = (-5.55, -1.85, 1.85, 5.55)
"""X of four boundaries, m."""


def boundary(camera, place, z, pose, curvature=0.0, vertical_curvature=None):
    """Undistorted pixels (P, 2) of a boundary at X = place + ½ curvature Z², at the distances z (P,)."""
    road = torch.stack([place + 0.5 * curvature * z**2, z], dim=-1)[None]
    return image_from_road_points(road, camera.intrinsics[None].double(), pose, vertical_curvature)[0][0]


def polylines(camera, pose, places=PLACES, count=40):
    """Pixels as taken, (P, 2), of each boundary of a straight road, from 5 to 40 m."""
    z = torch.linspace(1 / 5, 1 / 40, count, dtype=torch.float64) ** -1
    height, width = camera.image_size
    found = []
    for place in places:
        points = camera.distort_points(boundary(camera, place, z, Extrinsics.from_values(*pose)))
        inside = (points[:, 0] > 0) & (points[:, 0] < width - 1) & (points[:, 1] < height - 1)
        found.append(points[inside].numpy())
    return found


def on_rows(pixels, rows, width, noise=None):
    """x of a boundary on rows as TuSimple has it, -2 where it is not; ``noise`` draws errors of 1 px."""
    x, y = pixels.flip(0).numpy().T
    found = np.interp(rows, y, x, left=-2, right=-2)
    if noise is not None:
        found[found > 0] += noise.normal(0, 1, (found > 0).sum())
    return [round(value, 2) if 0 <= value < width else -2 for value in found]
