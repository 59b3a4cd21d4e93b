"""Objects on the road as pairs of convex hexahedra: planes, bounds in the image, and rays against them."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.base.select import as_float, choose
from lanebev.render.scene.camera.lens import Lens
from lanebev.render.scene.objects.objects import SceneObjects
from lanebev.tensors import constant

RIGHT, LEFT, FRONT, REAR, TOP, BOTTOM = range(6)  # faces in the object's own frame
NEVER = 1e9  # m
_TINY = 1e-20  # keeps a ray along a plane from dividing by zero


class Hexahedra(NamedTuple):
    """The objects of B scenes, as seen from the camera.

    Attributes:
        box: (B, M, 4) int64, pixel bounds, see :func:`bounding_boxes`.
        normal: (B, M, 2, 6, 3) outward normals, see :func:`face_planes`.
        distance: (B, M, 2, 6) how far the camera lies inside of each plane, in lengths of its normal.
    """

    box: Tensor
    normal: Tensor
    distance: Tensor


def hexahedra(objects: SceneObjects, lens: Lens, size: tuple[int, int]) -> Hexahedra:
    """Compute planes and bounds of all objects.

    Args:
        objects: in the local road frame.
        lens: from road directions to pixels.
        size: image (height, width).
    """
    normal, distance = face_planes(objects, lens.extrinsics.height)
    real = (objects.shape[..., 7] > objects.shape[..., 6])[..., None]
    distance = distance.where(real, -1.0)  # an object that is not real contains no point
    return Hexahedra(bounding_boxes(objects, lens, size), normal, distance)


def face_planes(objects: SceneObjects, height: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the planes of all faces, seen from the camera.

    Args:
        objects: the objects.
        height: (B,) m, of the camera.

    Returns:
        (B, M, 2, 6, 3) outward normals (right, up, forward) in the road frame, not of unit length, and
        (B, M, 2, 6) how far the camera lies inside of each plane, in lengths of its normal.
    """
    wide_low, wide_high, rear_low, front_low, rear_high, front_high, low, high = objects.shape.unbind(-1)
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
    sin, cos = objects.heading.sin()[..., None, None], objects.heading.cos()[..., None, None]
    normal = torch.stack([right * cos + ahead * sin, up, ahead * cos - right * sin], dim=-1)
    away = torch.stack([-objects.x, height[:, None] - objects.ground, -objects.z], dim=-1)
    return normal, reach - (normal * away[:, :, None, None]).sum(-1)


def plane_times(
    normal: Tensor, plane_distance: Tensor, ray_x: Tensor, ray_y: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute where rays pass the planes of hexahedra.

    Args:
        normal: (3, 12, ...) outward normals, right, up, forward, see :func:`face_planes`.
        plane_distance: (12, ...) how far the camera lies inside of each plane, in lengths of its normal.
        ray_x: (...) right per metre forward; all broadcast.
        ray_y: (...) down per metre forward.

    Returns:
        (12, ...) Z, m; and (12, ...) Z that a plane moves away if its distance grows by 1, negative where
        the ray enters.
    """
    speed = normal[0] * ray_x - normal[1] * ray_y + normal[2]  # approach per metre forward
    inverse = (speed + _TINY).reciprocal()
    return plane_distance * inverse, inverse


def entry_depth(time: Tensor, enters: Tensor) -> Tensor:
    """Compute Z at which rays enter pairs of convex hexahedra, (2, ...) m; ``NEVER`` where they do not.

    Args:
        time: (12, ...) Z, m, see :func:`plane_times`.
        enters: (12, ...) 1 where a ray enters its plane's half space, else 0.
    """
    entry = torch.lerp(constant((-NEVER,), time)[0], time, enters).unflatten(0, (2, 6)).amax(1)
    leave = torch.lerp(time, constant((NEVER,), time)[0], enters).unflatten(0, (2, 6)).amin(1)
    return choose((entry < leave) & (entry > 0), entry, NEVER)


def entered_face(time: Tensor, enters: Tensor, depth: Tensor) -> Tensor:
    """Return by which of the 12 planes rays enter at ``depth`` (...), (...) int64; -1 if by none.

    For ``time`` and ``enters`` see :func:`entry_depth`; of several planes it is the last.
    """
    number = torch.arange(1, 13, device=time.device, dtype=time.dtype).view(-1, *[1] * depth.ndim)
    return (as_float(time == depth) * enters * number).amax(0).long() - 1


def bounding_boxes(objects: SceneObjects, lens: Lens, size: tuple[int, int]) -> Tensor:
    """Compute the pixel bounds of every object.

    Args:
        objects: the objects.
        lens: from road directions to pixels.
        size: image (height, width).

    Returns:
        (B, M, 4) int64: left, top, right, bottom, the last two exclusive; empty where unseen.
    """
    shape = objects.shape
    wide = shape[..., :2].amax((-1, -2))
    rear, front = shape[..., 2::2][..., :2].amin((-1, -2)), shape[..., 3::2][..., :2].amax((-1, -2))
    low, high = shape[..., 6].amin(-1), shape[..., 7].amax(-1)
    corners = []
    for sx in (-1, 1):
        for end in (rear, front):
            for level in (low, high):
                sin, cos = objects.heading.sin(), objects.heading.cos()
                x = objects.x + sx * wide * cos + end * sin
                z = objects.z - sx * wide * sin + end * cos
                down = lens.extrinsics.height[:, None] - objects.ground - level
                corners.append(torch.stack([x, down, z], dim=-1))
    points = torch.stack(corners, dim=2)  # (B, M, 8, 3)
    seen = objects.valid & (points[..., 2].amax(-1) > 0.5)
    points = torch.cat([points[..., :2], points[..., 2:].clamp(min=0.3)], dim=-1)
    pixels = lens.pixels_as_taken(points.flatten(1, 2), size).unflatten(1, points.shape[1:3])
    limit = constant((size[1], size[0]), pixels)
    low_px = (pixels.amin(2).floor() - 1).clamp(min=0).minimum(limit)
    high_px = (pixels.amax(2).ceil() + 2).clamp(min=0).minimum(limit)
    return torch.cat([low_px, high_px], dim=-1).where(seen[..., None], 0.0).long()
