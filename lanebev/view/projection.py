"""Project homogeneous coordinates of cells to the image, and find the cells that it does not show.

Coordinates are stored as planes (B, 2, R, V), x before y, not as pairs. Cells outside the image are marked by
sums that are zero inside it, since comparisons and ``where`` take several times as long as arithmetic on a
CPU.
"""

from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from lanebev.geometry.precision import full_precision
from lanebev.view.lens import Lens, image_planes

LEAST_DEPTH = 1e-3  # distance in front of the camera, m for cells of the road


class Cells(Protocol):
    """Homogeneous coordinates of R × V cells."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, R, V)."""
        ...

    def rows(self, first: int, last: int) -> Tensor:
        """Return those of rows first to last - 1, (B, 3, last - first, V), a tensor of its own."""
        ...


class CellSums(NamedTuple):
    """Homogeneous coordinates of cells, as sums of a row's and a column's part.

    Attributes:
        by_row: (B, 3, R).
        by_column: (B, 3, V).
        edges: rows between which perspective is smooth, see :func:`lanebev.view.tiles.road_edges`; empty for
            tiles of equal sizes.
    """

    by_row: Tensor
    by_column: Tensor
    edges: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, R, V)."""
        return self.by_row.shape[0], self.by_row.shape[2], self.by_column.shape[2]

    def rows(self, first: int, last: int) -> Tensor:
        """Return those of rows first to last - 1, (B, 3, last - first, V)."""
        return self.by_row[..., first:last].unsqueeze(-1) + self.by_column.unsqueeze(-2)


def pixel_sums(matrix: Tensor, image_size: tuple[int, int]) -> CellSums:
    """Compute the products of matrices (B, 3, 3), or rows (B, 1, 3) of them, with all pixels (x, y, 1)."""
    by_x, by_y, constant = matrix.unsqueeze(-1).unbind(-2)
    y, x = (torch.arange(side, dtype=matrix.dtype, device=matrix.device) for side in image_size)
    return CellSums(by_y * y + constant, by_x * x)


@full_precision
def normalised_intrinsics(intrinsics: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Convert intrinsics to coordinates in which the image, with the edges of its outer pixels, is [-1, 1].

    This is the convention of ``grid_sample(align_corners=False)``: the same for maps of every size. The size
    may be symbolic, as in a program for images of any size, so it is in no constant.

    Args:
        intrinsics: (B, 3, 3) px.
        image_size: (H, W) px.
    """
    height, width = image_size
    x, y, last = intrinsics.unbind(-2)
    across = torch.add(x * (2 / width), last, alpha=1 / width - 1)
    down = torch.add(y * (2 / height), last, alpha=1 / height - 1)
    return torch.stack([across, down, last], dim=-2)


def image_coordinates(cells: Tensor, lens: Lens | None, continued: bool = False) -> tuple[Tensor, Tensor]:
    """Project cells to image coordinates.

    Args:
        cells: (B, 3, R, V) homogeneous coordinates in the image, or with a lens in the camera.
        lens: None for an undistorted image.
        continued: see :func:`lanebev.view.lens.image_planes`.

    Returns:
        (B, 2, R, V) coordinates, finite everywhere, and (B, R, V): zero in front of the camera and where the
        lens does not fold over, else at least 1.
    """
    depth = cells[:, 2]
    ahead = depth.clamp(min=LEAST_DEPTH)
    points = cells[:, :2] / ahead.unsqueeze(1)
    hidden = (ahead - depth).detach().sign()
    if lens is None:
        return points, hidden
    points, beyond = image_planes(points, lens, continued)
    return points, hidden + beyond


def outside_image(points: Tensor, hidden: Tensor | None) -> Tensor:
    """Mark what an image does not show.

    Args:
        points: (B, 2, R, V) normalised coordinates.
        hidden: (B, R, V), zero where seen, else at least 1; None where all are in front of the camera
            and its lens.

    Returns:
        (B, R, V), zero where seen and inside the image, else at least 1; without gradient.
    """
    x, y = (F.hardshrink(each, 1.0) for each in points.detach().unbind(1))  # zero in [-1, 1]
    return torch.addcmul(x * x if hidden is None else torch.addcmul(hidden, x, x), y, y)
