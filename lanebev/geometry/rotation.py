"""Angles to matrices and back. The only file that defines the signs of angles.

Frames: camera x right, y down, z forward (OpenCV); road X right, Y down, Z along the lanes.
Matrices are named ``dst_from_src`` and act on column vectors.
"""

import torch
from kornia.geometry import rotation_matrix_to_axis_angle
from torch import Tensor

from lanebev.geometry.precision import full_precision
from lanebev.tensors import constant

_FACTORS = (  # of cosine, of sine and of neither: R(θ), R(φ), R(ψ)
    (
        ((0, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((1, 0, 0), (0, 0, 0), (0, 0, 1)),
        ((1, 0, 0), (0, 1, 0), (0, 0, 0)),
    ),
    (
        ((0, 0, 0), (0, 0, -1), (0, 1, 0)),
        ((0, 0, 1), (0, 0, 0), (-1, 0, 0)),
        ((0, 1, 0), (-1, 0, 0), (0, 0, 0)),
    ),
    (
        ((1, 0, 0), (0, 0, 0), (0, 0, 0)),
        ((0, 0, 0), (0, 1, 0), (0, 0, 0)),
        ((0, 0, 0), (0, 0, 0), (0, 0, 1)),
    ),
)


def _rotation(rows: list[list[Tensor]]) -> Tensor:
    entries = torch.stack([entry for row in rows for entry in row], dim=-1)
    matrix: Tensor = entries.unflatten(-1, (3, 3))
    return matrix


def rotation_x(pitch: Tensor) -> Tensor:
    """Return R(θ), (..., 3, 3): the first factor of Eq. (6)."""
    s, c = pitch.sin(), pitch.cos()
    zero, one = torch.zeros_like(s), torch.ones_like(s)
    return _rotation([[one, zero, zero], [zero, c, -s], [zero, s, c]])


def rotation_y(yaw: Tensor) -> Tensor:
    """Return R(φ), (..., 3, 3): the second factor of Eq. (6)."""
    s, c = yaw.sin(), yaw.cos()
    zero, one = torch.zeros_like(s), torch.ones_like(s)
    return _rotation([[c, zero, s], [zero, one, zero], [-s, zero, c]])


@full_precision
def cam_from_world(pitch: Tensor, yaw: Tensor) -> Tensor:
    """Compute the rotation from the lane-aligned frame without roll to the camera.

    Source: Eq. (6), R_CW(θ, φ) = R(θ) R(φ).

    Args:
        pitch: (...,) rad, positive nose down.
        yaw: (...,) rad, positive when the camera points left of the lanes.

    Returns:
        (..., 3, 3) rotation.
    """
    return rotation_x(pitch) @ rotation_y(yaw)


@full_precision
def road_from_cam(pitch: Tensor, yaw: Tensor, roll: Tensor) -> Tensor:
    """Compute the rotation from the camera to the road.

    Source: Eq. (24), R(θ, φ, ψ) = R(ψ) R_CW(θ, φ)ᵀ.

    Args:
        pitch: (...,) rad, positive nose down.
        yaw: (...,) rad, positive left of the lanes.
        roll: (...,) rad, positive counter-clockwise seen from behind.

    Returns:
        (..., 3, 3) rotation.
    """
    return road_from_cam_and_roll(torch.stack([pitch, yaw, roll], dim=-1))[0]


def road_from_cam_and_roll(angles: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the rotation of :func:`road_from_cam` from (..., 3) pitch, yaw and roll, and its factor R(ψ).

    Autocast is off already.
    Each factor is linear in cosine and sine of its angle, so that all three are computed at once.
    """
    of_cos, of_sin, rest = constant(_FACTORS, like=angles)  # each (3, 3, 3)
    cos, sin = angles.cos()[..., None, None], angles.sin()[..., None, None]
    by_pitch, by_yaw, by_roll = torch.addcmul(torch.addcmul(rest, cos, of_cos), sin, of_sin).unbind(-3)
    return by_roll @ (by_pitch @ by_yaw).mT, by_roll


@full_precision
def angles_from_matrix(road_from_cam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute pitch, yaw and roll from a rotation, the inverse of :func:`road_from_cam`.

    Args:
        road_from_cam: (..., 3, 3) rotation whose third row, the lanes' direction, has z > 0.

    Returns:
        pitch, yaw, roll: (...,) rad; pitch and yaw in (-pi/2, pi/2), roll in (-pi, pi].
    """
    pitch, yaw, roll = pitch_yaw_roll(road_from_cam).unbind(-1)
    return pitch, yaw, roll


def pitch_yaw_roll(road_from_cam: Tensor) -> Tensor:
    """Compute the angles of :func:`angles_from_matrix` as (..., 3), autocast being off already."""
    pitch, yaw = pitch_yaw_from_vanishing_dir(road_from_cam[..., 2, :])
    road_from_world = road_from_cam @ rotation_x(pitch) @ rotation_y(yaw)
    roll = torch.atan2(road_from_world[..., 0, 1], road_from_world[..., 0, 0])
    return torch.stack([pitch, yaw, roll], dim=-1)


def vanishing_dir_from_pitch_yaw(pitch: Tensor, yaw: Tensor) -> Tensor:
    """Compute the direction of the lanes in the camera frame.

    Source: Eq. (5), v = R_CW(θ, φ) [0, 0, 1]ᵀ.

    Args:
        pitch: (...,) rad.
        yaw: (...,) rad.

    Returns:
        (..., 3) unit vector (sin φ, -sin θ cos φ, cos θ cos φ).
    """
    return torch.stack([yaw.sin(), -pitch.sin() * yaw.cos(), pitch.cos() * yaw.cos()], dim=-1)


def pitch_yaw_from_vanishing_dir(vanishing_dir: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the camera pitch and yaw that explain a vanishing direction.

    Source: Eqs. (7)-(8). Deviation: yaw divides by hypot(y, z), since atan2(x, z) is tan(yaw) /
    cos(pitch), exact only at zero pitch (0.02 deg off at 5 deg pitch and yaw).

    Args:
        vanishing_dir: (..., 3) camera-frame ray, any positive length, z > 0.

    Returns:
        pitch, yaw: (...,) rad, in (-pi/2, pi/2). Differentiable everywhere in the domain.

    Raises:
        ValueError: last dimension is not 3.
    """
    if vanishing_dir.shape[-1] != 3:
        raise ValueError(f"vanishing_dir: expected (..., 3), got {tuple(vanishing_dir.shape)}")
    x, y, z = vanishing_dir.unbind(-1)
    return torch.atan2(-y, z), torch.atan2(x, (y * y + z * z).sqrt())


@full_precision
def camera_from_road_matrix(pitch: Tensor, yaw: Tensor, roll: Tensor, height: Tensor) -> Tensor:
    """Compute the rigid transform from the road's frame to the camera's.

    The origin of the road's frame is the point of the road below the camera, so that
    p_camera = R(θ, φ, ψ)ᵀ (p_road + (0, h, 0)), with R of Eq. (24).

    Args:
        pitch: (...,) rad.
        yaw: (...,) rad.
        roll: (...,) rad.
        height: (...,) m.

    Returns:
        (..., 4, 4), for column vectors (X, Y, Z, 1) in m.
    """
    rotation = road_from_cam(pitch, yaw, roll).mT
    return _rigid(rotation, rotation[..., 1] * height.unsqueeze(-1))


@full_precision
def road_from_camera_matrix(pitch: Tensor, yaw: Tensor, roll: Tensor, height: Tensor) -> Tensor:
    """Compute the inverse of :func:`camera_from_road_matrix`: p_road = R p_camera - (0, h, 0)."""
    zero = torch.zeros_like(height)
    return _rigid(road_from_cam(pitch, yaw, roll), torch.stack([zero, -height, zero], dim=-1))


@full_precision
def rotation_vector(rotation: Tensor) -> Tensor:
    """Compute the rotation vector, axis times angle, of rotations of less than half a turn.

    Source: Rodrigues' formula; by the unit quaternion, which is well conditioned at small angles.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 3) rad, as ``cv2.Rodrigues``.
    """
    vector: Tensor = rotation_matrix_to_axis_angle(rotation)
    return vector


def _rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return the matrix (..., 4, 4) of a rotation (..., 3, 3) and a translation (..., 3)."""
    upper = torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)
    last = torch.zeros_like(upper[..., :1, :])
    return torch.cat([upper, last + last.new_tensor([0.0, 0.0, 0.0, 1.0])], dim=-2)
