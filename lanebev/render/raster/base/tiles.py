"""Tiles of 8 x 8 pixels: pieces of an image that are taken or left as a whole."""

import torch
from torch import Tensor

TILE = 8  # px
TILE_PIXELS = TILE * TILE


def tile_grid(size: tuple[int, int]) -> tuple[int, int]:
    """Return the number of rows and columns of tiles that cover an image of (height, width)."""
    return -(-size[0] // TILE), -(-size[1] // TILE)


def tile_corners(plane: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the values (B, H·W) at the four corners of every tile, (4, B, tiles)."""
    rows, columns = tile_grid(size)
    y = torch.arange(rows, device=plane.device) * TILE
    x = torch.arange(columns, device=plane.device) * TILE
    corners = []
    for down in (0, TILE - 1):
        for right in (0, TILE - 1):
            row, column = (y + down).clamp(max=size[0] - 1), (x + right).clamp(max=size[1] - 1)
            corners.append((row[:, None] * size[1] + column).flatten())
    place = torch.stack(corners)
    values: Tensor = plane.index_select(1, place.flatten()).unflatten(1, place.shape).transpose(0, 1)
    return values


def tile_pixels(tile: Tensor, size: tuple[int, int]) -> Tensor:
    """Return row-major places (..., 64) of the pixels of tiles (...,), kept inside the border."""
    columns = tile_grid(size)[1]
    within = torch.arange(TILE_PIXELS, device=tile.device)
    y = ((tile // columns * TILE)[..., None] + within // TILE).clamp(max=size[0] - 1)
    x = ((tile % columns * TILE)[..., None] + within % TILE).clamp(max=size[1] - 1)
    return y * size[1] + x
