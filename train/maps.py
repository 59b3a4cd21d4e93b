"""Label maps of a whole batch on its device: :mod:`train.labels` without OpenCV."""

from typing import NamedTuple

from torch import Tensor

from lanebev.geometry.lens import distort_points
from lanebev.render import RenderedFrame, draw_stripes
from train.labels import ViewConfig, separated


class LabelMaps(NamedTuple):
    """Targets of B images.

    Attributes:
        target: (B, L, h, w) in [0, 1], the share of each label pixel that each boundary's stripe covers.
        weight: (B, h, w), 0 or 1; 0 where an occluded boundary passes.
    """

    target: Tensor
    weight: Tensor


def label_maps(
    points: Tensor, painted: Tensor, visible: Tensor, size: tuple[int, int], view: ViewConfig
) -> LabelMaps:
    """Draw the label maps of boundaries.

    Args:
        points: (B, L, P, 2) px of the image as taken, near to far; NaN where there is none.
        painted: (B, L, P) bool, the boundary exists and is marked there.
        visible: (B, L, P) bool, and nothing stands in front of it.
        size: (height, width) of the images.
        view: stride of the labels, half-width and least distance of the stripes.
    """
    stride = view.output_stride
    points = points / stride
    exists = separated(points, painted & points.isfinite().all(-1), view.gap)
    map_size = (-(-size[0] // stride), -(-size[1] // stride))
    shown, occluded = (exists & visible, exists & ~visible)
    target = draw_stripes(points, shown.to(points.dtype), map_size, view.half_width)
    hidden = draw_stripes(points, occluded.to(points.dtype), map_size, 2 * view.half_width)
    weight = (hidden.amax(1) == 0) | (target.amax(1) > 0)
    return LabelMaps(target / target.sum(1, keepdim=True).clamp(min=1), weight)


def boundaries_as_taken(frame: RenderedFrame) -> Tensor:
    """Return a rendered batch's boundary points as the lens shows them, (B, L, P, 2) px."""
    flat = frame.boundaries.flatten(1, 2)
    taken = distort_points(flat, frame.intrinsics, frame.distortion)
    return taken.reshape(frame.boundaries.shape)
