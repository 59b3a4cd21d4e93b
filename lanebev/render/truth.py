"""Ground truth of a rendered image: boundaries in pixels, lanes, boxes."""

import torch
from torch import Tensor

from lanebev.geometry.lens import denormalise_points, distort_points
from lanebev.render.frame import RenderedFrame
from lanebev.render.scene.camera.lens import Lens
from lanebev.render.scene.objects.objects import SceneObjects
from lanebev.render.scene.objects.traffic import NUM_ONCOMING, NUM_VEHICLES
from lanebev.render.scene.road.alignment import Alignment, elevation_at, hidden_by_crest, local_from_road
from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Layout, labelled_slots, presence
from lanebev.render.scene.world import Place, Scene
from lanebev.tensors import constant
from lanebev.types import NUM_BOUNDARIES

NUM_POINTS = 72
FARTHEST = 150.0  # m
_VEHICLES = slice(0, NUM_VEHICLES + NUM_ONCOMING)  # of the objects
_SLACK = 0.3  # m; nearer to a boundary than this does not hide it


def boundary_points(
    layout: Layout, place: Place, alignment: Alignment, lens: Lens, nearest: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the centres of the labelled boundaries in the local road frame.

    Args:
        layout: layout of the road.
        place: of the camera.
        alignment: seen from there.
        lens: the cameras.
        nearest: (B,) m, Z of the first point; spacing is even in 1/Z, about even in image rows.

    Returns:
        (B, L, P, 3) right, down, forward from the camera, m; (B, L, P) 1 where marked; (B, L, P) bool,
        behind a crest.
    """
    slot, exists = labelled_slots(layout, place.ego_lane)
    part = torch.linspace(0, 1, NUM_POINTS, device=nearest.device)
    z_centre = 1 / ((1 - part) / nearest[:, None] + part / FARTHEST)  # (B, P)
    z_centre = z_centre[:, None].expand(-1, NUM_BOUNDARIES, -1).flatten(1)
    across = (layout.across.gather(1, slot) - place.across[:, None]).where(exists, 0.0)
    across = across[..., None].expand(-1, -1, NUM_POINTS).flatten(1)
    x, z, arc = local_from_road(alignment, z_centre, across)
    down = lens.extrinsics.height[:, None] - elevation_at(alignment, z)
    marked = presence(layout, slot.repeat_interleave(NUM_POINTS, 1), arc + place.along[:, None])
    hidden = hidden_by_crest(alignment, lens.extrinsics.height, z)
    shape = (len(x), NUM_BOUNDARIES, NUM_POINTS)
    points = torch.stack([x, down, z], dim=-1).reshape(*shape, 3)
    return points, marked.reshape(shape) * exists[..., None], hidden.reshape(shape)


def project(points: Tensor, lens: Lens, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Project points (B, N, 3) right, down, forward from the camera to pixels.

    Returns:
        (B, N, 2) px undistorted, (B, N, 2) px as taken, (B, N) bool: inside the image.
    """
    camera = lens.in_camera(points)
    depth = camera[..., 2:]
    front = depth[..., 0] > 0.05
    ideal = denormalise_points(camera[..., :2] / depth.clamp(min=0.05), lens.intrinsics)
    limit = constant((size[1], size[0]), ideal)
    near = ((ideal > -0.6 * limit) & (ideal < 1.6 * limit)).all(-1)
    tame = torch.where(near[..., None], ideal, 0.5 * limit)
    taken = distort_points(tame, lens.intrinsics, lens.distortion, lens.model)
    inside = ((taken > -0.5) & (taken < limit - 0.5)).all(-1)
    return ideal.clamp(-1e5, 1e5), taken, front & near & inside


def frame_truth(image: Tensor, blocked: Tensor, scene: Scene, nearest: Tensor) -> RenderedFrame:
    """Return images with their true boundaries, lanes and boxes.

    Args:
        image: (B, 3, H, W).
        blocked: (B, H, W) m, Z of the nearest thing that is not the road.
        scene: B of them.
        nearest: (B,) m, Z of the first boundary point.
    """
    layout, place, alignment, lens = scene.world.layout, scene.place, scene.alignment, scene.lens
    size = (image.shape[2], image.shape[3])
    points, marked, hidden = boundary_points(layout, place, alignment, lens, nearest)
    ideal, taken, inside = project(points.flatten(1, 2), lens, size)
    pixel = taken.round().long()
    flat = pixel[..., 1].clamp(0, size[0] - 1) * size[1] + pixel[..., 0].clamp(0, size[1] - 1)
    clear = blocked.flatten(1).gather(1, flat) > points[..., 2].flatten(1) - _SLACK
    shape = marked.shape
    painted = marked * inside.reshape(shape)
    visible = painted * clear.reshape(shape) * ~hidden
    middle = 0.5 * sum(layout.across.gather(1, (place.ego_lane + i)[:, None])[:, 0] for i in (0, 1))
    curvature = alignment.curvature[:, 0]
    change = (alignment.curvature[:, 1] - curvature) / (alignment.arc[:, 1] - alignment.arc[:, 0])
    return RenderedFrame(
        image=image,
        boundaries=ideal.reshape(*shape, 2),
        painted=painted,
        visible=visible,
        extrinsics=lens.extrinsics,
        intrinsics=lens.intrinsics,
        distortion=lens.distortion,
        lane_width=lane_widths(layout, place.ego_lane),
        offset=place.across - middle,
        curvature=torch.stack([curvature, change], dim=1),
        boxes=vehicle_boxes(scene.objects),
        box_valid=scene.objects.valid[:, _VEHICLES],
    )


def lane_widths(layout: Layout, ego_lane: Tensor) -> Tensor:
    """Return the widths (B, L-1) m between labelled boundaries, beside the road the nominal one."""
    slot = ego_lane[:, None] + torch.arange(NUM_BOUNDARIES - 1, device=ego_lane.device)
    slot = slot - (NUM_BOUNDARIES // 2 - 1)
    here = slot.clamp(0, MAX_BOUNDARIES - 2)
    widths = layout.across.diff(dim=1).gather(1, here)
    real = (slot == here) & layout.exists.gather(1, here + 1)
    return torch.where(real, widths, layout.lane_width[:, None])


def vehicle_boxes(objects: SceneObjects) -> Tensor:
    """Return the outlines (B, V, 5) of vehicles, see :class:`~lanebev.render.frame.RenderedFrame`."""
    body, heading = objects.shape[:, _VEHICLES], objects.heading[:, _VEHICLES]
    rear = torch.minimum(body[..., 0, 2], body[..., 1, 2])
    front = torch.maximum(body[..., 0, 3], body[..., 1, 3])
    shift = 0.5 * (rear + front)  # from the vehicle's origin to the middle of its outline
    x = objects.x[:, _VEHICLES] + shift * heading.sin()
    z = objects.z[:, _VEHICLES] + shift * heading.cos()
    return torch.stack([x, z, front - rear, 2 * body[..., :2].amax((-1, -2)), heading], dim=-1)
