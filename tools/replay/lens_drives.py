"""Drives with known truth seen through a real lens: vertices in pixels as taken."""

import torch
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.geometry.rotation import road_from_cam
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.testing.moments import Moment, resample, road_curves


def vertices_through_lens(
    drive: list[Moment], camera: Camera, sigma: float, per_boundary: int, seed: int
) -> BoundaryVertices:
    """Draw vertices evenly along every boundary as the lens images it, with Gaussian noise on each.

    Args:
        drive: T frames.
        camera: the lens, in double precision.
        sigma: px of the image as taken.
        per_boundary: V vertices.
        seed: seed of the noise.

    Returns:
        (T, 6, V), weight 0 where a boundary is not in the image.
    """
    generator = torch.Generator().manual_seed(seed)
    points, seen = zip(*(_exact(moment, camera, per_boundary) for moment in drive), strict=True)
    exact, weight = torch.stack(points), torch.stack(seen)
    noise = torch.randn(exact.shape, generator=generator, dtype=torch.float64)
    boundary = torch.arange(weight.shape[1]).expand(len(drive), -1)
    return BoundaryVertices(exact + sigma * noise, weight, torch.full_like(weight, sigma), boundary)


def _exact(moment: Moment, camera: Camera, count: int) -> tuple[Tensor, Tensor]:
    """Return points evenly spaced in pixels as taken, (6, V, 2), and weights (6, V)."""
    road = road_curves(moment)
    pitch, yaw, roll, height = torch.tensor(moment.pose, dtype=torch.float64)
    x, z = road.unbind(-1)
    directions = torch.stack([x, height.expand_as(x), z], dim=-1) @ road_from_cam(pitch, yaw, roll)
    points, weight = torch.zeros(6, count, 2, dtype=torch.float64), torch.zeros(6, count, dtype=torch.float64)
    pixels, inside = camera.project(directions.flatten(0, 1))
    pixels, inside = pixels.unflatten(0, (6, -1)), inside.unflatten(0, (6, -1))
    for k in moment.visible:
        line = pixels[k][inside[k]]
        if len(line) < 2:
            continue
        arc = torch.cat([torch.zeros(1, dtype=torch.float64), line.diff(dim=0).norm(dim=-1).cumsum(0)])
        at = torch.linspace(0, float(arc[-1]), count, dtype=torch.float64)
        points[k] = resample(arc, line, at)
        weight[k] = 1.0
    return points, weight
