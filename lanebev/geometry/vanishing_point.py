"""The vanishing point of the lanes in the image as taken."""

from torch import Tensor

from lanebev.geometry.lens import denormalise_points, distort_points
from lanebev.geometry.precision import full_precision
from lanebev.geometry.rotation import vanishing_dir_from_pitch_yaw


@full_precision
def vanishing_point(
    pitch: Tensor, yaw: Tensor, intrinsics: Tensor, distortion: Tensor | None = None, model: str = "pinhole"
) -> Tensor:
    """Compute the pixel of the direction in which the lanes below the camera point.

    Source: Eq. (5), and the lens.

    Args:
        pitch: (B,) rad.
        yaw: (B,) rad.
        intrinsics: (B, 3, 3) px.
        distortion: (B, D) of the lens, or None.
        model: "pinhole", "fisheye" or "omni".

    Returns:
        (B, 2) px, (x, y) of the image as taken.
    """
    direction = vanishing_dir_from_pitch_yaw(pitch, yaw)
    point = denormalise_points((direction[:, :2] / direction[:, 2:])[:, None], intrinsics)
    if distortion is not None:
        point = distort_points(point, intrinsics, distortion, model)
    return point[:, 0]
