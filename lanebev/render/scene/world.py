"""A whole world: everything along one road, and where the camera is in it."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import select_rows
from lanebev.render.scene.camera.glass import Glass, sample_glass
from lanebev.render.scene.camera.lens import Lens
from lanebev.render.scene.camera.sensor import Sensor, sample_sensor, varied_camera
from lanebev.render.scene.kinds import Kinds, sample_kinds
from lanebev.render.scene.light.night import Lights, night_light, sample_lights
from lanebev.render.scene.light.weather import (
    CLEAR,
    DUSK,
    NIGHT,
    RAIN,
    Light,
    Weather,
    light_of,
    sample_weather,
    varied_weather,
)
from lanebev.render.scene.objects.objects import SceneObjects
from lanebev.render.scene.objects.surroundings import Surroundings, sample_surroundings
from lanebev.render.scene.objects.traffic import Traffic, place_objects, sample_traffic
from lanebev.render.scene.places.country import country_layout, country_pavement, country_surroundings
from lanebev.render.scene.places.street import Street, no_street, sample_street
from lanebev.render.scene.places.town import (
    NUM_PARKED,
    city_traffic,
    kerb_boundaries,
    street_edges,
    street_surroundings,
)
from lanebev.render.scene.places.tunnel import (
    Tunnel,
    sample_tunnel,
    tunnel_light,
    tunnel_surroundings,
    tunnel_traffic,
)
from lanebev.render.scene.places.winter import Winter, sample_winter, snowed_layout
from lanebev.render.scene.places.works import Works, sample_works, works_traffic
from lanebev.render.scene.road.alignment import Alignment
from lanebev.render.scene.road.city_layout import sample_city_layout
from lanebev.render.scene.road.layout import Gaps, Layout, sample_layout
from lanebev.render.scene.road.pavement import Pavement, sample_pavement
from lanebev.render.scene.sampler import BatchSampler


class World(NamedTuple):
    """Everything but the camera's place, B of them.

    Attributes:
        layout: the boundaries.
        pavement: the surface.
        surroundings: beside and above it.
        traffic: what stands and drives on it.
        weather: light and air.
        sensor: the camera's own faults.
        bridge: (B, 2) m along, where a bridge begins and ends; infinite: none.
        shade: (B,) strength of tree shadows on the road.
        kinds: what each world has besides the plain road.
        street: what a city street has.
        lights: lights of the night.
        glass: faults of windscreen, lens and recorder.
        winter: snow on the ground.
        works: old lines at road works.
        tunnel: about the road.
    """

    layout: Layout
    pavement: Pavement
    surroundings: Surroundings
    traffic: Traffic
    weather: Weather
    sensor: Sensor
    bridge: Tensor
    shade: Tensor
    kinds: Kinds
    street: Street
    lights: Lights
    glass: Glass
    winter: Winter
    works: Works
    tunnel: Tunnel


class Place(NamedTuple):
    """The place of the camera.

    Attributes:
        along: (B,) m, arc length in the world.
        across: (B,) m in the layout's frame.
        ego_lane: (B,) int64, slot of the boundary on the ego lane's left.
        heading: (B,) rad, of the road there in the world.
    """

    along: Tensor
    across: Tensor
    ego_lane: Tensor
    heading: Tensor


class Scene(NamedTuple):
    """All that a batch of images shows, and from where.

    Attributes:
        world: B of them.
        place: of the cameras.
        alignment: the road's course, seen from there.
        lens: the cameras.
        objects: what stands on the road, in the local road frame.
        light: in the local road frame.
    """

    world: World
    place: Place
    alignment: Alignment
    lens: Lens
    objects: SceneObjects
    light: Light


def scene_at(world: World, place: Place, alignment: Alignment, lens: Lens) -> Scene:
    """Bring worlds into the local road frames of cameras."""
    objects = place_objects(world.traffic, alignment, place.along, place.across)
    light = night_light(light_of(world.weather, place.heading), world.lights)
    return Scene(world, place, alignment, lens, objects, tunnel_light(light, world.tunnel))


def sample_ego_lane(sampler: BatchSampler, layout: Layout) -> Tensor:
    """Sample any lane, (B,) int64; more often the leftmost, beside the median."""
    lanes = (layout.exists.sum(1) - 1).clamp(min=1)
    share = torch.where(sampler.chance(0.2), 0.0, sampler.uniform(0, 1))
    return (share * lanes).long().clamp(max=7)


def sample_world(sampler: BatchSampler, kind: str) -> tuple[World, Tensor]:
    """Sample random worlds and an ego lane in each, (B,) int64.

    Args:
        sampler: the randomness.
        kind: see :func:`~lanebev.render.scene.kinds.sample_kinds`.
    """
    more = sampler if kind != "highway" else sampler.beside()  # draws for other kinds do not change a highway
    kinds = sample_kinds(more, kind)
    dotted = sampler.chance(0.35)
    bright = sampler.chance(0.12) & ~dotted
    faint = bright | sampler.chance(0.12)
    layout = sample_layout(sampler, dotted, faint)
    median = sampler.chance(0.15) & ~kinds.city
    ego_lane = torch.where(median & sampler.chance(0.7), 0, sample_ego_lane(sampler, layout))
    layout, ego_lane, street = _with_street(more, kinds, layout, ego_lane)
    layout, ego_lane = country_layout(more, kinds.country, layout, ego_lane)
    layout, works = sample_works(more, kinds.works, layout)
    layout = snowed_layout(more, kinds.snow, layout)
    weather = varied_weather(more, kinds, _sample_weather(sampler, dotted, bright))
    pavement = sample_pavement(sampler, layout, dotted, bright, weather.wet, median)
    pavement = street_edges(more, kinds.city, street, layout, pavement)
    pavement = country_pavement(more, kinds.country, layout, pavement)
    layout = kerb_boundaries(kinds.city, street, layout, pavement)
    opposite = torch.where(sampler.chance(0.5), pavement.left - sampler.uniform(0.8, 9.0), -math.inf)
    surroundings = sample_surroundings(sampler, pavement.left, pavement.right, weather.grey, opposite, median)
    surroundings = street_surroundings(more, kinds.city, street, pavement, surroundings)
    surroundings = country_surroundings(more, kinds.country, pavement, surroundings)
    tunnel = sample_tunnel(more, kinds.tunnel, pavement)
    surroundings = tunnel_surroundings(more, kinds.tunnel, tunnel, pavement, surroundings)
    lights = sample_lights(more, kinds.night, pavement.left, pavement.right)
    surroundings = _tinted(surroundings, weather, lights)
    begin = sampler.sometimes(0.25, -6, 140, otherwise=math.inf)  # of a bridge
    begin = torch.where((kinds.city & more.chance(0.75)) | kinds.country | kinds.tunnel, math.inf, begin)
    extent = sampler.uniform(6, 30)
    traffic = sample_traffic(sampler, layout, ego_lane, surroundings.opposite, pavement, begin, extent)
    traffic = city_traffic(more, kinds.city, street, layout, pavement, traffic)
    traffic = works_traffic(more, kinds.works, layout, traffic, NUM_PARKED)
    traffic = tunnel_traffic(kinds.tunnel, traffic)
    sensor = varied_camera(more, kinds, sample_sensor(sampler, weather, bright))
    shade = sampler.sometimes(0.22, 0.3, 1.0)
    shade = torch.where(kinds.city & more.chance(0.25), more.uniform(0.4, 1.0), shade)
    glass = sample_glass(more, kinds.camera, kinds.night)
    world = World(
        layout=layout,
        pavement=pavement,
        surroundings=surroundings,
        traffic=traffic,
        weather=weather,
        sensor=sensor,
        bridge=torch.stack([begin, begin + extent], dim=1),
        shade=torch.where(kinds.tunnel, 0.0, shade),
        kinds=kinds,
        street=street,
        lights=lights,
        glass=glass,
        winter=sample_winter(more, kinds.snow),
        works=works,
        tunnel=tunnel,
    )
    return world, ego_lane


def _sample_weather(sampler: BatchSampler, dotted: Tensor, bright: Tensor) -> Weather:
    """Sample the weather: clear over bleached concrete, and mostly clear over Californian studs."""
    weather = sample_weather(sampler)
    sunny = bright | (dotted & sampler.chance(0.7))
    return weather._replace(
        kind=torch.where(sunny, CLEAR, weather.kind), grey=torch.where(sunny, 0.1, weather.grey)
    )


def _with_street(
    sampler: BatchSampler, kinds: Kinds, layout: Layout, ego_lane: Tensor
) -> tuple[Layout, Tensor, Street]:
    """Replace highways by streets where a world is in a city."""
    city, lane, first, own = sample_city_layout(sampler, layout)
    street = sample_street(sampler, city, lane, first, own)
    sampler.uniform(0, 1)  # not used, but all later draws depend on it
    junctions = (street.junction_period, street.junction_length, street.phase)
    city = city._replace(gaps=Gaps(*(each[:, None].expand_as(city.across) for each in junctions)))
    return (
        select_rows(kinds.city, city, layout),
        torch.where(kinds.city, lane, ego_lane),
        select_rows(kinds.city, street, no_street(street)),
    )


def moved_along(world: World, start: Tensor) -> World:
    """Return the same worlds with everything placed from ``start`` (B,) m on instead of from zero."""
    shift, gaps = start[:, None], world.layout.gaps
    return world._replace(
        layout=world.layout._replace(gaps=gaps._replace(phase=gaps.phase - shift)),
        pavement=world.pavement._replace(deck_phase=world.pavement.deck_phase - start),
        traffic=world.traffic._replace(along=world.traffic.along + shift),
        bridge=world.bridge + shift,
        street=world.street._replace(phase=world.street.phase - start),
        works=world.works._replace(phase=world.works.phase - start),
        tunnel=world.tunnel._replace(exit=world.tunnel.exit + start),
    )


def _tinted(surroundings: Surroundings, weather: Weather, lights: Lights) -> Surroundings:
    """Return the sky of dusk and night."""
    night, dusk = (weather.kind == NIGHT)[:, None], (weather.kind == DUSK)[:, None]
    zenith = torch.where(night, surroundings.zenith * 0.012, surroundings.zenith)
    skyline = torch.where(night, surroundings.skyline * 0.02, surroundings.skyline)
    zenith = torch.where(dusk, zenith * torch.tensor([0.6, 0.5, 0.5]), zenith)
    skyline = torch.where(dusk, skyline * torch.tensor([1.1, 0.75, 0.5]), skyline)
    dim = torch.where((weather.kind == RAIN)[:, None], 0.75, 1.0)
    dim = torch.where((lights.on > 0)[:, None], lights.dark[:, None], dim)
    return surroundings._replace(zenith=zenith * dim, skyline=skyline * dim)
