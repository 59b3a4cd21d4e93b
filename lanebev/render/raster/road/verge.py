"""Reflectance of the ground beside the road."""

from torch import Tensor

from lanebev.render.raster.base.colour import colour
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import sample_grain
from lanebev.render.raster.base.select import choose, remainder
from lanebev.render.scene.objects.surroundings import Surroundings


def verge_albedo(surroundings: Surroundings, ground: Ground, patches: Tensor) -> Tensor:
    """Compute the linear reflectance of the ground beside the pavement, (B, 3, N).

    Args:
        surroundings: surroundings of the road.
        ground: the points.
        patches: (B, N) slow noise.
    """
    along, across = ground.along, ground.across
    right = (across > 0)[:, None]
    grass = choose(right, surroundings.verge[:, 1, :, None], surroundings.verge[:, 0, :, None])
    tufts = sample_grain(along / 19.0, across / 17.0) / (1 + ground.reach_along / 0.15)
    shade = (1 + 0.3 * tufts + 0.22 * patches).clamp(0.25, 2.0)
    dry = colour(grass, 1.25, 1.05, 0.8)
    grass = grass * shade[:, None] * choose((patches > 0.7)[:, None], dry, 1.0)
    inside = surroundings.opposite.clamp(min=-1e6)[:, None] - across  # m into the opposite carriageway
    other = (inside > 0) & (inside < 13.5)
    line = ((inside - 1.0).abs() < 0.1) | ((inside - 12.2).abs() < 0.1)
    line = line | (((inside - 4.7).abs() < 0.07) | ((inside - 8.4).abs() < 0.07)) & (
        remainder(along, 12.0) < 3.0
    )
    grey = surroundings.opposite_colour[..., None] * (1 + 0.1 * tufts + 0.06 * patches)[:, None]
    grey = choose(line[:, None], 0.5, grey)
    return choose(other[:, None], grey, grass)
