"""Kinds of road: what each adds to the image, and that it adds nothing to the labels."""

from typing import Any

import pytest
import torch

from lanebev.geometry.lens import distort_points
from lanebev.render import Drive, RenderedFrame, render_views
from lanebev.render.course import sample_alignment
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.rays import View
from lanebev.render.raster.light.night import lamp_light, low_beam
from lanebev.render.raster.objects.tunnel import add_ceiling
from lanebev.render.raster.road.glyphs import GLYPH_LENGTH, glyph_coverage
from lanebev.render.raster.road.roadside import roadside
from lanebev.render.raster.road.winter import snow_cover
from lanebev.render.raster.sensor.effects import add_bonnet
from lanebev.render.raster.sensor.glass import behind_glass, recorded
from lanebev.render.scene.camera.glass import sample_glass
from lanebev.render.scene.camera.lens import Lens, sample_distortion, sample_extrinsics, sample_intrinsics
from lanebev.render.scene.kinds import KINDS, sample_kinds
from lanebev.render.scene.light.night import sample_lights
from lanebev.render.scene.light.weather import Light
from lanebev.render.scene.objects.traffic import NUM_VEHICLES
from lanebev.render.scene.places.street import AHEAD, CROSS, LEFT, NUM_GLYPHS, PLAIN, RIGHT, no_street
from lanebev.render.scene.road.alignment import arc_nodes, build_alignment
from lanebev.render.scene.road.layout import presence
from lanebev.render.scene.sampler import BatchSampler
from lanebev.render.scene.world import Place, World, sample_world, scene_at
from lanebev.render.views import render_scenes, sample_place
from lanebev.types import Extrinsics

SIZE = (48, 96)


def sampler_of(batch: int, seed: int) -> BatchSampler:
    return BatchSampler(batch, torch.Generator().manual_seed(seed))


def seen(kind: str, seed: int, **without: Any) -> RenderedFrame:
    """Worlds of a kind, parts of them replaced, from the same places, without the sensor's noise."""
    batch = 3
    sampler = sampler_of(batch, seed)
    world, ego_lane = sample_world(sampler, kind)
    world, place = sample_place(sampler, world, ego_lane)
    alignment = sample_alignment(sampler)
    intrinsics = sample_intrinsics(sampler, SIZE)
    lens = Lens(
        intrinsics,
        sample_distortion(sampler, intrinsics, SIZE, "pinhole"),
        "pinhole",
        sample_extrinsics(sampler),
    )
    world = world._replace(**without)
    scene = scene_at(world, place, alignment, lens)
    return render_scenes(scene, SIZE, [1, 2, 3], ideal_sensor=kind != "camera")


@pytest.mark.parametrize("kind", KINDS)
def test_images_are_finite_and_repeat_by_seed(kind: str) -> None:
    frames = [render_views(2, SIZE, torch.Generator().manual_seed(7), kind=kind) for _ in range(2)]
    image = frames[0].image
    assert image.isfinite().all()
    assert image.min() >= 0
    assert image.max() <= 1
    for first, second in zip(*frames, strict=True):
        if isinstance(first, torch.Tensor):
            assert torch.equal(first, second)


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="kind: expected one of any, highway"):
        sample_kinds(sampler_of(2, 0), "moon")


def test_most_worlds_are_plain_highways() -> None:
    kinds = torch.stack(sample_kinds(sampler_of(20000, 0), "any"))
    assert 0.55 < 1 - kinds.any(0).float().mean() < 0.65
    assert (kinds.float().mean(1) > 0.02).all()
    city, night = kinds[0], kinds[2]
    assert (city & night).float().mean() > 0.05  # they combine


def test_a_highway_takes_no_number_from_the_sequence_for_other_kinds() -> None:
    """The same seed gives the highway that it gave before there were other kinds."""
    sampler = sampler_of(2, 3)
    world, _ = sample_world(sampler, "highway")
    assert not torch.stack(world.kinds).any()
    sampler = sampler_of(2, 3)
    assert torch.equal(world.layout.dash_phase, sample_world(sampler, "highway")[0].layout.dash_phase)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_streets_own_paint_and_kerbs_change_the_image_and_no_label(seed: int) -> None:
    plain = seen("city", seed, street=no_street(sample_world(sampler_of(3, 0), "city")[0].street))
    street = seen("city", seed)
    assert (street.image - plain.image).abs().amax((1, 2, 3)).min() > 0.02
    for name in ("boundaries", "painted", "visible", "lane_width", "offset"):
        assert torch.equal(getattr(street, name), getattr(plain, name)), name


def test_lights_of_the_night_change_the_image_and_no_label() -> None:
    dark = sample_lights(sampler_of(3, 0), torch.zeros(3).bool(), torch.zeros(3), torch.zeros(3))
    day, night = seen("night", 2, lights=dark), seen("night", 2)
    assert (night.image - day.image).abs().amax((1, 2, 3)).min() > 0.02
    assert torch.equal(night.visible, day.visible)


def test_a_clean_camera_leaves_the_image_as_it_is() -> None:
    """All strengths zero is the identity, also beside rows that are not clean."""
    batch = 8
    bad = torch.arange(batch) >= 4
    glass = sample_glass(sampler_of(batch, 0), bad, bad)
    image = torch.rand(batch, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    taken = recorded(behind_glass(image, glass), glass)
    torch.testing.assert_close(taken[:4], image[:4], atol=1e-6, rtol=0)
    assert (taken[4:] - image[4:]).abs().amax((1, 2, 3)).max() > 0.1


def test_glyph_coverage_is_the_mean_over_the_footprint() -> None:
    """Fine pixels that tile a glyph have the same mean as one coarse pixel over all of it."""
    axis = (torch.arange(200) + 0.5) / 200
    x, y = torch.meshgrid(2 * axis - 1, GLYPH_LENGTH * axis, indexing="ij")
    for glyph in range(NUM_GLYPHS):
        which = torch.full_like(x, glyph, dtype=torch.long)
        fine = glyph_coverage(which, x, y, torch.full_like(x, 0.01), torch.full_like(x, 0.025)).mean()
        one = torch.tensor([0.5 * GLYPH_LENGTH])
        coarse = glyph_coverage(which[0, :1], 0 * one, one, 0 * one + 2.0, 0 * one + GLYPH_LENGTH)
        assert 0.02 < float(coarse) < 0.6
        torch.testing.assert_close(fine[None], coarse, atol=2e-3, rtol=0.02)


def test_glyphs_point_where_their_names_say() -> None:
    def at(glyph: int, x: float, y: float) -> float:
        value = glyph_coverage(*(torch.tensor([v]) for v in (glyph, x, y, 0.02, 0.05)))
        return float(value)

    assert at(AHEAD, 0.0, 4.5) == pytest.approx(1.0)
    assert at(AHEAD, 0.4, 4.5) == 0.0
    assert at(LEFT, -0.6, 3.7) == pytest.approx(1.0)
    assert at(LEFT, 0.6, 3.7) == 0.0
    assert at(RIGHT, 0.6, 3.7) == pytest.approx(1.0)
    assert at(CROSS, 0.0, 2.5) == pytest.approx(1.0)
    assert at(-1, 0.0, 2.5) == 0.0


def test_the_low_beam_is_bright_ahead_and_ends() -> None:
    lights = sample_lights(sampler_of(64, 0), torch.ones(64).bool(), torch.zeros(64), torch.zeros(64))
    lights = lights._replace(beam_rays=0 * lights.beam_rays)
    x = torch.zeros(64, 4)
    z = torch.tensor([8.0, 20.0, 60.0, 160.0]).expand(64, 4)
    ahead = low_beam(lights, x, z)
    assert (ahead[:, 0] > ahead[:, 2]).all()
    assert (ahead[:, 3] == 0).all()  # beyond every cut-off
    assert (low_beam(lights, x + 15, z)[:, 0] < 0.2 * ahead[:, 0]).all()


def test_lamp_light_is_one_below_a_lamp_of_unit_power_far_from_others() -> None:
    lights = sample_lights(sampler_of(1, 0), torch.ones(1).bool(), torch.zeros(1), torch.zeros(1))
    lights = lights._replace(
        lamp=torch.tensor([[1.0, 0.0]]),
        lamp_period=torch.tensor([1e4]),
        lamp_phase=torch.tensor([3.0]),
        lamp_across=torch.tensor([[-2.0, 5.0]]),
        lamp_height=torch.tensor([8.0]),
    )
    along, across = torch.tensor([[3.0, 11.0, 1e4 + 3.0]]), torch.full((1, 3), -2.0)
    expected = torch.tensor([[1.0, 2**-1.5, 1.0]])  # (h / distance)³ at 45 degrees
    torch.testing.assert_close(lamp_light(lights, along, across), expected, atol=1e-4, rtol=0)


def test_a_kerbs_top_is_seen_farther_out_by_h_over_h_minus_its_height() -> None:
    """Eye 1.5 m high, 3 m from a kerb of 0.15 m: its face reaches from 3 m to 3.333 m on the plane."""
    world, _ = sample_world(sampler_of(1, 0), "city")
    strips = torch.tensor([[[0.2, 0.0, 0.0, 2.0]] * 2])
    street = world.street._replace(
        kerb_height=torch.full((1, 2), 0.15),
        kerb_shade=torch.zeros(1, 2),
        kerb_blocks=torch.zeros(1),
        weeds=torch.zeros(1),
        strips=strips,
        colours=torch.full((1, 2, 4, 3), 0.3),
        junction_length=torch.zeros(1),
    )
    pavement = world.pavement._replace(left=torch.tensor([-50.0]), right=torch.tensor([3.0]))
    across = torch.tensor([[2.9, 3.05, 3.3, 3.4, 5.7, 5.9]])
    fine = torch.full_like(across, 0.01)
    eye = (torch.tensor([0.0]), torch.tensor([1.5]))
    ground = Ground(across, torch.full_like(across, 0.5), across, fine, fine)
    colour, there = roadside(street, pavement, ground, *eye)
    dark = colour[0, 0] < 0.05
    assert dark[1:4].tolist() == [True, True, False]
    # 2.2 m of strips on the raised plane end at (3 + 2.2) · 1.5 / 1.35 = 5.78 m
    assert there[0].round().tolist() == [0, 1, 1, 1, 1, 0]


def test_worlds_without_a_street_have_no_kerbs_or_paint() -> None:
    world: World = sample_world(sampler_of(4, 1), "highway")[0]
    assert not world.street.kerbed.any()
    assert (world.street.glyph < 0).all()
    assert not world.street.hatching.strength.any()


def test_a_kerb_is_the_boundary_where_nothing_is_painted_and_no_strip_lies_between() -> None:
    world, _ = sample_world(sampler_of(64, 3), "city")
    layout, pavement, street = world.layout, world.pavement, world.street
    last = layout.exists.sum(1) - 1
    rows = torch.arange(64)
    sides = ((torch.zeros_like(last), pavement.left), (last, pavement.right))
    kerbs = 0
    for side, (slot, edge) in enumerate(sides):
        at_edge = layout.across[rows, slot] == edge
        bare = layout.marked[rows, slot] & (layout.opacity[rows, slot] == 0)
        assert torch.equal(at_edge, bare)  # an unpainted boundary is a kerb, a painted one lies off it
        assert (street.strip[at_edge, side] == PLAIN).all()
        kerbs += int(at_edge.sum())
    assert 10 < kerbs < 64


def test_old_lines_of_road_works_change_the_image_and_no_label() -> None:
    world = sample_world(sampler_of(3, 5), "works")[0]
    clean = world.works._replace(strength=0 * world.works.strength, scar=0 * world.works.scar)
    old, new = seen("works", 5), seen("works", 5, works=clean)
    assert not torch.equal(old.image, new.image)
    assert torch.equal(old.visible, new.visible)
    assert old.visible.sum() > 20


def test_snow_covers_no_paint_that_is_labelled_and_all_that_is_not() -> None:
    """Over every boundary: bare where it is marked as present, covered where snow took it away."""
    batch = 16
    world, _ = sample_world(sampler_of(batch, 2), "snow")
    layout = world.layout._replace(marked=world.layout.exists)
    winter = world.winter._replace(line=torch.full((batch,), 0.4), ragged=torch.zeros(batch))
    pavement = world.pavement._replace(left=world.pavement.left - 20, right=world.pavement.right + 20)
    along = torch.linspace(0, 300, 400).expand(batch, -1)
    across = layout.across[:, 1:2].expand_as(along)
    fine = torch.full_like(along, 0.05)
    ground = Ground(along, along, across, fine, fine)
    cover = snow_cover(winter, layout, pavement, ground, torch.zeros_like(along))
    marked = presence(layout, torch.ones_like(along, dtype=torch.long), along) > 0
    exists = layout.exists[:, 1:2].expand_as(marked)
    assert (cover[marked & exists] == 0).all()
    assert (~marked & exists).any()
    assert (cover[~marked & exists] > 0.4).all()


def test_country_roads_mostly_have_nothing_to_find() -> None:
    world, ego_lane = sample_world(sampler_of(2000, 0), "country")
    assert 0.65 < float((~world.layout.marked.any(1)).float().mean()) < 0.85
    assert ((ego_lane == 0) | (ego_lane == 1)).all()


def test_a_tunnels_lamp_is_seen_where_it_hangs() -> None:
    """A ceiling 4 m above the camera is 10 m ahead under a rise of 0.4: a lamp is there, one every 20 m."""
    world, _ = sample_world(sampler_of(1, 0), "tunnel")
    one, zero = torch.ones(1), torch.zeros(1)
    tunnel = world.tunnel._replace(
        ceiling=5.5 * one,
        exit=1e5 * one,
        lamp=3.0 * one,
        lamp_across=torch.tensor([[0.0, 50.0]]),
        lamp_size=torch.tensor([[1.0, 0.5]]),
        lamp_period=20.0 * one,
        lamp_colour=torch.ones(1, 3),
        tone=torch.full((1, 3), 0.1),
        level=torch.full((1, 3), 0.1),
    )
    place = Place(along=zero, across=zero, ego_lane=zero.long(), heading=zero)
    straight = torch.zeros(1, len(arc_nodes()), dtype=torch.float64)
    intrinsics = torch.tensor([[[1e4, 0, 0], [0, 1e4, 0], [0, 0, 1]]])
    lens = Lens(intrinsics, torch.zeros(1, 5), "pinhole", Extrinsics(zero, zero, zero, 1.5 * one))
    ray_x, ray_y = torch.tensor([[0.0, 0.0, 0.3]]), -torch.tensor([[0.4, 0.2, 0.4]])
    rays = View((1, 3), ray_x, ray_y, torch.zeros(4, 1, 3))  # lamp at 10 m; none at 20 m; 3 m aside
    dark, free = torch.zeros(1, 3, 1, 3), torch.full((1, 1, 3), float("inf"))
    course = build_alignment(straight, straight)
    scene = scene_at(world._replace(tunnel=tunnel), place, course, lens)
    ceiling = add_ceiling(scene, rays, dark, free)[0, 0, 0]
    assert ceiling[0] == pytest.approx(3.0)
    assert ceiling[1:].max() < 0.05
    blocked = add_ceiling(scene, rays, dark, torch.full((1, 1, 3), 5.0))
    assert (blocked == 0).all()


def test_a_tilted_bonnet_hides_more_on_one_side_and_mirrors_the_sky() -> None:
    """The edge is at 1 - 0.2 + 0.2 x of the height, x from -0.5 to 0.5."""
    one, zero = torch.ones(1), torch.zeros(1)
    sensor = sample_world(sampler_of(1, 0), "highway")[0].sensor
    sensor = sensor._replace(
        bonnet=0.2 * one, bonnet_bow=zero, bonnet_tilt=0.2 * one, bonnet_ridge=zero, bonnet_mirror=one
    )
    dark = Light(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, 3), zero, zero)
    radiance, blocked = torch.zeros(1, 3, 96, 64), torch.full((1, 96, 64), float("inf"))
    radiance[:, :, :30] = 2.0  # a bright sky; the road is dark
    add_bonnet(radiance, blocked, torch.tensor([0]), 0.3, sensor, dark, torch.zeros(1, 3))
    hidden = (blocked[0] == 0).sum(0)
    assert hidden[0] == pytest.approx(96 * 0.3, abs=1)
    assert hidden[-1] == pytest.approx(96 * 0.1, abs=1)
    assert radiance[0, 0, 80, 5] > 0.2
    assert (radiance[0, 0, 40:60] == 0).all()


def test_a_black_frame_hides_what_is_under_it() -> None:
    """With a frame of 20 % no boundary is visible in the outermost columns."""
    kinds = sample_world(sampler_of(3, 4), "camera")[0]
    framed = seen("camera", 4, glass=kinds.glass._replace(frame=torch.full((3,), 0.2), veil=torch.zeros(3)))
    open_sides = seen("camera", 4, glass=kinds.glass._replace(frame=torch.zeros(3)))
    taken = distort_points(framed.boundaries.flatten(1, 2), framed.intrinsics, framed.distortion, "pinhole")
    points = taken[..., 0].view_as(framed.visible)
    outer = (points < 0.04 * SIZE[1]) | (points > 0.96 * SIZE[1])
    assert (open_sides.visible * outer).sum() > 0
    assert (framed.visible * outer).sum() == 0


def test_on_a_street_lanes_keep_their_directions_as_the_drive_goes_on() -> None:
    """Vehicles of the own direction drive with the camera, those of the other one towards it."""
    for seed in range(6):
        world = Drive(seed, SIZE, num_frames=60, kind="city").world
        street, traffic = world.street, world.traffic
        across, speed = traffic.across[0, :NUM_VEHICLES], traffic.speed[0, :NUM_VEHICLES]
        low = world.layout.across[0, street.first[0]]
        high = world.layout.across[0, street.first[0] + street.own[0]]
        own = (across > low) & (across < high)
        assert (speed[own] >= -3).all()
        assert (speed[~own] < -20).all()
