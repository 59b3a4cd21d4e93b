"""Convert boxes to the maps of a CenterPoint head and back, and compute the loss.

Source: Zhou et al. 2019, "Objects as Points"; Yin et al. 2021, "Center-based 3D Object Detection and
Tracking". Maps (B, 7, U, V): logit of a centre; offset of the centre from the cell, columns and rows;
logarithms of length and width in m; sine and cosine of the heading.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from lanebev.view.grid import BEVGrid

CHANNELS = 7
SPREAD = 1.0  # cells, sigma of a centre's peak
REGRESSION_WEIGHT = 0.5


def centre_heatmap(boxes: Tensor, seen: Tensor, grid: BEVGrid) -> Tensor:
    """Draw a Gaussian peak, 1 at the centre's cell, for each box.

    Args:
        boxes: (B, M, 5).
        seen: (B, M) bool.
        grid: U × V cells.

    Returns:
        (B, U, V).
    """
    cell = grid.bev_from_road_points(boxes[..., :2]).round()[:, :, None, None]
    rows, columns = (torch.arange(n, dtype=boxes.dtype, device=boxes.device) for n in grid.shape)
    away = (columns - cell[..., 0]).square() + (rows[:, None] - cell[..., 1]).square()
    peaks = torch.where(seen[..., None, None], (-0.5 * away / SPREAD**2).exp(), 0.0)
    return peaks.amax(1)


def box_values(boxes: Tensor, grid: BEVGrid) -> tuple[Tensor, Tensor]:
    """Compute what the head should say of boxes (B, M, 5) in the grid.

    Returns:
        (B, M) int64 index of the cell, and (B, M, 6) offset, logarithms of the size, sine and cosine.
    """
    point = grid.bev_from_road_points(boxes[..., :2])
    cell = point.round()
    _, columns = grid.shape
    index = (cell[..., 1] * columns + cell[..., 0]).long().clamp(0, grid.shape[0] * columns - 1)
    size = boxes[..., 2:4].clamp(min=0.1).log()
    heading = boxes[..., 4:]
    return index, torch.cat([point - cell, size, heading.sin(), heading.cos()], dim=-1)


def focal_loss(logits: Tensor, heatmap: Tensor) -> Tensor:
    """Compute the penalty-reduced focal loss, alpha 2 and beta 4, by the number of centres.

    Source: Law and Deng 2018, "CornerNet", Eq. (1).

    Args:
        logits: (B, U, V).
        heatmap: (B, U, V) in [0, 1].
    """
    centre = heatmap == 1
    share = logits.sigmoid()
    positive = (1 - share).square() * F.logsigmoid(logits)
    negative = (1 - heatmap).pow(4) * share.square() * F.logsigmoid(-logits)
    return -torch.where(centre, positive, negative).sum() / centre.sum().clamp(min=1)


def detection_loss(maps: Tensor, boxes: Tensor, seen: Tensor, grid: BEVGrid) -> Tensor:
    """Compute the focal loss of the centres and the L1 loss of what is said at them.

    Args:
        maps: (B, 7, U, V).
        boxes: (B, M, 5).
        seen: (B, M) bool; in the grid.
        grid: U × V cells.
    """
    index, wanted = box_values(boxes, grid)
    said = maps[:, 1:].flatten(2).gather(2, index[:, None].expand(-1, CHANNELS - 1, -1)).mT
    distance = torch.where(seen[..., None], (said - wanted).abs(), 0.0).sum() / seen.sum().clamp(min=1)
    return focal_loss(maps[:, 0], centre_heatmap(boxes, seen, grid)) + REGRESSION_WEIGHT * distance


def decode_boxes(maps: Tensor, grid: BEVGrid, count: int = 30) -> tuple[Tensor, Tensor]:
    """Read the highest peaks of the centres' map, each the largest of its 3 × 3 cells.

    Args:
        maps: (B, 7, U, V).
        grid: U × V cells.
        count: K, boxes of each row.

    Returns:
        (B, K, 5) boxes and (B, K) scores, best first.
    """
    heat = maps[:, :1].sigmoid()
    peak = torch.where(F.max_pool2d(heat, 3, 1, 1) == heat, heat, 0.0)
    score, index = peak.flatten(1).topk(count, dim=1)
    column, row, length, width, sin, cos = (
        maps[:, 1:].flatten(2).gather(2, index[:, None].expand(-1, CHANNELS - 1, -1)).unbind(1)
    )
    columns = grid.shape[1]
    point = torch.stack([index % columns + column, index // columns + row], dim=-1)
    centre = grid.road_from_bev_points(point)
    size = torch.stack([length, width], dim=-1).exp()
    return torch.cat([centre, size, torch.atan2(sin, cos).unsqueeze(-1)], dim=-1), score
