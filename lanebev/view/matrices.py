"""Matrices of the current pose in the forms that detection heads take: BEVFormer, Lift-Splat-Shoot, BEVDet.

Those heads know a vehicle ("ego", "LiDAR") frame: x forward, y left, z up. Here its origin is the point
of the road below the camera, and x is the direction of the lanes; a matrix for another origin or
direction, such as that of a LiDAR, takes the place of :func:`ego_from_road`.

- BEVFormer, DETR3D, PETR, Sparse4D take ``img_metas["lidar2img"]``, 4 × 4, which makes (u d, v d, d, 1)
  of an ego point: :func:`image_from_ego`.
- Lift-Splat-Shoot takes ``rots`` and ``trans`` (ego from camera), ``intrins``, and ``post_rots`` and
  ``post_trans`` of the resized and cropped image: :func:`lift_splat_inputs`.
- BEVDet and BEVDepth take ``sensor2ego``, 4 × 4: :func:`ego_from_camera`; and the last three as above.

With a fixed mount these are constants of the data set; here they change from frame to frame with the
pose. All are differentiable in it.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.geometry.lens import check_intrinsics
from lanebev.torch_internals import register_pytree
from lanebev.types import Extrinsics, check_extrinsics, check_tensor


def ego_from_road(dtype: torch.dtype = torch.float32, device: torch.device | str | None = None) -> Tensor:
    """Return the rotation, (4, 4), from road (right, down, forward) to ego (forward, left, up)."""
    rows = [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=dtype, device=device)


def ego_from_camera(extrinsics: Extrinsics, ego_from_road_matrix: Tensor | None = None) -> Tensor:
    """Compute the camera's pose in the ego frame, ``sensor2ego`` of BEVDet.

    Args:
        extrinsics: each (B,).
        ego_from_road_matrix: (4, 4) or (B, 4, 4); None is :func:`ego_from_road`. Where the ego frame is
            turned, scaled or mirrored to augment the data, ``augmentation @ ego_from_road()``.

    Returns:
        (B, 4, 4).
    """
    return _ego_from_road(extrinsics, ego_from_road_matrix) @ extrinsics.road_from_camera()


def image_from_ego(
    extrinsics: Extrinsics,
    intrinsics: Tensor,
    ego_from_road_matrix: Tensor | None = None,
    image_transform: Tensor | None = None,
) -> Tensor:
    """Compute the projection of ego points to pixels, ``lidar2img`` of mmdetection3d's heads.

    Args:
        extrinsics: each (B,).
        intrinsics: (B, 3, 3) px of the undistorted image.
        ego_from_road_matrix: (4, 4) or (B, 4, 4), as of :func:`ego_from_camera`.
        image_transform: (3, 3) or (B, 3, 3), pixels of that image to pixels of the resized, cropped or
            flipped one that the network is given.

    Returns:
        (B, 4, 4); its first three rows are the 3 × 4 projection, the last is (0, 0, 0, 1).

    Raises:
        TypeError: an argument of another kind.
        ValueError: intrinsics of another batch, or matrices of another size.
    """
    _check_cameras(extrinsics, intrinsics, image_transform)
    camera_from_road = extrinsics.camera_from_road()
    road_from_ego = torch.linalg.inv(_ego_from_road(extrinsics, ego_from_road_matrix))
    image = intrinsics if image_transform is None else image_transform.to(intrinsics) @ intrinsics
    upper = image.to(camera_from_road) @ (camera_from_road @ road_from_ego)[..., :3, :]
    last = torch.zeros_like(upper[..., :1, :])
    return torch.cat([upper, last + last.new_tensor([0.0, 0.0, 0.0, 1.0])], dim=-2)


@register_pytree
class LiftSplatInputs(NamedTuple):
    """Arguments of Lift-Splat-Shoot's ``get_geometry`` for a camera.

    Attributes:
        rots: (B, 3, 3), ego from camera.
        trans: (B, 3) m, the camera in the ego frame.
        intrins: (B, 3, 3) px.
        post_rots: (B, 3, 3), the image's resizing, flipping and turning.
        post_trans: (B, 3) px, its shift.

    All have the dtype of the pose, since heads multiply them.
    """

    rots: Tensor
    trans: Tensor
    intrins: Tensor
    post_rots: Tensor
    post_trans: Tensor


def lift_splat_inputs(
    extrinsics: Extrinsics,
    intrinsics: Tensor,
    ego_from_road_matrix: Tensor | None = None,
    image_transform: Tensor | None = None,
) -> LiftSplatInputs:
    """Compute what Lift-Splat-Shoot takes; arguments as of :func:`image_from_ego`.

    Its points are rots · intrins⁻¹ · (u d, v d, d) + trans with (u, v, 1) = post_rots⁻¹ ((u', v', 1) -
    post_trans), (u', v') pixels of the image that the network is given.
    """
    _check_cameras(extrinsics, intrinsics, image_transform)
    pose = ego_from_camera(extrinsics, ego_from_road_matrix)
    intrinsics = intrinsics.to(pose)
    eye = torch.eye(3, dtype=intrinsics.dtype, device=intrinsics.device).expand_as(intrinsics)
    transform = eye if image_transform is None else image_transform.to(intrinsics).expand_as(intrinsics)
    affine = torch.cat([transform[..., :2], eye[..., 2:]], dim=-1)
    return LiftSplatInputs(
        pose[..., :3, :3], pose[..., :3, 3], intrinsics, affine, transform[..., 2] - eye[..., 2]
    )


def _ego_from_road(extrinsics: Extrinsics, matrix: Tensor | None) -> Tensor:
    check_extrinsics(extrinsics)
    pitch = extrinsics.pitch
    if matrix is None:
        return ego_from_road(pitch.dtype, pitch.device)
    _check_matrix("ego_from_road_matrix", matrix, 4, pitch)
    return matrix.to(pitch)


def _check_cameras(extrinsics: Extrinsics, intrinsics: Tensor, image_transform: Tensor | None) -> None:
    """Raise unless these are poses, as many cameras, and one matrix of pixels or as many, or None."""
    check_extrinsics(extrinsics)
    check_intrinsics(intrinsics, *extrinsics.pitch.shape)
    if image_transform is not None:
        _check_matrix("image_transform", image_transform, 3, extrinsics.pitch)


def _check_matrix(name: str, matrix: Tensor, size: int, rows: Tensor) -> None:
    """Raise unless this is (size, size), or one for each of ``rows`` (B,)."""
    check_tensor(name, matrix)
    expected = ((size, size), (*rows.shape, size, size))
    if matrix.shape not in expected:
        raise ValueError(f"{name}: expected {expected[0]} or {expected[1]}, got {tuple(matrix.shape)}")
