"""The truth of a rendered image is exact: measured on what is painted, not on what was meant."""

import math

import pytest
import torch

from lanebev.render.course import sample_alignment
from lanebev.render.raster.base.features import features_of
from lanebev.render.raster.base.select import take_channels
from lanebev.render.raster.paint import paint_view, prepare
from lanebev.render.scene.camera.lens import Lens, sample_distortion, sample_extrinsics, sample_intrinsics
from lanebev.render.scene.places.street import no_street
from lanebev.render.scene.sampler import BatchSampler
from lanebev.render.scene.world import World, sample_world, scene_at
from lanebev.render.truth import boundary_points, project
from lanebev.render.views import sample_place

SIZE = (360, 640)


def bare_world(sampler: BatchSampler, kind: str = "highway") -> tuple[World, torch.Tensor]:
    """Solid white single stripes on an even black road, nothing else, in even light."""
    world, ego_lane = sample_world(sampler, kind)
    layout, pavement = world.layout, world.pavement
    zero, solid = torch.zeros_like(layout.opacity), torch.full_like(layout.dash, 10.0)
    layout = layout._replace(
        marked=layout.exists,
        separation=zero,
        dash=solid,
        opacity=zero + 1,
        wear=zero - 2,
        stud_period=zero,
        gaps=layout.gaps._replace(length=zero),
        ghost=zero,
        colour=torch.full_like(layout.colour, 0.8),
        stripe_width=zero + 0.04,  # wide ones look lopsided: their near half is larger
    )
    none = torch.zeros_like(pavement.left)
    flat = {
        name: none for name in ("grain", "mottle", "streak", "tracks", "oil", "middle_seam", "joint", "crack")
    }
    flat |= {name: none for name in ("tar", "patch", "skid", "wet", "deck_length")}
    dark = torch.full_like(pavement.base, 0.02)
    pavement = pavement._replace(
        **flat,
        left=none - 50,
        right=none + 80,
        base=dark,
        shoulder=dark,
        seam=torch.zeros_like(pavement.seam),
        gutter_width=torch.zeros_like(pavement.gutter_width),
        lane_tone=torch.ones_like(pavement.lane_tone),
    )
    walls = world.surroundings.walls
    around = world.surroundings._replace(walls=walls._replace(kind=torch.zeros_like(walls.kind)))
    traffic = world.traffic._replace(valid=torch.zeros_like(world.traffic.valid))
    weather = world.weather._replace(
        kind=torch.ones_like(world.weather.kind), grey=none + 1, visibility=none + 1e7, wet=none
    )
    bridge = torch.full_like(world.bridge, math.inf)
    world = world._replace(
        works=world.works._replace(strength=0 * world.works.strength, scar=0 * world.works.scar),
        layout=layout,
        pavement=pavement,
        surroundings=around,
        traffic=traffic,
        weather=weather,
        bridge=bridge,
    )
    sampler.uniform(0, 1)  # for nothing: what is drawn after it stays as it was
    return world._replace(shade=none, street=no_street(world.street)), ego_lane


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "seed", "kind"),
    [
        ("pinhole", 0, "highway"),
        ("pinhole", 1, "highway"),
        ("fisheye", 2, "highway"),
        ("pinhole", 3, "city"),
        ("pinhole", 4, "works"),
    ],
)
def test_points_lie_on_the_centre_of_the_painted_stripe(model: str, seed: int, kind: str) -> None:
    """The stripe's centroid across the boundary, measured in the radiance, is the point, to 0.05 px."""
    batch = 4
    sampler = BatchSampler(batch, torch.Generator().manual_seed(seed))
    world, ego_lane = bare_world(sampler, kind)
    world, place = sample_place(sampler, world, ego_lane)
    alignment = sample_alignment(sampler)
    intrinsics = sample_intrinsics(sampler, SIZE)
    lens = Lens(
        intrinsics, sample_distortion(sampler, intrinsics, SIZE, model), model, sample_extrinsics(sampler)
    )
    scene = scene_at(world, place, alignment, lens)
    points, marked, hidden = boundary_points(world.layout, place, alignment, lens, torch.full((batch,), 3.0))
    _, taken, inside = project(points.flatten(1, 2), lens, SIZE)
    shape = marked.shape
    taken, usable = taken.unflatten(1, shape[1:]), inside.reshape(shape) & (marked > 0) & ~hidden
    usable &= points[..., 2] < 80.0  # beyond, a pixel is longer than what the chord of three points follows

    painted = paint_view(scene, prepare(scene, SIZE), SIZE, features_of(scene))
    errors = []
    for b in range(batch):
        errors += _centroid_errors(painted.radiance[b, 1], taken[b], usable[b])
    assert len(errors) > 150
    worst = torch.tensor(errors).abs()
    assert worst.median() < 0.01
    assert worst.max() < 0.05


def _centroid_errors(image: torch.Tensor, points: torch.Tensor, usable: torch.Tensor) -> list[float]:
    """Signed centroid offsets, px, by row where a stripe is steep and alone in its row, else by column."""
    errors = []
    for line, good in zip(points, usable, strict=True):
        direction = line[2:] - line[:-2]
        for i in range(1, len(line) - 1):
            if not bool(good[i - 1 : i + 2].all()):
                continue
            dx, dy = (float(v) for v in direction[i - 1])
            steep = abs(dy) > abs(dx)
            picture, point = (image, line[i]) if steep else (image.T, line[i].flip(0))
            slope = dx / dy if steep else dy / dx
            row = round(float(point[1]))
            expected = float(point[0]) + slope * (row - float(point[1]))
            curve = line[i + 1] - 2 * line[i] + line[i - 1]
            if float(curve.norm()) > 1.0 or abs(row - float(point[1])) * float(curve.norm()) > 0.1:
                continue  # the chord is no longer the curve between two points
            if not 4 <= row < picture.shape[0] - 4:
                continue
            measured = _centroid(picture[row].double(), expected)
            if measured is None:
                continue
            across = math.hypot(1.0, slope)
            errors.append((measured - expected) / across)
    return errors


def _centroid(strip: torch.Tensor, expected: float) -> float | None:
    """Centroid of the bright run about ``expected``, less its ground; None where the ground is not dark."""
    first = last = round(expected)
    if not 3 <= first < len(strip) - 3:
        return None
    ground, peak = strip[max(0, first - 40) : first + 41].median(), strip[first - 2 : first + 3].max()
    dark = float(ground + 0.012 * (peak - ground))
    top = first - 2 + int(strip[first - 2 : first + 3].argmax())
    first = last = top  # down both sides, to the ground or to where it rises again
    while first > 0 and strip[first] > dark and strip[first - 1] < strip[first]:
        first -= 1
    while last < len(strip) - 1 and strip[last] > dark and strip[last + 1] < strip[last]:
        last += 1
    level = max(float(strip[first]), float(strip[last]))
    if first < 1 or last > len(strip) - 2 or last - first < 2 or level > 0.1 * float(peak):
        return None
    run = strip[first : last + 1]
    top, step = int(run.argmax()), run.diff()
    if bool((step[:top] < -0.05 * peak).any() or (step[top:] > 0.05 * peak).any()):
        return None  # two stripes in one run
    position = torch.arange(first, last + 1, dtype=torch.float64)
    share = (position - first) / (last - first)
    excess = strip[first : last + 1] - (1 - share) * strip[first] - share * strip[last]
    return float((excess * position).sum() / excess.sum())


def test_nothing_is_taken_where_no_object_is_in_view():
    """As in a drive that begins in mid-air, looking at the empty road below."""
    assert take_channels(torch.zeros(2, 3), torch.zeros(0, dtype=torch.int64)).shape == (2, 0)
