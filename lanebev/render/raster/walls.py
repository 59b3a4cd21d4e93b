"""Walls beside the road in the image, from the outside inwards."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.render.raster.houses import lit_windows
from lanebev.render.raster.photometry import headlight_irradiance
from lanebev.render.raster.solids import Light
from lanebev.render.scene.alignment import Alignment, elevation_at, wall_hit
from lanebev.render.scene.surroundings import HOUSES, NOTHING, NUM_WALLS, SLOPE, TREES, wall_texture
from lanebev.render.scene.world import Place, World


def add_walls(
    world: World,
    place: Place,
    alignment: Alignment,
    light: Light,
    camera_height: Tensor,
    swing: Tensor,
    drop: Tensor,
    across: Tensor,
    radiance: Tensor,
    depth: Tensor,
    blocked: Tensor,
    steps: Tensor,
) -> None:
    """Paint the walls beside the road, outside in; changes radiance, depth and blocked."""
    surroundings = world.surroundings
    pixel = steps[:, 3].flatten(1).abs()  # rise per pixel down, at one metre
    away = torch.maximum(across - world.pavement.right, world.pavement.left - across) > 0
    candidates = (away | depth.isinf())[0].nonzero()[:, 0]
    sky, across, outward, climb = (t[:, candidates] for t in (depth.isinf(), across, swing, -drop))
    sharpest = alignment.curvature.abs().amax(1)[:, None]
    for wall in range(NUM_WALLS):
        kind = int(surroundings.wall_kind[0, wall])
        if kind == NOTHING:
            continue
        place_across = surroundings.wall_across[:, wall] - place.across
        side = place_across.sign()
        tall = surroundings.wall_height[:, wall] * 1.5
        aside = place_across.abs().clamp(min=0.5)[:, None]
        beyond = (across - surroundings.wall_across[:, wall, None]) * side[:, None] > 0
        bent = (sharpest / aside).sqrt()  # on a bend the road turns towards its wall
        steepest = 1.3 / aside * (outward * side[:, None]).clamp(min=0) + (bent + 0.004)
        low = climb < (tall - camera_height).clamp(min=0)[:, None] * steepest
        part = candidates[torch.where(sky, low, beyond)[0]]
        if not len(part):
            continue
        z, arc = wall_hit(alignment, place_across, swing[:, part])
        finite = z < 900.0
        z = z.where(finite, 1.0)
        up = camera_height[:, None] - drop[:, part] * z - elevation_at(alignment, z)
        keep = (finite & (up > -0.3) & (up < tall[:, None]) & (z < depth[:, part] + 0.5))[0].nonzero()[:, 0]
        if not len(keep):
            continue
        part, z, arc, up = part[keep], z[:, keep], arc[:, keep], up[:, keep]
        along = arc + place.along[:, None]
        albedo, alpha = wall_texture(surroundings, wall, along, up, (pixel[:, part] * z).clamp(min=1e-3))
        faces = (-side * light.sun[:, 0]).clamp(min=0)[:, None]
        if kind >= TREES and kind not in (SLOPE, HOUSES):
            away = (-light.sun[:, 2, None]).clamp(min=0)  # sun from behind lights what the camera sees
            faces = 0.10 + 0.3 * light.sun[:, 1, None] * away + 0.35 * away + 0.35 * faces
        lit = light.direct[..., None] * faces[:, None] + light.ambient[..., None] * (
            0.35 if kind >= TREES and kind not in (SLOPE, HOUSES) else 0.62
        )
        if bool(light.headlight > 0):
            lit = (
                lit + 0.6 * (headlight_irradiance(swing[:, part] * z, z) * light.headlight[:, None])[:, None]
            )
        lit = albedo * lit
        if kind == HOUSES and bool(world.lights.on > 0):
            lit = lit + lit_windows(surroundings, wall, along, up, (pixel[:, part] * z).clamp(min=1e-3))
        clear = torch.exp(-z / world.weather.visibility[:, None])[:, None]
        lit = surroundings.skyline[..., None] * (1 - clear) + lit * clear
        radiance[:, :, part] += (lit - radiance[:, :, part]) * alpha[:, None]
        solid = alpha > 0.5
        depth[:, part] = torch.where(solid, torch.minimum(depth[:, part], z), depth[:, part])
        blocked[:, part] = torch.where(solid, torch.minimum(blocked[:, part], z), blocked[:, part])
