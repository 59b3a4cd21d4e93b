"""Per-boundary masks from the exact points: the labels of a segmentation network."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.geometry.lens import distort_points
from lanebev.render.frame import RenderedFrame

_PIECE = 3.0  # px, longest piece of a boundary that is drawn at once


@torch.no_grad()
def boundary_masks(
    frame: RenderedFrame,
    size: tuple[int, int],
    half_width_px: float,
    *,
    weight: Tensor | None = None,
    model: str = "pinhole",
) -> Tensor:
    """Soft masks of the boundaries in the image as taken.

    A mask is 1 within ``half_width_px - 0.5`` of the boundary, by perpendicular distance, 0 beyond
    ``half_width_px + 0.5``, and linear in between.

    Args:
        frame: B rendered images.
        size: (h, w) of the masks; the image is taken to be resized to it, pixel centres at integers.
        half_width_px: in pixels of the masks.
        weight: (B, L, P) in [0, 1] for each point; by default ``frame.visible``.
        model: the frame's lens model.

    Returns:
        (B, L, h, w) in [0, 1].

    Raises:
        ValueError: a half width that is not positive, or weights of the wrong shape.
    """
    if not half_width_px > 0:
        raise ValueError(f"half_width_px: expected > 0, got {half_width_px}")
    weight = frame.visible if weight is None else weight
    if weight.shape != frame.painted.shape:
        raise ValueError(f"weight: expected {tuple(frame.painted.shape)}, got {tuple(weight.shape)}")
    batch, boundaries, _ = weight.shape
    height, width = size
    points = distort_points(frame.boundaries.flatten(1, 2), frame.intrinsics, frame.distortion, model)
    scale = points.new_tensor([width / frame.image.shape[3], height / frame.image.shape[2]])
    points = ((points + 0.5) * scale - 0.5).unflatten(1, weight.shape[1:])

    start, end = points[:, :, :-1], points[:, :, 1:]
    strength = torch.minimum(weight[:, :, :-1], weight[:, :, 1:])
    masks: Tensor = points.new_zeros(batch * boundaries * height * width)
    layer, part = (strength.flatten(0, 1) > 0).nonzero(as_tuple=True)  # (S,) pieces that are there
    if len(layer) == 0:
        return masks.reshape(batch, boundaries, height, width)
    start, end = (t.flatten(0, 1)[layer, part] for t in (start, end))
    strength = strength.flatten(0, 1)[layer, part]
    count = int(((end - start).norm(dim=-1).max() / _PIECE).ceil().clamp(1, 64))
    steps = torch.arange(count + 1, device=points.device) / count
    nodes = start[:, None] + (end - start)[:, None] * steps[:, None]  # (S, count + 1, 2)
    start, end = nodes[:, :-1].flatten(0, 1), nodes[:, 1:].flatten(0, 1)
    layer, strength = layer.repeat_interleave(count), strength.repeat_interleave(count)

    reach = int(half_width_px + 0.5 + 0.5 * _PIECE) + 1
    offset = torch.arange(-reach, reach + 1, device=points.device)
    window = torch.stack(torch.meshgrid(offset, offset, indexing="xy"), dim=-1).flatten(0, 1)  # (K, 2) x, y
    pixel = (0.5 * (start + end)).round().long()[:, None] + window
    along = (end - start)[:, None]
    length = (along * along).sum(-1).clamp(min=1e-9)
    away = pixel - start[:, None]
    nearest = ((away * along).sum(-1) / length).clamp(0, 1)
    distance = (away - nearest[..., None] * along).norm(dim=-1)
    value = (half_width_px + 0.5 - distance).clamp(0, 1) * strength[:, None]
    x, y = pixel.unbind(-1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (value > 0)
    index = (layer[:, None] * height + y) * width + x
    masks.scatter_reduce_(0, index[inside], value[inside], "amax")
    return masks.reshape(batch, boundaries, height, width)
