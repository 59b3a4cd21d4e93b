"""Draw views with their labels on one sheet."""

from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from lanebev.report.overlay import BOUNDARY_COLOURS
from train.data import Batch

_HIDDEN = (255.0, 255.0, 255.0)
_OPACITY = 0.7


def labelled_view(batch: Batch) -> Tensor:
    """Draw the labels of a batch into its images, hidden boundaries in white: (B, 3, H, W) uint8."""
    size = batch.image.shape[-2:]
    colours = torch.tensor(BOUNDARY_COLOURS, dtype=torch.float32, device=batch.image.device)
    colours = torch.cat([colours, colours.new_tensor([_HIDDEN])])
    hidden = 255 * (1 - batch.weight.float()).unsqueeze(1)
    share = torch.cat([batch.target.float(), hidden], dim=1) / 255
    share = F.interpolate(share, size=size, mode="nearest")
    paint = torch.einsum("blhw,lc->bchw", share, colours)
    covered = share.sum(1, keepdim=True).clamp(max=1) * _OPACITY
    return ((1 - covered) * batch.image.float() + _OPACITY * paint).clamp(0, 255).byte()


def save_sheet(images: Tensor, path: Path, columns: int = 4, width: int = 400) -> None:
    """Save images (B, 3, H, W) uint8 side by side, each ``width`` px wide.

    Args:
        images: images, all of one size.
        path: path of the PNG.
        columns: columns of the sheet.
        width: px.
    """
    height = round(width * images.shape[-2] / images.shape[-1])
    small = F.interpolate(images.float(), size=(height, width), mode="bilinear", antialias=True)
    small = F.pad(small, (0, 0, 0, 0, 0, 0, 0, -len(images) % columns))
    rows = small.unflatten(0, (-1, columns)).permute(0, 3, 1, 4, 2)  # (rows, H, columns, W, 3)
    sheet = rows.reshape(-1, columns * width, 3).round().clamp(0, 255).byte().cpu().numpy()
    Image.fromarray(sheet).save(path)
