"""Great circles, the road plane, and points between image and road, with their covariance."""

from collections.abc import Callable

import torch
from torch import Tensor

from lanebev.geometry.lens import cam_from_image, check_points, normalise_points
from lanebev.geometry.precision import full_precision
from lanebev.geometry.road_profile import (
    check_vertical_curvature,
    depth_below,
    in_sight,
    meet_road,
    meets_before_farthest,
    road_profile,
)
from lanebev.geometry.rotation import road_from_cam
from lanebev.types import Extrinsics, check_extrinsics


def rays_from_pixels(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Convert undistorted pixels to camera rays, K⁻¹ p.

    Args:
        points: (..., N, 2) px.
        intrinsics: (..., 3, 3).

    Returns:
        (..., N, 3), z = 1.
    """
    plane = normalise_points(points, intrinsics)
    return torch.cat([plane, torch.ones_like(plane[..., :1])], dim=-1)


def segment_rays(endpoints: Tensor, intrinsics: Tensor) -> Tensor:
    """Compute the camera rays to both ends of segments, K⁻¹ p₁ and K⁻¹ p₂.

    Args:
        endpoints: (..., N, 2, 2) px, undistorted.
        intrinsics: (..., 3, 3).

    Returns:
        (..., N, 2, 3), z = 1.
    """
    rays: Tensor = rays_from_pixels(endpoints.flatten(-3, -2), intrinsics).unflatten(-2, (-1, 2))
    return rays


def great_circle_normals(rays: Tensor) -> Tensor:
    """Compute the normals of the planes through the camera and each segment, not normalised.

    Source: Eq. (3), n = (K⁻¹ p₁) × (K⁻¹ p₂). Left unnormalised because |n| grows with the segment's
    length, and with it the segment's weight (paper.md D9).

    Args:
        rays: (..., N, 2, 3), see :func:`segment_rays`.

    Returns:
        (..., N, 3).
    """
    normals: Tensor = torch.linalg.cross(rays[..., 0, :], rays[..., 1, :])
    return normals


@full_precision
def road_from_image_points(
    points: Tensor, intrinsics: Tensor, extrinsics: Extrinsics, vertical_curvature: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Project undistorted pixels to the road.

    Args:
        points: (B, N, 2) px.
        intrinsics: (B, 3, 3).
        extrinsics: each (B,).
        vertical_curvature: (B,) 1/m of the road, positive over a crest, see (J1); None for a plane.

    Returns:
        (B, N, 2) m, (X right, Z along the lanes), and (B, N) bool, false above the horizon or behind; of a
        road with a vertical curvature also beyond 200 m, and beyond 0.8 of the distance at which a crest
        begins to hide it.
    """
    check_points(points)
    rays = rays_from_pixels(points, intrinsics) @ _road_from_cam(extrinsics).mT  # (B, N, 3)
    if vertical_curvature is not None:
        return _on_curved_road(rays.mT, extrinsics.height, vertical_curvature)
    x, down, z = rays.unbind(-1)
    valid = down > 1e-6
    scale = extrinsics.height.unsqueeze(-1) / torch.where(valid, down, 1.0)
    return torch.stack([x * scale, z * scale], dim=-1), valid & (scale > 0)


def _on_curved_road(directions: Tensor, height: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor]:
    """Project directions (B, 3, N) in the road's axes to a road with a vertical curvature."""
    check_vertical_curvature(curvature, len(height))
    above = height.unsqueeze(-1) > 0
    profile = road_profile(torch.where(above, height.unsqueeze(-1), 1.0), curvature.unsqueeze(-1))
    valid = meets_before_farthest(directions, profile) & above
    x, _, ahead = directions.unbind(1)
    z = meet_road(directions, profile)
    return torch.stack([x / torch.where(valid, ahead, 1.0) * z, z], dim=-1), valid


@full_precision
def image_from_road_points(
    points: Tensor, intrinsics: Tensor, extrinsics: Extrinsics, vertical_curvature: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Project road points to undistorted pixels.

    Args:
        points: (B, N, 2) m, (X right, Z along the lanes).
        intrinsics: (B, 3, 3).
        extrinsics: each (B,).
        vertical_curvature: (B,) 1/m of the road, positive over a crest, see (J1); None for a plane.

    Returns:
        (B, N, 2) px, and (B, N) bool, false behind the camera, beyond 0.8 of the distance at which a crest
        begins to hide the road, and for a camera that is not above the road.
    """
    check_points(points)
    rotation = _road_from_cam(extrinsics)
    x, z = points.unbind(-1)
    below = extrinsics.height.unsqueeze(-1)
    valid = below > 0
    if vertical_curvature is not None:
        check_vertical_curvature(vertical_curvature, len(below))
        curvature = vertical_curvature.unsqueeze(-1)
        valid = valid & in_sight(below, curvature, z)
        below = depth_below(below, curvature, z)
    road = torch.stack([x, below.expand_as(x), z], dim=-1)
    pixels = road @ rotation @ intrinsics.mT  # rows: (K R_cam_from_road p)ᵀ
    depth = pixels[..., 2]
    valid = valid & (depth > 1e-3)
    return pixels[..., :2] / torch.where(valid, depth, 1.0).unsqueeze(-1), valid


@full_precision
def road_covariance(
    points: Tensor,
    intrinsics: Tensor,
    extrinsics: Extrinsics,
    pixel_cov: Tensor | None = None,
    extrinsics_cov: Tensor | None = None,
) -> Tensor:
    """Compute the first-order covariance of road points from that of their pixels and of the pose.

    Args:
        points: (B, N, 2) px.
        intrinsics: (B, 3, 3).
        extrinsics: each (B,).
        pixel_cov: (B, N, 2, 2) px², or None for exact pixels.
        extrinsics_cov: (B, 4, 4) of (pitch, yaw, roll, height), or None for an exact pose.

    Returns:
        (B, N, 2, 2) m² of (X, Z). Where the pixel is not on the road, above the horizon or behind, variances
        are infinite and covariances zero.
    """
    return _propagated(road_from_image_points, points, intrinsics, extrinsics, pixel_cov, extrinsics_cov)


@full_precision
def image_covariance(
    points: Tensor,
    intrinsics: Tensor,
    extrinsics: Extrinsics,
    road_cov: Tensor | None = None,
    extrinsics_cov: Tensor | None = None,
) -> Tensor:
    """Compute the first-order covariance of pixels from that of their road points and of the pose.

    Args:
        points: (B, N, 2) m, (X right, Z along the lanes).
        intrinsics: (B, 3, 3).
        extrinsics: each (B,).
        road_cov: (B, N, 2, 2) m² of (X, Z), or None for exact points.
        extrinsics_cov: (B, 4, 4) of (pitch, yaw, roll, height), or None for an exact pose.

    Returns:
        (B, N, 2, 2) px² of (x, y). Behind the camera, variances are infinite and covariances zero.
    """
    return _propagated(image_from_road_points, points, intrinsics, extrinsics, road_cov, extrinsics_cov)


def _propagated(
    project: Callable[[Tensor, Tensor, Extrinsics], tuple[Tensor, Tensor]],
    points: Tensor,
    intrinsics: Tensor,
    extrinsics: Extrinsics,
    points_cov: Tensor | None,
    extrinsics_cov: Tensor | None,
) -> Tensor:
    """Compute the covariance (B, N, 2, 2) of projected points; infinite where they are not valid."""

    def projected(point: Tensor, pose: Tensor, matrix: Tensor) -> Tensor:
        pose_1 = Extrinsics.unstack(pose.unsqueeze(0))
        return project(point[None, None], matrix.unsqueeze(0), pose_1)[0][0, 0]

    jacobians = torch.func.jacfwd(projected, argnums=(0, 1))
    over_points = torch.func.vmap(jacobians, in_dims=(0, None, None))
    by_point, by_pose = torch.func.vmap(over_points)(points, extrinsics.stack(), intrinsics)
    cov = points.new_zeros(*points.shape, 2)
    if points_cov is not None:
        cov = cov + by_point @ points_cov @ by_point.mT
    if extrinsics_cov is not None:
        cov = cov + by_pose @ extrinsics_cov.unsqueeze(1) @ by_pose.mT
    _, valid = project(points, intrinsics, extrinsics)
    return torch.where(valid[..., None, None], cov, cov.new_full((2,), torch.inf).diag())


def _road_from_cam(extrinsics: Extrinsics) -> Tensor:
    check_extrinsics(extrinsics)
    return road_from_cam(extrinsics.pitch, extrinsics.yaw, extrinsics.roll)


def lane_width_covariance(height: Tensor, relative_std: float | Tensor) -> Tensor:
    """Compute what an uncertain lane width contributes to the covariance of a pose, (B, 4, 4).

    Source: (J25) of docs/method/joint.md. From lane boundaries the height is known in lane widths only: a
    share of the width is that of the height.

    Args:
        height: (B,) m.
        relative_std: standard deviation of the lane width as a share of it, a float or (B,).
    """
    change = torch.nn.functional.pad((height * relative_std).unsqueeze(-1), (3, 0))  # (B, 4)
    return change.unsqueeze(-1) * change.unsqueeze(-2)


@full_precision
def horizon_line(extrinsics: Extrinsics, intrinsics: Tensor) -> Tensor:
    """Compute the image line of the road's horizon.

    Args:
        extrinsics: each (B,).
        intrinsics: (B, 3, 3).

    Returns:
        (B, 3) homogeneous line: a x + b y + c = 0, with (a, b) of unit length and positive on the road.
    """
    down = _road_from_cam(extrinsics)[..., 1, :]
    line = (down.unsqueeze(-2) @ cam_from_image(intrinsics)).squeeze(-2)
    unit: Tensor = line / line[..., :2].norm(dim=-1, keepdim=True)
    return unit
