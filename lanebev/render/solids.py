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


def cast(solids: Solids, index: Tensor, height: Tensor, ray: Tensor, margin: Tensor | None = None) -> Hit:
    """Rays against one thing each.

    Args:
        solids: the things, of one image.
        index: (N,) thing of each ray.
        height: (1,) m, camera height.
        ray: (N, 2) right and up per metre forward, so the ray parameter is Z.
        margin: (N,) per metre of distance: how much larger the things are taken to be.
    """
    heading, x, z, ground = (t[0] for t in (solids.heading, solids.x, solids.z, solids.ground))
    sin, cos = heading.sin(), heading.cos()
    origin = torch.stack([z * sin - x * cos, height - ground, -x * sin - z * cos], dim=1)
    sin, cos = sin[index], cos[index]
    ray = torch.stack([ray[:, 0] * cos - sin, ray[:, 1], ray[:, 0] * sin + cos], dim=1)
    shape = solids.shape[0]
    if margin is not None:
        grow = shape.new_tensor([1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        exists = (shape[..., 7] > shape[..., 6])[..., None]
        largest = z.clamp(min=0)[:, None, None] + 1.0
        pixel = margin.max() if len(margin) else 0.0
        shape = shape + grow * (largest * pixel) * exists
    origin, shape = origin[index], shape[index]
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
    seen = solids.valid & (points[..., 2].amax(-1) > 0.5)
    points = torch.cat([points[..., :2], points[..., 2:].clamp(min=0.3)], dim=-1)
    pixels = lens.pixels_as_taken(points.flatten(1, 2), size).unflatten(1, points.shape[1:3])
    limit = pixels.new_tensor([size[1], size[0]])
    low_px = (pixels.amin(2).floor() - 1).clamp(min=0).minimum(limit)
    high_px = (pixels.amax(2).ceil() + 2).clamp(min=0).minimum(limit)
    return torch.cat([low_px, high_px], dim=-1).where(seen[..., None], 0.0).long()


def shade(solids: Solids, index: Tensor, hit: Hit, light: Light) -> Tensor:
    """Linear radiance of hit points, (N, 3)."""
    kind, colour = solids.kind[0, index], solids.colour[0, index]
    heading, shape = solids.heading[0, index], solids.shape[0, index, 0]
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
    rows, columns = image.shape[2:]
    index, pixel = _covered_pixels(solids, lens, height, (rows, columns))
    flat_image, flat_depth, flat_blocked = image[0].flatten(1), depth[0].flatten(), blocked[0].flatten()
    ray = rays[0].flatten(1)[:, pixel].T
    step = steps[0].flatten(1)[:, pixel].T
    behind = flat_depth[pixel] + 0.6

    near = cast(solids, index, height, ray, margin=step.abs().amax(1)).depth < behind
    index, pixel, ray, step, behind = (t[near] for t in (index, pixel, ray, step, behind))
    share = ray.new_zeros(len(index))
    hit = Hit(share + math.inf, index * 0, share > 1, ray.new_zeros(len(index), 3))
    for dx, dy in _SUBPIXELS:
        one = cast(solids, index, height, ray + dx * step[:, :2] + dy * step[:, 2:])
        seen = one.depth < behind
        share = share + seen / len(_SUBPIXELS)
        nearer = seen & (one.depth < hit.depth)
        hit = Hit(*(_where(nearer, new, old) for new, old in zip(one, hit, strict=True)))

    whole = share > 0.99  # hides what is behind it: no need to shade that
    front = flat_depth.clone()
    front.scatter_reduce_(0, pixel[whole], hit.depth[whole], "amin")
    keep = (share > 0) & (hit.depth <= front[pixel] + 0.6)
    index, pixel, share = index[keep], pixel[keep], share[keep]
    hit = Hit(*(t[keep] for t in hit))
    clear = torch.exp(-hit.depth / visibility)[:, None]
    radiance = haze * (1 - clear) + shade(solids, index, hit, light) * clear

    changes = (index.diff() != 0).nonzero()[:, 0] + 1  # entries of one thing are together, far ones first
    bounds = [0, *changes.tolist(), len(index)]
    for begin, end in zip(bounds, bounds[1:], strict=False):
        here, part = pixel[begin:end], share[begin:end]
        old = flat_image[:, here]
        flat_image[:, here] = old + (radiance[begin:end].T - old) * part
        covered = part > 0.4
        solid, z = here[covered], hit.depth[begin:end][covered]
        flat_depth[solid] = z
        flat_blocked[solid] = torch.minimum(flat_blocked[solid], z)


def _where(condition: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(condition[:, None] if new.ndim == 2 else condition, new, old)


def _covered_pixels(
    solids: Solids, lens: Lens, height: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Things, far to near, and the pixels of their bounding boxes: (N,) int64 both."""
    boxes = bounding_boxes(solids, lens, height, size)[0]
    order = solids.z[0].argsort(descending=True)
    indices, pixels = [boxes.new_zeros(0)], [boxes.new_zeros(0)]
    for m, (left, top, right, bottom) in zip(order.tolist(), boxes[order].tolist(), strict=True):
        if right > left and bottom > top:
            ys, xs = torch.arange(top, bottom), torch.arange(left, right)
            pixels.append((ys[:, None] * size[1] + xs).flatten())
            indices.append(torch.full_like(pixels[-1], m))
    return torch.cat(indices), torch.cat(pixels)
