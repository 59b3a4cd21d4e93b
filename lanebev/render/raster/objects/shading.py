"""The radiance of points on vehicles, signs, bridges and poles."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.objects.hexahedra import BOTTOM, FRONT, LEFT, REAR, RIGHT, TOP
from lanebev.render.scene.light.weather import Light
from lanebev.render.scene.objects.objects import BRIDGE, SIGN, TRUCK, SceneObjects
from lanebev.tensors import constant


class Point(NamedTuple):
    """N points on objects, (N,) each unless said otherwise.

    Attributes:
        x: m, right of the object's middle, in its own frame.
        z: m, forward.
        up: m above the road.
        level: share of the height of the lower hexahedron.
        aside: |x| over the half width.
        depth: m from the camera, Z.
        face: int64, RIGHT to BOTTOM.
        upper: bool, on the second hexahedron.
        side: bool, on a face to the right or the left.
        end: bool, on the front or the rear.
        body: (N, 8) the lower hexahedron, see :class:`SceneObjects`.
        top: (N, 8) the upper one.
    """

    x: Tensor
    z: Tensor
    up: Tensor
    level: Tensor
    aside: Tensor
    depth: Tensor
    face: Tensor
    upper: Tensor
    side: Tensor
    end: Tensor
    body: Tensor
    top: Tensor


def object_radiance(
    objects: SceneObjects, light: Light, depth: Tensor, face: Tensor, upper: Tensor, ray_x: Tensor, up: Tensor
) -> Tensor:
    """Compute the linear radiance of points on objects, (N, 3).

    Args:
        objects: N of them, one for each point.
        light: N rows, as it falls on each.
        depth: (N,) m, Z of the points.
        face: (N,) int64.
        upper: (N,) bool, on the second hexahedron.
        ray_x: (N,) right per metre forward.
        up: (N,) m above the road.
    """
    point = _point(objects, depth, face, upper, ray_x, up)
    vehicle, truck = objects.kind <= TRUCK, objects.kind == TRUCK
    surface, lamp = _vehicle_surface(objects.colour, point, vehicle, truck)
    surface = _sign_surface(surface, objects.colour, point, objects.kind == SIGN)
    surface = _bridge_surface(surface, point, objects.kind == BRIDGE)
    radiance = surface * _illumination(light, objects.heading, point, vehicle)
    glossy = (vehicle & ~truck & (point.up >= 0.28)).float()
    flat = (_normal_up(point) > 0.5).float()
    radiance = radiance + (glossy * (0.04 + 0.10 * flat))[:, None] * light.ambient * 1.2
    return radiance + _lamp_radiance(light, objects.braking, point, lamp)


def _point(
    objects: SceneObjects, depth: Tensor, face: Tensor, upper: Tensor, ray_x: Tensor, up: Tensor
) -> Point:
    right, ahead = ray_x * depth - objects.x, depth - objects.z
    sin, cos = objects.heading.sin(), objects.heading.cos()
    x, body, top = right * cos - ahead * sin, objects.shape[:, 0], objects.shape[:, 1]
    return Point(
        x=x,
        z=right * sin + ahead * cos,
        up=up,
        level=(up - body[:, 6]) / (body[:, 7] - body[:, 6]).clamp(min=1e-3),
        aside=(x / body[:, 0]).abs(),
        depth=depth,
        face=face,
        upper=upper,
        side=(face == RIGHT) | (face == LEFT),
        end=(face == REAR) | (face == FRONT),
        body=body,
        top=top,
    )


def _vehicle_surface(colour: Tensor, p: Point, vehicle: Tensor, truck: Tensor) -> tuple[Tensor, Tensor]:
    """Add the features of cars and trucks to the reflectance (N, 3); also (N,) bool: on a lamp."""
    dark = constant((0.012, 0.012, 0.013), colour)
    surface = _car_glass(colour, p, vehicle & ~truck)
    below = vehicle & (p.up < torch.where(truck, 1.0, 0.28))
    surface = _put(surface, below & (p.face < TOP), dark)
    rear, front = p.body[:, 2], p.body[:, 3]
    long = front - rear
    wheel_z = torch.minimum((p.z - rear - 0.2 * long).abs(), (p.z - front + 0.19 * long).abs())
    radius = torch.where(truck, 0.5, 0.33)
    wheel = torch.hypot(wheel_z, p.up - radius)
    tyre = vehicle & p.side & (wheel < radius) & ~p.upper
    surface = _put(surface, tyre, dark * 1.5)
    surface = _put(surface, tyre & (wheel < 0.6 * radius), constant((0.25, 0.25, 0.26), colour))
    tyre_end = vehicle & p.end & (p.up < 2 * radius) & (p.up < 0.36 + 0.6 * truck)
    surface = _put(surface, tyre_end & (p.aside > 0.62) & (p.aside < 0.95), dark * 1.8)
    surface, lamp = _car_end(surface, p, vehicle & ~truck & p.end & ~p.upper)
    return _truck_end(surface, p, truck & p.end, lamp)


def _car_glass(colour: Tensor, p: Point, car: Tensor) -> Tensor:
    """Add dark windows between frames and pillars to the reflectance."""
    pane = (p.up - p.top[:, 6]) / (p.top[:, 7] - p.top[:, 6]).clamp(min=1e-3)
    width_here = p.top[:, 0] + (p.top[:, 1] - p.top[:, 0]) * pane
    frame = (pane > 0.88) | (pane < 0.08) | (p.end & (p.x.abs() > width_here - 0.09))
    pillar = p.side & (((p.z - 0.1).abs() < 0.06) | ((p.z + 1.15).abs() < 0.07))
    glass = car & p.upper & (p.face < TOP) & ~frame & ~pillar
    return _put(colour, glass, (0.03 + 0.05 * pane)[:, None].expand(-1, 3))


def _car_end(surface: Tensor, p: Point, end: Tensor) -> tuple[Tensor, Tensor]:
    """Add bumper, plate and gap at a car's ends to the reflectance; also (N,) bool: on a lamp."""
    bumper = end & (p.level < 0.42) & (p.level > 0.28)
    surface = torch.where(bumper[:, None], surface * 0.6, surface)
    plate = end & (p.x.abs() < 0.26) & (p.level > 0.45) & (p.level < 0.62)
    surface = _put(surface, plate, constant((0.5, 0.5, 0.5), surface))
    gap = end & ((p.level - 0.93).abs() < 0.03)
    surface = torch.where(gap[:, None], surface * 0.5, surface)
    return surface, end & (p.level > 0.7) & (p.level < 0.86) & (p.aside > 0.7)


def _truck_end(surface: Tensor, p: Point, end: Tensor, car_lamp: Tensor) -> tuple[Tensor, Tensor]:
    """Add lamps and doors at a truck's ends to the reflectance; also (N,) bool: on a lamp of any vehicle."""
    lamp = car_lamp | (end & (p.up > 1.0) & (p.up < 1.15) & (p.aside > 0.7))
    red, white = lamp & (p.face == REAR), lamp & (p.face == FRONT)
    surface = _put(surface, red, constant((0.28, 0.012, 0.01), surface))
    surface = _put(surface, white, constant((0.6, 0.6, 0.6), surface))
    edge = (p.x.abs() < 0.03) | (p.aside > 0.96) | (p.level > 0.98)
    doors = end & (p.face == REAR) & edge & (p.up > 1.0)
    return torch.where(doors[:, None], surface * 0.5, surface), lamp


def _sign_surface(surface: Tensor, colour: Tensor, p: Point, sign: Tensor) -> Tensor:
    """Add a sign's face to the reflectance: a rim and two lines of something like letters."""
    wide, low, high = p.top[:, 0], p.top[:, 6], p.top[:, 7]
    level = (p.up - low) / (high - low).clamp(min=1e-3)
    across = p.x / wide.clamp(min=1e-3)
    rim = (across.abs() > 0.96) | (level > 0.94) | (level < 0.06)
    row, letter = (level * 3.4).floor(), (across * wide * 2.7).floor()
    ink = ((letter * 12.9898 + row * 78.233).sin() * 43758.5453) % 1.0 > 0.4
    inside = ((level * 3.4) % 1.0 > 0.35) & ((across * wide * 2.7) % 1.0 > 0.25) & (across.abs() < 0.85)
    white = rim | (ink & inside & (level > 0.1) & (level < 0.9))
    face = torch.where(white[:, None], constant((0.6, 0.6, 0.6), colour), colour)
    return _put(surface, sign & p.end & p.upper, face)


def _bridge_surface(surface: Tensor, p: Point, bridge: Tensor) -> Tensor:
    """Add a bridge's ribs and parapets to the reflectance."""
    ribs = bridge & p.side & ((p.z % 3.0) < 0.15)
    surface = torch.where(ribs[:, None], surface * 0.7, surface)
    parapet = bridge & p.end & (p.level > 0.72)
    return torch.where(parapet[:, None], surface * 1.25, surface)


def _normal_up(p: Point) -> Tensor:
    """Return the upward part of the normal; windows are inclined."""
    leaning = 0.35 * (p.upper & (p.face < TOP)).float()
    return (p.face == TOP).float() - (p.face == BOTTOM).float() + leaning


def _illumination(light: Light, heading: Tensor, p: Point, vehicle: Tensor) -> Tensor:
    """Compute the irradiance over pi by sun, sky and the camera's own headlights, (N, 3)."""
    normal_x = (p.face == RIGHT).float() - (p.face == LEFT).float()
    normal_z = (p.face == FRONT).float() - (p.face == REAR).float()
    normal_up = _normal_up(p)
    sin, cos = heading.sin(), heading.cos()
    facing = (normal_x * cos + normal_z * sin) * light.sun[:, 0] + normal_up * light.sun[:, 1]
    facing = (facing + (normal_z * cos - normal_x * sin) * light.sun[:, 2]).clamp(0, 1)
    open_sky = (0.55 + 0.45 * normal_up).clamp(0.12, 1.0) * torch.where(vehicle & (p.up < 0.5), 0.6, 1.0)
    lit = light.direct * facing[:, None] + light.ambient * open_sky[:, None]
    distance = p.depth.clamp(1.0, 1e4)
    beam = light.headlight * 60 / (distance * distance + 60) * (p.face == REAR)
    return lit + beam[:, None] * constant((1.0, 0.95, 0.85), lit)


def _lamp_radiance(light: Light, braking: Tensor, p: Point, lamp: Tensor) -> Tensor:
    """Compute the radiance of tail lamps and, at night, of other vehicles' headlamps, (N, 3)."""
    night = light.night > 0.4
    tail = lamp & (p.face == REAR) & (braking | night)
    red = (0.35 + 0.5 * braking.float()) * tail
    white = 2.5 * (lamp & (p.face == FRONT) & night)
    glow = red[:, None] * constant((0.9, 0.04, 0.02), red)
    return glow + white[:, None] * constant((1.0, 0.95, 0.8), red)


def _put(surface: Tensor, where: Tensor, value: Tensor) -> Tensor:
    return torch.where(where[:, None], value, surface)
