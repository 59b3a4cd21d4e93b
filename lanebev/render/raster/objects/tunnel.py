"""The inside of a tunnel: its light, its ceiling and the lamps on it."""

import torch
from torch import Tensor

from lanebev.render.raster.base.rays import View
from lanebev.render.scene.road.alignment import road_from_local
from lanebev.render.scene.world import Scene

_NO_CEILING = 900.0  # m; beyond, nothing of it is drawn


def add_ceiling(scene: Scene, view: View, radiance: Tensor, blocked: Tensor) -> Tensor:
    """Put the ceilings of tunnels in the place of the sky.

    Args:
        scene: B of them.
        view: the pixels' rays.
        radiance: (B, 3, H, W) linear.
        blocked: (B, H, W) m, Z of the nearest thing that is not the road.

    Returns:
        (B, 3, H, W).
    """
    tunnel, place, lens = scene.world.tunnel, scene.place, scene.lens
    rise = -view.ray_y
    gap = (tunnel.ceiling - lens.extrinsics.height).clamp(min=0.5)[:, None]
    z = gap / rise.clamp(min=1e-3)
    there = (rise > 1e-3) & (z < _NO_CEILING) & blocked.flatten(1).isinf() & (tunnel.on > 0)[:, None]
    z = z.clamp(max=_NO_CEILING)
    point = road_from_local(scene.alignment, view.ray_x * z, z)
    along = point.along + place.along[:, None]
    there = there & (along < tunnel.exit[:, None])
    across = point.across + place.across[:, None]
    per_pixel = z / lens.intrinsics[:, 0, 0, None]
    stretch = (z / gap).clamp(min=1.0)
    period = tunnel.lamp_period[:, None]
    apart = ((along / period) % 1.0 - 0.5).abs() * period
    lamp = _inside(apart, tunnel.lamp_size[:, :1], per_pixel * stretch)
    aside = (across[:, None] - tunnel.lamp_across[..., None]).abs().amin(1)
    lamp = lamp * _inside(aside, tunnel.lamp_size[:, 1:], per_pixel)
    glow = 0.5 + 0.9 / (1 + (aside / 1.2) ** 2 + (apart / 2.0) ** 2)
    surface = (tunnel.tone * tunnel.level)[..., None] * glow[:, None]
    shine = (tunnel.lamp[:, None] * tunnel.lamp_colour)[..., None]
    ceiling = surface + (shine - surface) * lamp[:, None]
    flat = torch.where(there[:, None], ceiling, radiance.flatten(2))
    return torch.unflatten(flat, 2, (radiance.shape[2], radiance.shape[3]))


def _inside(distance: Tensor, size: Tensor, footprint: Tensor) -> Tensor:
    """Compute the share of a pixel within half the size, m, of a middle, (B, N)."""
    wide = torch.maximum(footprint, 0.05 * size)
    return ((0.5 * size - distance) / wide + 0.5).clamp(0, 1) * (size / footprint).clamp(max=1)
