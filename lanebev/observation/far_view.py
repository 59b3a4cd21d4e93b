"""A far view: the image about the horizon at a larger scale, beside the whole image at a smaller one."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import masked_median
from lanebev.geometry.precision import full_precision
from lanebev.observation.boundary_vertices import BoundaryVertices, move_to_front
from lanebev.observation.frames import resized_size
from lanebev.observation.polylines import VERTICES_PER_LINE
from lanebev.observation.vertices import order_along, take

_STEP = 32  # px, of which the sides of a network's input are multiples
_EDGE = 4  # px of the network's input, at the edge of a far view, where lines have no vertices
_DIFFERENT_LINES = 1.0  # camera heights (less than half a lane) from which both views show different lines
_LEAST_BELOW = 10.0  # px below the horizon; nearer to it a camera height is too few px
_LEAST_VERTICES = 4  # vertices of a boundary in the far view, below which those of the whole image are kept


@dataclass(frozen=True)
class FarView:
    """Sizes of the network's two inputs, which together have as many pixels as one without a far view.

    The defaults were chosen on TuSimple's and CARLA's images (``docs/benchmarks/far_view.md``).

    Attributes:
        whole: width of the whole image's input as a fraction of that of the input without a far view.
        rows: height of the far view's input as a fraction of that of the input without a far view; its width
            follows from the number of pixels.
        magnification: ratio of the far view's pixels per degree to those of the input without a far view.
            The far view never has more pixels per degree than the camera.
        above: fraction of the far view's height that is above the vanishing point.

    Raises:
        ValueError: a number that leaves one of the views without pixels, or the horizon outside.
    """

    whole: float = 0.78
    rows: float = 0.4
    magnification: float = 1.28
    above: float = 0.2

    def __post_init__(self) -> None:
        if not 0.3 <= self.whole <= 0.9:
            raise ValueError(f"whole: expected 0.3 to 0.9 of the width, got {self.whole}")
        if not 0.2 <= self.rows <= 1.0:
            raise ValueError(f"rows: expected 0.2 to 1 of the height, got {self.rows}")
        if not 1.0 <= self.magnification <= 4.0:
            raise ValueError(f"magnification: expected 1 to 4, got {self.magnification}")
        if not 0.0 <= self.above <= 1.0:
            raise ValueError(f"above: expected 0 to 1 of the far view's height, got {self.above}")


class ViewSizes(NamedTuple):
    """Sizes (height, width), px.

    Attributes:
        whole: of the network's input for the whole image.
        far: of its input for the far view.
        resized: of the image from which the far view is cropped.
    """

    whole: tuple[int, int]
    far: tuple[int, int]
    resized: tuple[int, int]


def view_sizes(config: FarView, image_size: tuple[int, int], full: tuple[int, int]) -> ViewSizes:
    """Compute the sizes of the views.

    Args:
        config: the fractions.
        image_size: (H, W) px of the image.
        full: (h, w) px of the network's input without a far view, the number of whose pixels is the limit.
    """
    (height, width), (rows, columns) = image_size, full
    whole = resized_size(image_size, max(_STEP, _STEP * round(config.whole * columns / _STEP)), None)
    far_rows = max(_STEP, _STEP * round(config.rows * rows / _STEP))
    left = rows * columns - whole[0] * whole[1]
    far_columns = max(_STEP, _STEP * int(left / far_rows / _STEP))
    scale = min(1.0, config.magnification * columns / width)
    scale = max(scale, far_columns / width, far_rows / height)
    resized = max(far_rows, round(scale * height)), max(far_columns, round(scale * width))
    return ViewSizes(whole, (far_rows, far_columns), resized)


def place_crop(point: Tensor, sizes: ViewSizes, image_size: tuple[int, int], above: float) -> Tensor:
    """Place the far view about the vanishing point, within the image.

    Args:
        point: (B, 2) px, (x, y) of the vanishing point in the image.
        sizes: sizes of the views.
        image_size: (H, W) px of the image.
        above: fraction of the far view's height above the point.

    Returns:
        (B, 2) int64 px, (left, top) of the far view in the resized image.
    """
    (rows, columns), (height, width) = sizes.far, sizes.resized
    x = (point[:, 0] + 0.5) * (width / image_size[1]) - 0.5 * columns
    y = (point[:, 1] + 0.5) * (height / image_size[0]) - above * rows
    return torch.stack([x.clamp(0, width - columns), y.clamp(0, height - rows)], dim=-1).round().long()


def crop_images(image: Tensor, corner: Tensor, size: tuple[int, int]) -> Tensor:
    """Crop each image of a batch at its own place.

    Args:
        image: (B, C, H, W).
        corner: (B, 2) int64 px, (left, top).
        size: (h, w) px of the crops.

    Returns:
        (B, C, h, w).
    """
    left, top = corner[:, :, None].unbind(1)  # (B, 1)
    rows = top + torch.arange(size[0], device=image.device)  # (B, h)
    columns = left + torch.arange(size[1], device=image.device)  # (B, w)
    across = image.gather(2, rows[:, None, :, None].expand(-1, image.shape[1], -1, image.shape[3]))
    return across.gather(3, columns[:, None, None, :].expand(-1, image.shape[1], size[0], -1))


@full_precision
def far_vertices(
    found: BoundaryVertices, corner: Tensor, sizes: ViewSizes, image_size: tuple[int, int]
) -> BoundaryVertices:
    """Move vertices from the far view to the image.

    Args:
        found: vertices in pixels of the image, as if the far view began at its corner (0, 0).
        corner: (B, 2) px, (left, top) of the far view in the resized image.
        sizes: sizes of the views.
        image_size: (H, W) px of the image.
    """
    x, y = corner.to(found.points).unbind(-1)
    moved = torch.stack([x * (image_size[1] / sizes.resized[1]), y * (image_size[0] / sizes.resized[0])], -1)
    points = found.points + moved[:, None, None]
    return found._replace(points=torch.where((found.weight > 0).unsqueeze(-1), points, 0.0))


def covered_size(sizes: ViewSizes, image_size: tuple[int, int]) -> tuple[float, float]:
    """Return (height, width), px of the image, that the far view covers."""
    (rows, columns), (height, width) = sizes.far, sizes.resized
    return rows * image_size[0] / height, columns * image_size[1] / width


@full_precision
def merge_vertices(
    whole: BoundaryVertices, far: BoundaryVertices, inside: Tensor, horizon: Tensor
) -> BoundaryVertices:
    """Merge the vertices of the whole image and of the far view, so that no part of a line counts twice.

    Where the far view has a boundary, its vertices replace those of the whole image inside the far view. If
    it has the boundary in the place of another one, see :func:`contradiction`, those of the whole image are
    kept, which shows more of the road.

    Args:
        whole: (B, L, V), in pixels of the image.
        far: (B, L, V), likewise, of the same boundaries.
        inside: (B, L, V) bool, which of ``whole`` are inside the far view.
        horizon: (B,) px, row of the vanishing point.

    Returns:
        (B, L, VERTICES_PER_LINE), in order along each boundary; the last ones of more are left out.
    """
    other = contradiction(whole, far, horizon) > _DIFFERENT_LINES
    trusted = torch.where(other.unsqueeze(-1), 0.0, far.weight)
    replaced = inside & ((trusted > 0).sum(-1, keepdim=True) >= _LEAST_VERTICES)
    weight = torch.cat([torch.where(replaced, 0.0, whole.weight), trusted], dim=-1)
    points, sigma = torch.cat([whole.points, far.points], dim=2), torch.cat([whole.sigma, far.sigma], dim=2)
    order = order_along(points.detach(), weight.detach())[0]
    merged = BoundaryVertices(
        take(points, order), weight.gather(-1, order), sigma.gather(-1, order), whole.boundary
    )
    return with_columns(move_to_front(merged), VERTICES_PER_LINE)


def contradiction(whole: BoundaryVertices, far: BoundaryVertices, horizon: Tensor) -> Tensor:
    """Compute how far apart both views see a boundary, in camera heights on the road.

    Source: on a plane road, d px across the image v px below the horizon are d / v camera heights. A lane is
    about two and a half.

    Args:
        whole: (B, L, V), in pixels of the image.
        far: (B, L, W), likewise.
        horizon: (B,) px, row of the vanishing point.

    Returns:
        (B, L), median over the rows that both views have; 0 where there is no such row.
    """
    x, y = far.points.detach().unbind(-1)
    across, there = x_on_rows(whole, y)
    below = (y - horizon[:, None, None]).clamp(min=_LEAST_BELOW)
    return masked_median((x - across).abs() / below, there & (far.weight > 0))


def x_on_rows(vertices: BoundaryVertices, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Interpolate boundaries on rows of the image.

    Args:
        vertices: (B, L, V).
        rows: (B, L, W) px.

    Returns:
        x (B, L, W) px, and (B, L, W) bool, whether the row is between two vertices of the boundary.
    """
    y = torch.where(vertices.weight > 0, vertices.points[..., 1].detach(), torch.inf)
    y, order = y.sort(-1)
    x = vertices.points[..., 0].detach().gather(-1, order)
    after = (y.unsqueeze(-2) < rows.unsqueeze(-1)).sum(-1)  # torch.searchsorted, which ONNX lacks
    count = (vertices.weight > 0).sum(-1, keepdim=True)
    there = (after > 0) & (after < count)
    after = after.clamp(1, y.shape[-1] - 1)
    (y0, y1), (x0, x1) = ((part.gather(-1, after - 1), part.gather(-1, after)) for part in (y, x))
    share = torch.where(there, (rows - y0) / (y1 - y0).clamp(min=1e-6), 0.0)
    return torch.where(there, x0 + share * (x1 - x0), 0.0), there


def inside_far_view(points: Tensor, corner: Tensor, sizes: ViewSizes, image_size: tuple[int, int]) -> Tensor:
    """Return which points (B, L, V, 2) px of the image are inside the far view, (B, L, V) bool.

    At its edges lines have no vertices, so these are outside; its upper edge is above the road.
    """
    scale = points.new_tensor([sizes.resized[1] / image_size[1], sizes.resized[0] / image_size[0]])
    x, y = ((points + 0.5) * scale - 0.5 - corner.to(points)[:, None, None]).unbind(-1)
    rows, columns = sizes.far
    return (x >= _EDGE) & (x <= columns - 1 - _EDGE) & (y >= 0) & (y <= rows - 1 - _EDGE)


def with_columns(vertices: BoundaryVertices, count: int) -> BoundaryVertices:
    """Return vertices padded, or cut, to ``count`` on each boundary."""
    more = count - vertices.weight.shape[-1]
    pad = torch.nn.functional.pad
    return BoundaryVertices(
        pad(vertices.points, (0, 0, 0, more)),
        pad(vertices.weight, (0, more)),
        pad(vertices.sigma, (0, more), value=1.0),
        vertices.boundary,
    )
