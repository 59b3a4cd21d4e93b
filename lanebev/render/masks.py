"""Per-boundary masks from the exact points: the labels of a segmentation network."""

import torch
from torch import Tensor

from lanebev.geometry.lens import distort_points
from lanebev.render.frame import RenderedFrame

_PIECE = 3.0  # px, longest piece of a boundary that is drawn at once
_FAR = 8  # sides of the map; farther from its origin than this nothing is drawn


@torch.no_grad()
def boundary_masks(frame: RenderedFrame, size: tuple[int, int], half_width_px: float) -> Tensor:
    """Return soft masks of the boundaries in the image as taken, drawn by :func:`draw_stripes`.

    Args:
        frame: B rendered images of pinhole cameras.
        size: (h, w) of the masks; the image is taken to be resized to it, pixel centres at integers.
        half_width_px: in pixels of the masks.

    Returns:
        (B, L, h, w) in [0, 1].
    """
    if not half_width_px > 0:
        raise ValueError(f"half_width_px: expected > 0, got {half_width_px}")
    points = distort_points(frame.boundaries.flatten(1, 2), frame.intrinsics, frame.distortion)
    scale = points.new_tensor([size[1] / frame.image.shape[3], size[0] / frame.image.shape[2]])
    points = ((points + 0.5) * scale - 0.5).unflatten(1, frame.visible.shape[1:])
    return draw_stripes(points, frame.visible, size, half_width_px)


@torch.no_grad()
def draw_stripes(points: Tensor, strength: Tensor, size: tuple[int, int], half_width: float) -> Tensor:
    """Draw soft stripes about polylines.

    A stripe is 1 within ``half_width - 0.5`` of its polyline, by perpendicular distance, 0 beyond
    ``half_width + 0.5``, and linear in between. Only pixels about the polylines are computed.

    Args:
        points: (..., P, 2) px of the map, centres at integers.
        strength: (..., P) in [0, 1]; a piece is drawn with the smaller one of its two ends. Points that are
            not finite, or farther away than 8 sides of the map, have none.
        size: (h, w) of the map.
        half_width: px.

    Returns:
        (..., h, w) in [0, 1].
    """
    height, width = size
    near = (points.abs() < _FAR * max(size)).all(-1)  # false for NaN
    points = torch.where(near[..., None], points, 0.0)
    strength = torch.where(near, strength, 0.0)
    start, along = points[..., :-1, :].reshape(-1, 2), points.diff(dim=-2).reshape(-1, 2)  # (S, 2)
    strength = torch.minimum(strength[..., :-1], strength[..., 1:])
    layers = strength.shape[:-1]
    layer = torch.arange(layers.numel(), device=points.device).repeat_interleave(strength.shape[-1])
    strength = strength.reshape(-1)

    count = (along.norm(dim=-1) / _PIECE).ceil().clamp(min=1)
    count = torch.where(strength > 0, count, 0.0).long()
    piece = torch.arange(len(count), device=points.device).repeat_interleave(count)  # (K,) its segment
    number = torch.arange(len(piece), device=points.device) - (count.cumsum(0) - count)[piece]
    along = along[piece] / count[piece, None]
    start = start[piece] + number[:, None] * along
    layer, strength = layer[piece], strength[piece]

    reach = int(half_width + 0.5 + 0.5 * _PIECE) + 1
    offset = torch.arange(-reach, reach + 1, device=points.device)
    window = torch.stack(torch.meshgrid(offset, offset, indexing="xy"), dim=-1).flatten(0, 1)  # (W, 2) x, y
    pixel = (start + 0.5 * along).round().long()[:, None] + window
    away = pixel - start[:, None]
    length = along.square().sum(-1, keepdim=True).clamp(min=1e-9)
    nearest = ((away * along[:, None]).sum(-1) / length).clamp(0, 1)
    distance = (away - nearest[..., None] * along[:, None]).norm(dim=-1)
    value = (half_width + 0.5 - distance).clamp(0, 1) * strength[:, None]
    x, y = pixel.unbind(-1)
    value = torch.where((x >= 0) & (x < width) & (y >= 0) & (y < height), value, 0.0)
    index = (layer[:, None] * height + y.clamp(0, height - 1)) * width + x.clamp(0, width - 1)
    masks: Tensor = points.new_zeros(layers.numel() * height * width)
    masks.scatter_reduce_(0, index.flatten(), value.flatten(), "amax")
    return masks.reshape(*layers, height, width)
