"""Things that stand on the road: vehicles, poles, signs, bridges, as pairs of convex hexahedra.

Drawn far to near, one thing of every image at a time, over the pixels of its bounding box only, with four
rays to the pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.lens import Lens

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
    """First intersections, (..., N): ray parameter (infinite: none), face, which hexahedron, local point."""

    depth: Tensor
    face: Tensor
    upper: Tensor
    point: Tensor  # (N, 3) right, up, forward in the thing's frame, m


def intersect_hexahedron(origin: Tensor, ray: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    """Rays against hexahedra with sloping sides.

    Args:
        origin: (N, 3) right, up, forward, m, in the hexahedron's frame.
        ray: (N, 3).
        shape: (N, 8), see :class:`Solids`.

    Returns:
        (N,) ray parameter of the entry, infinite where there is none, and (N,) int64 face.
    """
    wide_low, wide_high, rear_low, front_low, rear_high, front_high, low, high = shape.unbind(-1)
    tall = (high - low).clamp(min=1e-3)
    up, climb = origin[:, 1] - low, ray[:, 1]
    side = (wide_low - wide_high) / tall
    front, rear = (front_low - front_high) / tall, (rear_high - rear_low) / tall
    x, z = origin[:, 0], origin[:, 2]
    room = torch.stack(  # distance to each plane, m
        [
            wide_low - x - side * up,
            wide_low + x - side * up,
            front_low - z - front * up,
            z - rear_low - rear * up,
            tall - up,
            up,
        ]
    )
    speed = torch.stack(  # approach of each plane per ray parameter
        [
            ray[:, 0] + side * climb,
            -ray[:, 0] + side * climb,
            ray[:, 2] + front * climb,
            -ray[:, 2] + rear * climb,
            climb,
            -climb,
        ]
    )
    speed = torch.where(speed.abs() < 1e-9, 1e-9, speed)
    time = room / speed
    entry, face = torch.where(speed < 0, time, -math.inf).max(0)
    leave = torch.where(speed > 0, time, math.inf).amin(0)
    hit = (entry < leave) & (entry > 0) & (high > low)
    return torch.where(hit, entry, math.inf), face


def _local(values: Tensor, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    sin, cos = values.sin(), values.cos()
    return x * cos - z * sin, x * sin + z * cos


def cast(solids: Solids, row: Tensor, index: Tensor, height: Tensor, ray: Tensor) -> Hit:
    """Rays against one thing each.

    Args:
        solids: the things.
        row: (N,) batch row of each ray.
        index: (N,) thing of each ray.
        height: (N,) m, camera height.
        ray: (N, 3) right, up, forward; forward component 1, so the ray parameter is Z.
    """
    heading = solids.heading[row, index]
    x, z = _local(heading, -solids.x[row, index], -solids.z[row, index])
    origin = torch.stack([x, height - solids.ground[row, index], z], dim=1)
    ray_x, ray_z = _local(heading, ray[:, 0], ray[:, 2])
    ray = torch.stack([ray_x, ray[:, 1], ray_z], dim=1)
    shape = solids.shape[row, index]
    lower, lower_face = intersect_hexahedron(origin, ray, shape[:, 0])
    upper, upper_face = intersect_hexahedron(origin, ray, shape[:, 1])
    is_upper = upper < lower
    depth = torch.minimum(lower, upper)
    point = origin + torch.where(depth.isfinite(), depth, 0.0)[:, None] * ray
    return Hit(depth, torch.where(is_upper, upper_face, lower_face), is_upper, point)


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
    z_near = points[..., 2].amin(-1)
    seen = solids.valid & (points[..., 2].amax(-1) > 0.5)
    points = torch.cat([points[..., :2], points[..., 2:].clamp(min=0.3)], dim=-1)
    pixels = lens.pixels_as_taken(points.flatten(1, 2), size).unflatten(1, points.shape[1:3])
    limit = pixels.new_tensor([size[1], size[0]])
    low_px = (pixels.amin(2).floor() - 1).clamp(min=0).minimum(limit)
    high_px = (pixels.amax(2).ceil() + 2).clamp(min=0).minimum(limit)
    beside = (z_near < 0.5)[..., None]  # passing the camera plane: bounds by projection are unsafe
    low_px = torch.where(beside, 0.0, low_px)
    high_px = torch.where(beside, limit.expand_as(high_px), high_px)
    return torch.cat([low_px, high_px], dim=-1).where(seen[..., None], 0.0).long()


def shade(solids: Solids, row: Tensor, index: Tensor, hit: Hit, light: Light) -> Tensor:
    """Linear radiance of hit points, (N, 3)."""
    kind, colour = solids.kind[row, index], solids.colour[row, index]
    heading, shape = solids.heading[row, index], solids.shape[row, index, 0]
    x, up, z = hit.point.unbind(-1)
    half_width, low, high = shape[:, 0], shape[:, 6], shape[:, 7]
    rear, front = shape[:, 2], shape[:, 3]
    vehicle, truck = kind <= TRUCK, kind == TRUCK
    end = (hit.face == REAR) | (hit.face == FRONT)
    side = (hit.face == RIGHT) | (hit.face == LEFT)
    level = (up - low) / (high - low).clamp(min=1e-3)
    aside = (x / half_width).abs()

    surface = colour.clone()
    glass = vehicle & hit.upper & (hit.face < TOP)
    span = solids.shape[row, index, 1]
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
    lamp = ((car_end & (level > 0.68) & (level < 0.9)) | (truck & end & (up > 1.0) & (up < 1.15))) & (
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
    sun = light.sun[row]
    facing = (normal_x * cos + normal_z * sin) * sun[:, 0] + normal_up * sun[:, 1]
    facing = (facing + (normal_z * cos - normal_x * sin) * sun[:, 2]).clamp(0, 1)
    open_sky = (0.55 + 0.45 * normal_up).clamp(0.12, 1.0) * torch.where(vehicle & (up < 0.5), 0.6, 1.0)
    lit = light.direct[row] * facing[:, None] + light.ambient[row] * open_sky[:, None]
    distance = hit.depth.clamp(1.0, 1e4)
    beam = light.headlight[row] * 60 / (distance * distance + 60) * (hit.face == REAR)
    lit = lit + beam[:, None] * lit.new_tensor([1.0, 0.95, 0.85])
    gloss = (vehicle & ~truck & ~below).float() * (0.04 + 0.10 * (normal_up > 0.5))
    radiance = surface * lit + gloss[:, None] * light.ambient[row] * 1.2
    tail = red & (solids.braking[row, index] | (light.night[row] > 0.4))
    glow = (0.35 + 0.5 * solids.braking[row, index].float()) * tail
    oncoming = lamp & (hit.face == FRONT) & (light.night[row] > 0.4)
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
        image: (B, 3, H, W) linear radiance.
        depth: (B, H, W) m, Z of what is already there.
        blocked: (B, H, W) m, Z of the nearest thing that is not the road.
        solids: the things.
        rays: (B, 2, H, W) right and up per metre forward.
        steps: (B, 4, H, W) change of right and up per pixel to the right, then per pixel down.
        lens: from road directions to pixels.
        height: (B,) m.
        light: the illumination.
        haze: (B, 3) radiance of the air.
        visibility: (B,) m.
    """
    batch, _, rows, columns = image.shape
    boxes = bounding_boxes(solids, lens, height, (rows, columns))
    order = solids.z.where(solids.valid, math.inf).argsort(1, descending=True)
    flat_image, flat_depth, flat_blocked = image.flatten(2), depth.flatten(1), blocked.flatten(1)
    for rank in range(solids.z.shape[1]):
        row_list, index_list, pixel_list = [], [], []
        for b in range(batch):
            m = int(order[b, rank])
            left, top, right, bottom = boxes[b, m].tolist()
            if right <= left or bottom <= top:
                continue
            ys, xs = torch.arange(top, bottom), torch.arange(left, right)
            pixels = (ys[:, None] * columns + xs).flatten()
            pixel_list.append(pixels)
            row_list.append(torch.full_like(pixels, b))
            index_list.append(torch.full_like(pixels, m))
        if not pixel_list:
            continue
        row, index, pixel = torch.cat(row_list), torch.cat(index_list), torch.cat(pixel_list)
        ray, step = rays.flatten(2)[row, :, pixel], steps.flatten(2)[row, :, pixel]
        behind = flat_depth[row, pixel]
        total, share, nearest = ray.new_zeros(len(row), 3), ray.new_zeros(len(row)), behind
        for dx, dy in _SUBPIXELS:
            direction = ray + dx * step[:, :2] + dy * step[:, 2:]
            direction = torch.cat([direction, torch.ones_like(direction[:, :1])], dim=1)
            hit = cast(solids, row, index, height[row], direction)
            seen = (hit.depth < behind + 0.6).nonzero()[:, 0]
            if not len(seen):
                continue
            part = Hit(*(t[seen] for t in hit))
            radiance = shade(solids, row[seen], index[seen], part, light)
            clear = torch.exp(-part.depth / visibility[row[seen]])[:, None]
            radiance = haze[row[seen]] * (1 - clear) + radiance * clear
            total[seen] += radiance / len(_SUBPIXELS)
            share[seen] += 1 / len(_SUBPIXELS)
            nearest = nearest.index_put((seen,), torch.minimum(nearest[seen], part.depth))
        old = flat_image[row, :, pixel]
        flat_image[row, :, pixel] = old * (1 - share)[:, None] + total
        covered = share > 0.4
        flat_depth[row, pixel] = torch.where(covered, nearest, behind)
        near = flat_blocked[row, pixel]
        flat_blocked[row, pixel] = torch.where(covered, torch.minimum(near, nearest), near)
