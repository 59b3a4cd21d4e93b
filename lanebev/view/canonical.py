"""Resample an image as a fixed virtual camera over the same road would take it."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lanebev.geometry.lens import cam_from_image, check_intrinsics
from lanebev.geometry.precision import cast_floating, common_dtype, full_precision
from lanebev.geometry.rotation import road_from_cam
from lanebev.tensors import constant
from lanebev.types import Extrinsics, check_numbers_known
from lanebev.view.checks import (
    blind_unless_usable,
    check_cameras,
    check_covers,
    check_image,
    check_size,
    doubt_intrinsics,
)
from lanebev.view.lens import make_lens
from lanebev.view.projection import CellSums, normalised_intrinsics, pixel_sums
from lanebev.view.sampling import MapSize, resampled


class CanonicalCells(NamedTuple):
    """Homogeneous coordinates of a virtual camera's pixels in the real one.

    Attributes:
        rays: rays of directions, as if both cameras were at one place.
        down: (B, 1, R) and (B, 1, V), the directions' component towards the road.
        stretch: (B, 3, 1, 1), added for each unit of it: the road is nearer or farther below the real camera.
    """

    rays: CellSums
    down: CellSums
    stretch: Tensor

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, R, V)."""
        return self.rays.shape

    def rows(self, first: int, last: int) -> Tensor:
        """Return those of rows first to last - 1, (B, 3, last - first, V)."""
        down = self.down.rows(first, last).clamp(min=0.0)  # above the horizon, what is seen is far away
        return torch.addcmul(self.rays.rows(first, last), down, self.stretch)


class CanonicalView(nn.Module):
    """Resamples an image or feature map as a fixed virtual camera would see it.

    A network that was trained for one mount then sees that mount. Rotation is exact. A difference in height
    is exact for the road; what stands on the road is moved as if it lay on it. What is above the horizon is
    taken to be far away. The same single resampling removes the lens distortion.

    Args:
        intrinsics: (3, 3) px of the virtual camera.
        image_size: (H, W) px of the virtual image.
        extrinsics: pose of the virtual camera, batch size 1; its height is not used with ``keep_height``.
        keep_height: leave every camera at its own height: a rotation only.
    """

    def __init__(
        self,
        intrinsics: Tensor,
        image_size: tuple[int, int],
        extrinsics: Extrinsics,
        keep_height: bool = False,
    ) -> None:
        super().__init__()
        check_intrinsics(intrinsics)
        check_size(image_size)
        pose = extrinsics.stack().reshape(-1, 4)
        check_numbers_known("intrinsics", intrinsics)
        check_numbers_known("extrinsics", pose)
        if len(pose) != 1:
            raise ValueError(f"extrinsics: expected those of one virtual camera, got {len(pose)}")
        if not keep_height and not float(pose[0, 3]) > 0:
            raise ValueError(f"extrinsics.height: expected more than 0 m, got {float(pose[0, 3]):g}")
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self.keep_height = keep_height
        self._intrinsics = tuple(map(tuple, intrinsics.tolist()))  # no buffers: half() would round them
        self._pose: tuple[float, ...] = tuple(pose[0].tolist())

    def forward(
        self,
        image: Tensor,
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        distortion: Tensor | None = None,
        model: str = "pinhole",
        image_size: tuple[int, int] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Resample an image or a feature map as the virtual camera would see it.

        Args:
            image: (B, C, h, w), an image as it was taken or a feature map that covers it.
            intrinsics: (B, 3, 3) px of the real image.
            extrinsics: extrinsics of the real camera, each (B,).
            distortion: (B, D) of its lens, or None for an undistorted image.
            model: "pinhole", "fisheye" or "omni", the lens of ``distortion``.
            image_size: (H, W) px of the image that the intrinsics belong to; None where that is ``image``.

        Returns:
            (B, C, H, W) of the virtual camera, zero where not valid, and valid (B, 1, H, W) bool.

        Raises:
            TypeError: an argument of another kind.
            ValueError: shapes that don't fit, or an image or intrinsics of whole numbers.
        """
        check_image(image)
        size = image_size or (image.shape[-2], image.shape[-1])
        check_size(size)
        check_covers(image, size)
        check_cameras(image, intrinsics, extrinsics, distortion, model)
        doubt_intrinsics(intrinsics, size)
        intrinsics, extrinsics, distortion = blind_unless_usable(intrinsics, extrinsics, distortion)
        dtype, image_from_cam = common_dtype(image), normalised_intrinsics(intrinsics, size)
        lens = make_lens(image_from_cam, distortion, model, dtype)
        cells = cast_floating(self._cells(image_from_cam if lens is None else None, extrinsics), dtype)
        (view,), valid = resampled([image], cells, lens, [MapSize(image.shape[-2], image.shape[-1])], size)
        return view, valid

    @full_precision
    def _cells(self, image_from_cam: Tensor | None, extrinsics: Extrinsics) -> CanonicalCells:
        """Compute the virtual camera's rays in the real camera.

        A virtual ray d, in the road's frame, meets the road where the real camera sees it, along
        M (d₁, h/h' d₂, d₃) = M d + (h/h' - 1) d₂ m₂, with its matrix M and that one's second column m₂.
        """
        matrix = road_from_cam(extrinsics.pitch, extrinsics.yaw, extrinsics.roll).mT
        if image_from_cam is not None:
            matrix = image_from_cam @ matrix
        pitch, yaw, roll, height = constant((self._pose,), like=matrix).unbind(-1)
        cam_from_pixel = cam_from_image(constant(self._intrinsics, like=matrix))
        road_from_pixel = road_from_cam(pitch, yaw, roll) @ cam_from_pixel  # (1, 3, 3)
        ratio = torch.ones_like(extrinsics.height) if self.keep_height else extrinsics.height / height
        return CanonicalCells(
            pixel_sums(matrix @ road_from_pixel, self.image_size),
            pixel_sums(road_from_pixel[:, 1:2], self.image_size),
            (matrix[..., 1] * (ratio.clamp(min=0.0) - 1).unsqueeze(-1))[..., None, None],
        )
