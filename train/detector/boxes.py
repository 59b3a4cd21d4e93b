"""Vehicles as boxes on the road: (..., 5) X, Z, length, width in m, heading in rad, positive to the right."""

import torch
from torch import Tensor

from lanebev.view.grid import BEVGrid

BEARINGS = 33
"""Directions in which a box is sampled, evenly over the angle that it covers."""


def box_corners(boxes: Tensor) -> Tensor:
    """Compute the corners (..., 4, 2) m (X, Z) of boxes (..., 5)."""
    x, z, length, width, heading = boxes.unsqueeze(-2).unbind(-1)
    along = 0.5 * length * boxes.new_tensor([1.0, 1.0, -1.0, -1.0])
    across = 0.5 * width * boxes.new_tensor([1.0, -1.0, -1.0, 1.0])
    sin, cos = heading.sin(), heading.cos()
    return torch.stack([x + along * sin + across * cos, z + along * cos - across * sin], dim=-1)


def visible_share(boxes: Tensor, valid: Tensor, view: Tensor) -> Tensor:
    """Compute the share of each box's directions that the camera sees it in.

    A direction is a bearing on the road. A nearer box hides all that is behind it: that a camera looks over a
    car at a lorry is left out.

    Args:
        boxes: (B, M, 5).
        valid: (B, M) bool; others neither are seen nor hide.
        view: (B, 2) rad, bearings of the image's left and right edge, positive to the right.

    Returns:
        (B, M) in [0, 1], 0 where not valid or not wholly ahead of the camera.
    """
    corners = box_corners(boxes)
    ahead = valid & (corners[..., 1] > 0.5).all(-1)
    bearing = torch.atan2(corners[..., 0], corners[..., 1])
    low, high = bearing.amin(-1), bearing.amax(-1)  # (B, M)
    part = torch.linspace(0.02, 0.98, BEARINGS, dtype=boxes.dtype, device=boxes.device)
    looked = low.unsqueeze(-1) + (high - low).unsqueeze(-1) * part  # (B, M, K)
    distance = boxes[..., :2].norm(dim=-1)
    nearer = ahead[:, None, :] & (distance[:, None, :] < distance[:, :, None])  # (B, M, M): by whom
    covers = (looked[:, :, None] > low[:, None, :, None]) & (looked[:, :, None] < high[:, None, :, None])
    hidden = (covers & nearer[..., None]).any(2)
    inside = (looked > view[:, :1, None]) & (looked < view[:, 1:, None])
    return torch.where(ahead, (inside & ~hidden).to(boxes.dtype).mean(-1), 0.0)


def in_grid(boxes: Tensor, grid: BEVGrid) -> Tensor:
    """Return whether the centres of boxes (..., 5) fall into a cell, (...) bool."""
    cell = grid.bev_from_road_points(boxes[..., :2]).round()
    rows, columns = grid.shape
    return (cell >= 0).all(-1) & (cell[..., 0] < columns) & (cell[..., 1] < rows)
