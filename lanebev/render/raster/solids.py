"""Things that stand on the road: vehicles, poles, signs, bridges, as pairs of convex hexahedra.

Drawn far to near, one thing of every image at a time, over the pixels of its bounding box only, with four
rays to the pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.lens import Lens

CAR, TRUCK, POLE, SIGN, BRIDGE = range(5)
RIGHT, LEFT, FRONT, REAR, TOP, BOTTOM = range(6)  # faces in the thing's own frame
_SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))  # rotated grid


class Solids(NamedTuple):
    """Things in the local road frame, (B, M) each unless said otherwise.

    Attributes:
        x: m, middle.
        z: m, middle.
        ground: m, the road's elevation below it.
        heading: rad, positive to the right.
        shape: (B, M, 2, 8) m, two hexahedra: half width below and above, rear and front end below,
            rear and front end above, lower and upper face's height. No volume: not there.
        kind: int64, CAR, TRUCK, POLE, SIGN, BRIDGE.
        colour: (B, M, 3) linear reflectance.
        braking: bool, lights its brake lights.
        valid: bool.
    """

    x: Tensor
    z: Tensor
    ground: Tensor
    heading: Tensor
    shape: Tensor
    kind: Tensor
    colour: Tensor
    braking: Tensor
    valid: Tensor


class Light(NamedTuple):
    """Illumination, linear.

    Attributes:
        sun: (B, 3) direction to the sun in the local road frame (right, up, forward).
        direct: (B, 3) irradiance over pi of the sun on a surface facing it.
        ambient: (B, 3) of the sky on a surface facing up.
        headlight: (B,) strength of the camera's own headlights.
        night: (B,) in [0, 1].
    """

    sun: Tensor
    direct: Tensor
    ambient: Tensor
    headlight: Tensor
    night: Tensor


class Hit(NamedTuple):
    """First intersections of N rays with things.

    Attributes:
        thing: (N,) int64.
        pixel: (N,) int64, row-major.
        share: (N,) of the pixel that the thing covers.
        depth: (N,) m, Z.
        face: (N,) int64.
        upper: (N,) bool, the second hexahedron.
    """

    thing: Tensor
    pixel: Tensor
    share: Tensor
    depth: Tensor
    face: Tensor
    upper: Tensor


def face_planes(solids: Solids, height: Tensor) -> tuple[Tensor, Tensor]:
    """Planes of all faces, seen from the camera.

    Args:
        solids: the things.
        height: (B,) m, of the camera.

    Returns:
        (B, M, 2, 6, 3) outward normals (right, up, forward) in the road frame, not of unit length, and
        (B, M, 2, 6) how far the camera lies inside of each plane, in lengths of its normal.
    """
    wide_low, wide_high, rear_low, front_low, rear_high, front_high, low, high = solids.shape.unbind(-1)
    tall = (high - low).clamp(min=1e-3)
    side = (wide_low - wide_high) / tall
    front, rear = (front_low - front_high) / tall, (rear_high - rear_low) / tall
    zero, one = torch.zeros_like(low), torch.ones_like(low)
    right = torch.stack([one, -one, zero, zero, zero, zero], dim=-1)
    up = torch.stack([side, side, front, rear, one, -one], dim=-1)
    ahead = torch.stack([zero, zero, one, -one, zero, zero], dim=-1)
    reach = torch.stack(
        [
            wide_low + side * low,
            wide_low + side * low,
            front_low + front * low,
            -rear_low + rear * low,
            high,
            -low,
        ],
        dim=-1,
    )
    sin, cos = solids.heading.sin()[..., None, None], solids.heading.cos()[..., None, None]
    normal = torch.stack([right * cos + ahead * sin, up, ahead * cos - right * sin], dim=-1)
    away = torch.stack([-solids.x, height[:, None] - solids.ground, -solids.z], dim=-1)
    return normal, reach - (normal * away[:, :, None, None]).sum(-1)


def cast(normal: Tensor, room: Tensor, ray: Tensor, grow: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Rays against one thing of two convex hexahedra each.

    Args:
        normal: (12, 3, N), see :func:`face_planes`.
        room: (12, N).
        ray: (2, N) right and up per metre forward.
        grow: (N,) m by which the things are taken to be larger.

    Returns:
        (N,) Z of the entry, m, infinite where there is none; (N,) int64 face, plus 6 on the second one.
    """
    speed = normal[:, 0] * ray[0] + normal[:, 1] * ray[1] + normal[:, 2]  # approach per metre forward
    time = ((room if grow is None else room + grow) / speed).unflatten(0, (2, 6))
    enters = (speed < 0).unflatten(0, (2, 6))
    entry, face = time.masked_fill(~enters, -math.inf).max(1)
    leave = time.masked_fill(enters, math.inf).amin(1)
    entry = entry.masked_fill((entry >= leave) | (entry <= 0), math.inf)
    upper = entry[1] < entry[0]
    return torch.where(upper, entry[1], entry[0]), torch.where(upper, face[1] + 6, face[0])


def bounding_boxes(solids: Solids, lens: Lens, height: Tensor, size: tuple[int, int]) -> Tensor:
    """Pixel bounds of every thing.

    Args:
        solids: the things.
        lens: from road directions to pixels.
        height: (B,) m.
        size: image (height, width).

    Returns:
        (B, M, 4) int64: left, top, right, bottom, the last two exclusive; empty where unseen.
    """
    shape = solids.shape
    wide = shape[..., :2].amax((-1, -2))
    rear, front = shape[..., 2::2][..., :2].amin((-1, -2)), shape[..., 3::2][..., :2].amax((-1, -2))
    low, high = shape[..., 6].amin(-1), shape[..., 7].amax(-1)
    corners = []
    for sx in (-1, 1):
        for end in (rear, front):
            for level in (low, high):
                sin, cos = solids.heading.sin(), solids.heading.cos()
                x = solids.x + sx * wide * cos + end * sin
                z = solids.z - sx * wide * sin + end * cos
                down = height[:, None] - solids.ground - level
                corners.append(torch.stack([x, down, z], dim=-1))
    points = torch.stack(corners, dim=2)  # (B, M, 8, 3)
    seen = solids.valid & (points[..., 2].amax(-1) > 0.5)
    points = torch.cat([points[..., :2], points[..., 2:].clamp(min=0.3)], dim=-1)
    pixels = lens.pixels_as_taken(points.flatten(1, 2), size).unflatten(1, points.shape[1:3])
    limit = pixels.new_tensor([size[1], size[0]])
    low_px = (pixels.amin(2).floor() - 1).clamp(min=0).minimum(limit)
    high_px = (pixels.amax(2).ceil() + 2).clamp(min=0).minimum(limit)
    return torch.cat([low_px, high_px], dim=-1).where(seen[..., None], 0.0).long()


def shade(solids: Solids, hit: Hit, ray: Tensor, height: Tensor, light: Light) -> Tensor:
    """Linear radiance of hit points, (N, 3), of rays (2, N) right and up per metre forward."""
    index = hit.thing
    kind, colour = solids.kind[0, index], solids.colour[0, index]
    heading, shape = solids.heading[0, index], solids.shape[0, index, 0]
    right, ahead = ray[0] * hit.depth - solids.x[0, index], hit.depth - solids.z[0, index]
    x = right * heading.cos() - ahead * heading.sin()
    z = right * heading.sin() + ahead * heading.cos()
    up = height + ray[1] * hit.depth - solids.ground[0, index]
    half_width, low, high = shape[:, 0], shape[:, 6], shape[:, 7]
    rear, front = shape[:, 2], shape[:, 3]
    vehicle, truck = kind <= TRUCK, kind == TRUCK
    end = (hit.face == REAR) | (hit.face == FRONT)
    side = (hit.face == RIGHT) | (hit.face == LEFT)
    level = (up - low) / (high - low).clamp(min=1e-3)
    aside = (x / half_width).abs()

    surface = colour.clone()
    glass = vehicle & hit.upper & (hit.face < TOP)
    span = solids.shape[0, index, 1]
    pane = (up - span[:, 6]) / (span[:, 7] - span[:, 6]).clamp(min=1e-3)
    width_here = span[:, 0] + (span[:, 1] - span[:, 0]) * pane
    frame = (pane > 0.88) | (pane < 0.08) | (end & (x.abs() > width_here - 0.09))
    pillar = side & (((z - 0.1).abs() < 0.06) | ((z + 1.15).abs() < 0.07))
    reflection = 0.03 + 0.05 * pane
    surface = _put(surface, glass & ~frame & ~pillar & ~truck, reflection[:, None] * colour.new_ones(3))

    wheel_z = torch.minimum(
        (z - (rear + 0.2 * (front - rear))).abs(), (z - (front - 0.19 * (front - rear))).abs()
    )
    radius = torch.where(truck, 0.5, 0.33)
    wheel = torch.hypot(wheel_z, up - radius)
    below = vehicle & (up < torch.where(truck, 1.0, 0.28))
    dark = colour.new_tensor([0.012, 0.012, 0.013])
    surface = _put(surface, below & (hit.face < TOP), dark)
    tyre = vehicle & side & (wheel < radius) & ~hit.upper
    surface = _put(surface, tyre, dark * 1.5)
    surface = _put(surface, tyre & (wheel < 0.6 * radius), colour.new_tensor([0.25, 0.25, 0.26]))
    tyre_end = vehicle & end & (up < 2 * radius) & (up < 0.36 + 0.6 * truck) & (aside > 0.62) & (aside < 0.95)
    surface = _put(surface, tyre_end, dark * 1.8)
    car_end = vehicle & ~truck & end & ~hit.upper
    bumper = car_end & (level < 0.42) & (level > 0.28)
    surface = torch.where(bumper[:, None], surface * 0.6, surface)
    plate = car_end & (x.abs() < 0.26) & (level > 0.45) & (level < 0.62)
    surface = _put(surface, plate, colour.new_tensor([0.5, 0.5, 0.5]))
    lamp = ((car_end & (level > 0.7) & (level < 0.86)) | (truck & end & (up > 1.0) & (up < 1.15))) & (
        aside > 0.7
    )
    red = lamp & (hit.face == REAR)
    surface = _put(surface, red, colour.new_tensor([0.28, 0.012, 0.01]))
    surface = _put(surface, lamp & (hit.face == FRONT), colour.new_tensor([0.6, 0.6, 0.6]))
    gap = car_end & ((level - 0.93).abs() < 0.03)
    surface = torch.where(gap[:, None], surface * 0.5, surface)
    doors = truck & (hit.face == REAR) & ((x.abs() < 0.03) | (aside > 0.96) | (level > 0.98)) & (up > 1.0)
    surface = torch.where(doors[:, None], surface * 0.5, surface)

    sign = (kind == SIGN) & end & hit.upper
    surface = _put(surface, sign, _lettering(x, up, span, colour))
    deck = kind == BRIDGE
    ribs = deck & side & ((z % 3.0) < 0.15)
    surface = torch.where(ribs[:, None], surface * 0.7, surface)
    parapet = deck & end & (level > 0.72)
    surface = torch.where(parapet[:, None], surface * 1.25, surface)

    normal_x = (hit.face == RIGHT).float() - (hit.face == LEFT).float()
    normal_z = (hit.face == FRONT).float() - (hit.face == REAR).float()
    normal_up = (
        (hit.face == TOP).float()
        - (hit.face == BOTTOM).float()
        + 0.35 * (hit.upper & (hit.face < TOP)).float()
    )
    sin, cos = heading.sin(), heading.cos()
    sun = light.sun
    facing = (normal_x * cos + normal_z * sin) * sun[:, 0] + normal_up * sun[:, 1]
    facing = (facing + (normal_z * cos - normal_x * sin) * sun[:, 2]).clamp(0, 1)
    open_sky = (0.55 + 0.45 * normal_up).clamp(0.12, 1.0) * torch.where(vehicle & (up < 0.5), 0.6, 1.0)
    lit = light.direct * facing[:, None] + light.ambient * open_sky[:, None]
    distance = hit.depth.clamp(1.0, 1e4)
    beam = light.headlight * 60 / (distance * distance + 60) * (hit.face == REAR)
    lit = lit + beam[:, None] * lit.new_tensor([1.0, 0.95, 0.85])
    gloss = (vehicle & ~truck & ~below).float() * (0.04 + 0.10 * (normal_up > 0.5))
    radiance = surface * lit + gloss[:, None] * light.ambient * 1.2
    tail = red & (solids.braking[0, index] | (light.night > 0.4))
    glow = (0.35 + 0.5 * solids.braking[0, index].float()) * tail
    oncoming = lamp & (hit.face == FRONT) & (light.night > 0.4)
    radiance = radiance + glow[:, None] * radiance.new_tensor([0.9, 0.04, 0.02])
    return radiance + (2.5 * oncoming)[:, None] * radiance.new_tensor([1.0, 0.95, 0.8])


def _put(surface: Tensor, where: Tensor, value: Tensor) -> Tensor:
    return torch.where(where[:, None], value, surface)


def _lettering(x: Tensor, up: Tensor, span: Tensor, colour: Tensor) -> Tensor:
    """A sign's face, (N, 3): a rim and two lines of something like letters."""
    wide, low, high = span[:, 0], span[:, 6], span[:, 7]
    level = (up - low) / (high - low).clamp(min=1e-3)
    across = x / wide.clamp(min=1e-3)
    rim = (across.abs() > 0.96) | (level > 0.94) | (level < 0.06)
    row = (level * 3.4).floor()
    letter = (across * wide * 2.7).floor()
    ink = ((letter * 12.9898 + row * 78.233).sin() * 43758.5453) % 1.0 > 0.4
    inside = ((level * 3.4) % 1.0 > 0.35) & ((across * wide * 2.7) % 1.0 > 0.25) & (across.abs() < 0.85)
    white = rim | (ink & inside & (level > 0.1) & (level < 0.9))
    return torch.where(white[:, None], colour.new_tensor([0.6, 0.6, 0.6]), colour)


def _pixels_in(boxes: list[list[int]], things: list[int], columns: int) -> tuple[Tensor, Tensor]:
    """Things and the row-major pixels of their bounding boxes, (N,) int64 both."""
    indices, pixels = [torch.zeros(0, dtype=torch.long)], [torch.zeros(0, dtype=torch.long)]
    for m in things:
        left, top, right, bottom = boxes[m]
        if right > left and bottom > top:
            pixel = (torch.arange(top, bottom)[:, None] * columns + torch.arange(left, right)).flatten()
            pixels.append(pixel)
            indices.append(torch.full_like(pixel, m))
    return torch.cat(indices), torch.cat(pixels)


def _hits(
    thing: Tensor,
    pixel: Tensor,
    normal: Tensor,
    room: Tensor,
    z: Tensor,
    rays: Tensor,
    steps: Tensor,
    depth: Tensor,
) -> Hit:
    """What is hit of the given things in the given pixels: one ray each inside, four along the outlines.

    Args:
        thing: (N,) int64.
        pixel: (N,) int64.
        normal: (12, 3, M), see :func:`face_planes`.
        room: (12, M).
        z: (M,) m.
        rays: (2, H·W).
        steps: (4, H·W).
        depth: (H·W,) m, Z of what is already there.
    """
    limit, ray, step = depth[pixel] + 0.6, rays[:, pixel], steps[:, pixel]
    planes, space = normal[:, :, thing], room[:, thing]
    margin = 0.6 * step.abs().amax(0) * (z.clamp(min=0)[thing] + 1.0)
    outer_z, face = cast(planes, space, ray, margin)
    near = (outer_z < limit).nonzero()[:, 0]
    thing, pixel, limit, ray, step = thing[near], pixel[near], limit[near], ray[:, near], step[:, near]
    planes, space, margin, first_z, face = (
        planes[:, :, near],
        space[:, near],
        margin[near],
        outer_z[near],
        face[near],
    )
    inner_z, _ = cast(planes, space, ray, -margin)
    share = torch.ones_like(first_z)
    edge = inner_z.isinf().nonzero()[:, 0]
    if len(edge):
        fine = [ray[:, edge] + dx * step[:2, edge] + dy * step[2:, edge] for dx, dy in _SUBPIXELS]
        four = len(_SUBPIXELS)
        fine_z, fine_face = cast(
            planes[:, :, edge].repeat(1, 1, four), space[:, edge].repeat(1, four), torch.cat(fine, 1)
        )
        fine_z, fine_face = fine_z.unflatten(0, (four, -1)), fine_face.unflatten(0, (four, -1))
        seen = fine_z < limit[edge]
        edge_z, nearest = fine_z.masked_fill(~seen, math.inf).min(0)
        share[edge] = seen.float().mean(0)
        first_z[edge], face[edge] = edge_z, fine_face.gather(0, nearest[None])[0]
    keep = (share > 0).nonzero()[:, 0]
    face = face[keep]
    return Hit(thing[keep], pixel[keep], share[keep], first_z[keep], face % 6, face >= 6)


def draw(
    image: Tensor,
    depth: Tensor,
    blocked: Tensor,
    solids: Solids,
    rays: Tensor,
    steps: Tensor,
    lens: Lens,
    height: Tensor,
    light: Light,
    haze: Tensor,
    visibility: Tensor,
) -> None:
    """Paint all things into the image, far to near; changes image, depth and blocked.

    Args:
        image: (1, 3, H, W) linear radiance.
        depth: (1, H, W) m, Z of what is already there.
        blocked: (1, H, W) m, Z of the nearest thing that is not the road.
        solids: the things.
        rays: (1, 2, H, W) right and up per metre forward.
        steps: (1, 4, H, W) change of right and up per pixel to the right, then per pixel down.
        lens: from road directions to pixels.
        height: (1,) m.
        light: the illumination.
        haze: (1, 3) radiance of the air.
        visibility: (1,) m.
    """
    columns = image.shape[3]
    boxes = bounding_boxes(solids, lens, height, (image.shape[2], columns))[0].tolist()
    order = solids.z[0].argsort(descending=True)
    things, pixels = _pixels_in(boxes, order.tolist(), columns)
    if not len(things):
        return
    normal, room = face_planes(solids, height)
    room = room.where(
        (solids.shape[..., 7] > solids.shape[..., 6])[..., None], -1.0
    )  # nobody is inside nothing
    flat_image, flat_depth, flat_blocked = image[0].flatten(1), depth[0].flatten(), blocked[0].flatten()
    normal, room = normal[0].flatten(1, 2).permute(1, 2, 0), room[0].flatten(1).T
    hit = _hits(
        things,
        pixels,
        normal,
        room.contiguous(),
        solids.z[0],
        rays[0].flatten(1),
        steps[0].flatten(1),
        flat_depth,
    )
    whole = hit.share > 0.99  # hides what is behind it
    front = flat_depth.clone().scatter_reduce_(0, hit.pixel[whole], hit.depth[whole], "amin")
    seen = (hit.depth < front[hit.pixel] + 0.6).nonzero()[:, 0]
    hit = Hit(*(t[seen] for t in hit))
    clear = torch.exp(-hit.depth / visibility)[:, None]
    colour = haze * (1 - clear) + shade(solids, hit, rays[0].flatten(1)[:, hit.pixel], height, light) * clear

    # a pixel's hits one after another, far to near: the k-th of every pixel at once
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order)))
    by_pixel = (hit.pixel * len(order) + rank[hit.thing]).argsort()
    pixel = hit.pixel[by_pixel]
    first = (
        torch.cat([torch.ones(1, dtype=torch.bool), pixel[1:] != pixel[:-1]]) if len(pixel) else pixel.bool()
    )
    position = torch.arange(len(pixel))
    layer = position - position.where(first, 0).cummax(0).values
    for k in range(int(layer.max()) + 1 if len(layer) else 0):
        entry = by_pixel[layer == k]
        at, share, z = hit.pixel[entry], hit.share[entry], hit.depth[entry]
        old = flat_image[:, at]
        flat_image[:, at] = old + (colour[entry].T - old) * share
        solid = share > 0.4
        flat_depth[at] = torch.where(solid, z, flat_depth[at])
        flat_blocked[at] = torch.where(solid, torch.minimum(z, flat_blocked[at]), flat_blocked[at])
