"""The points of the ground that pixels show, and the area that each covers."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.road.alignment import Alignment, road_from_local
from lanebev.render.scene.world import Place


class Ground(NamedTuple):
    """Ground under pixels, each (B, N).

    Attributes:
        z: m, ahead of the camera's foot.
        along: m in the world.
        across: m in the layout's frame.
        reach_along: m per pixel.
        reach_across: m per pixel.
    """

    z: Tensor
    along: Tensor
    across: Tensor
    reach_along: Tensor
    reach_across: Tensor


def ground_under(
    place: Place, alignment: Alignment, ray_x: Tensor, ray_y: Tensor, z: Tensor, slope: Tensor, steps: Tensor
) -> Ground:
    """Compute road coordinates and, from the rays' change per pixel, the pixels' footprints.

    Args:
        place: of the cameras.
        alignment: seen from there.
        ray_x: (B, N) right per metre forward.
        ray_y: (B, N) down per metre forward.
        z: (B, N) m, where the rays meet the ground.
        slope: (B, N) dE/dZ of the ground there.
        steps: (4, B, N) change of the rays per pixel, see :class:`~lanebev.render.raster.base.rays.View`.
    """
    point = road_from_local(alignment, ray_x * z, z)
    reach = z / (ray_y + slope)  # m that the hit moves nearer per unit of ray_y

    def footprint(step_x: Tensor, step_y: Tensor) -> tuple[Tensor, Tensor]:
        dz = -reach * step_y
        dx = z * step_x + ray_x * dz
        return point.sin * dx + point.cos * dz, point.cos * dx - point.sin * dz

    along_column, across_column = footprint(steps[0], steps[1])
    along_row, across_row = footprint(steps[2], steps[3])
    return Ground(
        z=z,
        along=point.along + place.along[:, None],
        across=point.across + place.across[:, None],
        reach_along=_length(along_column, along_row).clamp(min=1e-3),
        reach_across=_length(across_column, across_row).clamp(min=1e-4),
    )


def _length(a: Tensor, b: Tensor) -> Tensor:
    """Compute the hypotenuse; ``torch.hypot`` takes twice as long on processors."""
    return torch.addcmul(a * a, b, b).sqrt_()
