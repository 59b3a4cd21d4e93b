"""The derivative of a pose by the focal length that was assumed for it."""

import torch
from torch import Tensor

from lanebev.geometry.lens import cam_from_image
from lanebev.geometry.precision import full_precision
from lanebev.geometry.rotation import road_from_cam
from lanebev.types import Extrinsics

_HALF_WIDTH = 1.85  # m beside the camera at which a lane boundary is evaluated; cancels to first order


@full_precision
def pose_by_log_focal(extrinsics: Extrinsics, intrinsics: Tensor) -> Tensor:
    """Compute the derivative of the pose by the logarithm of the focal length.

    Straight lane boundaries fix four quantities of the image: the vanishing point (two), the slope of the
    horizon, and how fast two boundaries diverge. A wrong focal length f(1 + ε) explains the same four by
    another pose. By the implicit function theorem, with g(pose, log f) these quantities,
    d pose / d log f = -(∂g/∂pose)⁻¹ ∂g/∂(log f). At zero roll it is (-sin θ cos θ, about -sin φ cos φ, 0, 0)
    for pitch θ and yaw φ, up to second order.

    Args:
        extrinsics: each (B,).
        intrinsics: (B, 3, 3) px; both focal lengths change by the same factor, the principal point stays.

    Returns:
        (B, 4) of (pitch, yaw, roll, height), rad, rad, rad, m per unit of log f: times 0.01 it is the change
        of the pose for a focal length that is 1 % longer.
    """
    pose = extrinsics.stack()
    by_pose = torch.func.vmap(torch.func.jacfwd(_image_of_lanes, (0, 2)))
    jacobian, by_focal = by_pose(pose, intrinsics, torch.zeros_like(pose[:, 0]))
    slope: Tensor = -torch.linalg.solve(jacobian, by_focal)
    return slope


def focal_covariance(extrinsics: Extrinsics, intrinsics: Tensor, focal_std: float | Tensor) -> Tensor:
    """Compute what an uncertain focal length contributes to the covariance of a pose, (B, 4, 4).

    It is d dᵀ σ² with d from :func:`pose_by_log_focal`. The error is the same in all frames, so that a filter
    does not average it out.

    Args:
        extrinsics: each (B,).
        intrinsics: (B, 3, 3) px.
        focal_std: standard deviation of the focal length as a share of it, a float or (B,).

    Raises:
        ValueError: a negative or not finite standard deviation, given as a float.
    """
    if isinstance(focal_std, (int, float)) and not 0 <= focal_std <= 1:
        raise ValueError(f"focal_std: expected a share of the focal length such as 0.05, got {focal_std}")
    pose = extrinsics.pitch
    slope = pose_by_log_focal(extrinsics, intrinsics.to(pose)).to(pose)
    share = torch.as_tensor(focal_std, dtype=pose.dtype, device=pose.device)
    change = slope * share.reshape(-1, 1)  # (B, 4)
    return change.unsqueeze(-1) * change.unsqueeze(-2)


def _image_of_lanes(pose: Tensor, intrinsics: Tensor, log_focal: Tensor) -> Tensor:
    """Return what straight lanes fix of an image, (4,): vanishing point, horizon's slope, divergence."""
    pitch, yaw, roll, height = pose.unbind(-1)
    one, zero = torch.ones_like(log_focal), torch.zeros_like(log_focal)
    longer = torch.stack([log_focal.exp(), log_focal.exp(), one])
    scale = torch.stack([torch.stack([longer[0], longer[0], one]), torch.stack([zero, longer[1], one])])
    matrix = torch.cat([intrinsics[:2] * scale, intrinsics[2:]])
    axes = road_from_cam(pitch, yaw, roll)  # rows: right, down and ahead in camera axes
    right, down, ahead = axes.unbind(0)
    vanishing = matrix @ ahead
    image_lines = cam_from_image(matrix).mT
    horizon = image_lines @ down
    slopes = []
    for side in (-_HALF_WIDTH, _HALF_WIDTH):
        line = image_lines @ torch.linalg.cross(ahead, side * right + height * down)
        slopes.append(-line[1] / line[0])
    point = vanishing[:2] / vanishing[2]
    return torch.stack([*point, horizon[0] / horizon[1], slopes[1] - slopes[0]])
