"""Beside a street: kerbs, grass, cycle paths, pavements, and the mouths of junctions."""

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import make_blocks
from lanebev.render.raster.base.coverage import band, beyond, dash_coverage, stripe_coverage
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import CLOUD, hash01, sample_grain, sample_noise, smoothstep
from lanebev.render.raster.base.select import put, take, take_channels
from lanebev.render.rows import take_rows
from lanebev.render.scene.places.street import GREEN, KERB, PATH, WALK, Street
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.world import Scene


def add_roadside(scene: Scene, row: Tensor, ground: Ground, paved: Tensor, albedo: Tensor) -> None:
    """Put what is beside streets over a plain verge; changes their linear reflectance.

    Args:
        scene: B of them.
        row: (T,) int64, not decreasing, the scene of each line of points.
        ground: (T, N) points.
        paved: (T, N) share of the pixel on the carriageway.
        albedo: (3, T·N) linear reflectance of the plain road and its verge.
    """
    beside = make_blocks(paved < 1, row=row, num_rows=len(scene.place.along))
    own = beside.row
    colours, share = roadside(
        take_rows(scene.world.street, own),
        take_rows(scene.world.pavement, own),
        Ground(*(take(t, beside.place) for t in ground)),
        scene.place.across[own],
        scene.lens.extrinsics.height[own],
    )
    under = take_channels(albedo, beside.place)
    share = share * (1 - take(paved, beside.place))
    put(albedo, beside.place, under + (colours.transpose(0, 1) - under) * share)


def roadside(
    street: Street, pavement: Pavement, ground: Ground, eye_across: Tensor, eye_height: Tensor
) -> tuple[Tensor, Tensor]:
    """Add kerbs, grass, cycle paths and pavements beside the carriageway.

    A point at height k above the road is seen where the ray through it meets the road, farther from the
    camera by the factor H / (H - k): so the kerb's face and all beyond it are drawn on the road's plane.

    Args:
        street: what there is.
        pavement: its edges are the kerbs' feet; its surface covers junctions.
        ground: (B, N) points on the road's plane.
        eye_across: (B,) m, the camera's place.
        eye_height: (B,) m, the camera's height.

    Returns:
        (B, 3, N) linear reflectance and (B, N) coverage.
    """
    _, along, across, reach_along, reach_across = ground
    colour, alpha = torch.zeros_like(across)[:, None].repeat(1, 3, 1), torch.zeros_like(across)
    grain = sample_grain(along / 7.0, across / 7.0) / (1 + reach_along / 0.06)
    tufts = sample_grain(along / 19.0, across / 17.0) / (1 + reach_along / 0.15)
    growth = sample_noise(CLOUD, along / 37.0, across / 29.0)
    for side, sign, edge in ((0, -1.0, pavement.left), (1, 1.0, pavement.right)):
        foot = ((edge - eye_across) * sign).clamp(min=0.2)[:, None]
        raised = street.kerb_height[:, side].minimum(0.5 * eye_height)
        zoom = (eye_height / (eye_height - raised))[:, None]
        away = (across - eye_across[:, None]) * sign
        inner = away / zoom - foot  # m beyond the kerb's edge, on the raised plane
        fine_across, fine_along = reach_across / zoom, reach_along / zoom
        ends = street.strips[:, side].cumsum(1)  # (B, 4)

        tone = street.colours[:, side, KERB, :, None] * (1 + 0.1 * grain)[:, None]
        tone = _blocks(street, along, reach_along, tone)
        joints = dash_coverage(along, 0.02, torch.ones_like(along), fine_along)
        tone = tone * (1 - 0.45 * joints)[:, None]
        for strip in range(KERB + 1, WALK + 1):
            step = beyond(inner, ends[:, strip - 1, None], fine_across)[:, None]
            shade = 0.3 * tufts + 0.2 * growth if strip == GREEN else 0.12 * grain + 0.05 * growth
            next_tone = street.colours[:, side, strip, :, None] * (1 + shade)[:, None]
            if strip == WALK:
                next_tone = next_tone * _slabs(street, along, inner, fine_along, fine_across)[:, None]
            tone = tone + (next_tone - tone) * step
        line = stripe_coverage(inner - ends[:, PATH, None], 0.1, fine_across)
        line = line * (street.path_line[:, side] * (street.strips[:, side, PATH] > 0))[:, None]
        tone = tone + (street.paint[..., None] - tone) * line[:, None]

        face = band(away, foot, foot * zoom, reach_across) * (1 - beyond(inner, 0 * foot, fine_across))
        tone = tone * (1 + face * (street.kerb_shade[:, side, None] - 1))[:, None]
        weeds = smoothstep(0.5, 1.1, growth + 0.5 * tufts - 3.0 * (inner - 0.05).abs())
        weeds = (weeds * street.weeds[:, None])[:, None]
        tone = tone + (street.colours[:, side, GREEN, :, None] * 0.8 - tone) * weeds
        there = beyond(away, foot, reach_across) * (1 - beyond(inner, ends[:, WALK, None], fine_across))
        there = there * street.kerbed[:, None] * (ends[:, WALK, None] > 0)
        colour = colour + (tone - colour) * (there > alpha)[:, None]
        alpha = torch.maximum(alpha, there)
    crossroad = junction_coverage(street, along, reach_along)
    asphalt = pavement.base[..., None] * (1 + 0.12 * grain)[:, None]
    colour = colour + (asphalt - colour) * crossroad[:, None]
    return colour.clamp(0.005, 0.9), torch.maximum(alpha, crossroad)


def _blocks(street: Street, along: Tensor, reach: Tensor, tone: Tensor) -> Tensor:
    """Return the factor of kerbs painted alternately white and dark."""
    length = street.kerb_blocks[:, None].clamp(min=0.1)
    white = dash_coverage(along, length.expand_as(along), 2 * length.expand_as(along), reach)
    painted = 0.04 + 0.6 * white[:, None] * street.paint[..., None]
    return torch.where((street.kerb_blocks > 0)[:, None, None], painted, tone)


def _slabs(street: Street, along: Tensor, inner: Tensor, reach_along: Tensor, reach_across: Tensor) -> Tensor:
    """Compute the factor of slabs' joints and of their different tones, (B, N)."""
    size = street.slab.clamp(min=0.2)[:, None].expand_as(along)
    joint = torch.maximum(
        dash_coverage(along, 0.012, size, reach_along), dash_coverage(inner, 0.012, size, reach_across)
    )
    tone = 0.12 * (hash01((along / size).floor(), (inner / size).floor(), 4.0) - 0.5)
    factor = 1 - 0.5 * joint + tone * (size / (size + reach_along))
    return torch.where((street.slab > 0)[:, None], factor, 1.0)


def junction_coverage(street: Street, along: Tensor, reach: Tensor) -> Tensor:
    """Compute the share of a pixel on a junction, (B, N)."""
    length, period = street.junction_length[:, None], street.junction_period[:, None]
    return dash_coverage(along + street.phase[:, None], length, period, reach)
