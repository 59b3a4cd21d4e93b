"""Features that any scene of a batch has, read on the host, so that absent ones cost nothing."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.light.weather import Light
from lanebev.render.scene.objects.surroundings import NOTHING, SLOPE, STYLES, TREES, Surroundings
from lanebev.render.scene.road.layout import Layout
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.world import Scene

SHORTEST_SHADOW = 0.05  # m, of a wall on the ground
STEEPEST = 0.12  # sine of the lowest sun that casts shadows


def shadow_lengths(around: Surroundings, light: Light) -> Tensor:
    """Compute how far walls' shadows reach towards the road, (B, W) m; 0 or less if they do not."""
    slant = light.sun[:, 0] / light.sun[:, 1].clamp(min=STEEPEST)  # sideways per metre of height
    wall = torch.arange(around.walls.kind.shape[1], device=slant.device)
    side = (wall % 2) * 2 - 1
    kind = around.walls.kind
    casts = (kind != NOTHING) & (kind != SLOPE) & (light.direct > 0.02).any(1, keepdim=True)
    return around.walls.height * slant[:, None] * side * casts


class KindRows(NamedTuple):
    """Rows of a batch with what only some kinds of road have.

    Attributes:
        city: streets.
        works: road works.
        snow: snow.
        tunnel: tunnels.
        night: nights with lights.
        headlight: the camera's own headlights on other nights and at dusk.
        glass: faults of windscreen, lens and recorder.
    """

    city: list[int]
    works: list[int]
    snow: list[int]
    tunnel: list[int]
    night: list[int]
    headlight: list[int]
    glass: list[int]


class Features(NamedTuple):
    """Features of the scenes of a batch: true if at least one scene has it, or the rows that do.

    Attributes:
        sun: direct light that casts shadows.
        headlight: the camera's own headlights.
        wet: wet ground.
        cloud: clouds.
        bridge: a bridge.
        bloom: bright light that spills.
        crowns: trees that shade the road.
        deck: stretches of another material.
        middle_seam: seams inside lanes.
        joint: transverse joints.
        crack: cracks.
        skid: tyre skids.
        patch: patches.
        gutter: strips along the left and along the right edge.
        studs: studs.
        double: double stripes.
        ghost: old lines beside the new ones.
        symbols: arrows, words, diamonds.
        night: a night of the kinds of road.
        rows: on which rows there are which kinds.
        shading: on which rows each wall throws a shadow on the road.
        walls: (row, wall) of each wall that is there.
        looks: (kind, style) of each of these; trees come in several styles.
    """

    sun: bool
    headlight: bool
    wet: bool
    cloud: bool
    bridge: list[int]
    bloom: bool
    crowns: list[int]
    deck: bool
    middle_seam: bool
    joint: bool
    crack: bool
    skid: bool
    patch: list[int]
    gutter: tuple[list[int], list[int]]
    studs: bool
    double: bool
    ghost: bool
    symbols: bool
    night: bool
    rows: KindRows
    shading: list[list[int]]
    walls: list[list[int]]
    looks: list[list[int]]


def features_of(scene: Scene) -> Features:
    """Read what the scenes have; these should be on the host, or each answer waits for the device."""
    world = scene.world
    pavement: Pavement = world.pavement
    layout: Layout = world.layout

    def some(strength: Tensor) -> bool:
        return bool((strength != 0).any())

    around, kinds = world.surroundings, world.kinds
    there = around.walls.kind != NOTHING
    style = torch.where(around.walls.kind == TREES, (around.walls.seed * 97).long() % STYLES, 0)
    return Features(
        sun=bool((scene.light.direct > 0.02).any()),
        headlight=some(scene.light.headlight),
        wet=some(pavement.wet),
        cloud=some(world.surroundings.cloud),
        bridge=_rows(world.bridge.isfinite().any(1)),
        bloom=some(world.sensor.bloom),
        crowns=_rows(world.shade != 0),
        deck=some(pavement.deck_length),
        middle_seam=some(pavement.middle_seam),
        joint=some(pavement.joint),
        crack=some(pavement.crack),
        skid=some(pavement.skid),
        patch=_rows(pavement.patch != 0),
        gutter=(_rows(pavement.gutter_width[:, 0] != 0), _rows(pavement.gutter_width[:, 1] != 0)),
        studs=some(layout.stud_period),
        double=some(layout.separation),
        ghost=some(layout.ghost),
        symbols=some(layout.symbols.kind),
        night=some(world.lights.on),
        rows=KindRows(
            city=_rows(kinds.city),
            works=_rows(kinds.works),
            snow=_rows(kinds.snow),
            tunnel=_rows(world.tunnel.on > 0),
            night=_rows(world.lights.on > 0),
            headlight=_rows((scene.light.headlight > 0) & (world.lights.on == 0)),
            glass=_rows(kinds.camera),
        ),
        shading=[_rows(wall) for wall in (shadow_lengths(around, scene.light) > SHORTEST_SHADOW).unbind(1)],
        walls=there.nonzero().tolist(),
        looks=torch.stack([around.walls.kind, style], dim=-1)[there].tolist(),
    )


def _rows(mask: Tensor) -> list[int]:
    """Return the rows in which a mask (B,) holds."""
    return mask.nonzero()[:, 0].tolist()
