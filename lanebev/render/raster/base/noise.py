"""Noise tiles, computed once, sampled anywhere: the grain of everything that is rendered."""

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from lanebev.render.raster.base.select import take

TILE = 512
GRAIN, CLOUD, CRACK, SECOND = 0, 1, 2, 3  # channels of the tile
_TILE_SEED = 20261122


@lru_cache(maxsize=1)
def _tile_on_host() -> Tensor:
    """Make a periodic tile (4, TILE + 1, TILE + 1).

    Its channels are grain and its like of unit variance, four texels wide; cloud, 1/f noise of unit variance;
    crack, 1 on the edges of irregular cells and 0 elsewhere.
    """
    generator = torch.Generator().manual_seed(_TILE_SEED)
    frequency = torch.fft.fftfreq(TILE) * TILE
    radius = torch.hypot(frequency[:, None], frequency[None])
    grain = _shaped(torch.exp(-((radius / 110) ** 2)), generator)
    cloud = _shaped((radius + 1.5) ** -1.35, generator)
    warp = _shaped((radius + 3) ** -1.6, generator)
    second = _shaped(torch.exp(-((radius / 110) ** 2)), generator)
    tile = torch.stack([grain, cloud, _cracks(warp, generator), second])
    return functional.pad(tile[None], (0, 1, 0, 1), mode="circular")[0]


def _shaped(spectrum: Tensor, generator: torch.Generator) -> Tensor:
    white = torch.fft.fft2(torch.randn(TILE, TILE, generator=generator))
    spectrum = spectrum.clone()
    spectrum[0, 0] = 0
    field: Tensor = torch.fft.ifft2(white * spectrum).real
    return field / field.std()


def _cracks(warp: Tensor, generator: torch.Generator) -> Tensor:
    """Draw the edges of the cells of a jittered periodic grid, bent by a noise."""
    cells = 9
    axis = torch.arange(TILE) / TILE * cells
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    y, x = y + 0.12 * warp, x + 0.12 * warp.roll(200, 1)
    jitter = torch.rand(cells, cells, 2, generator=generator)
    distances = []
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            row, column = y.floor() + dy, x.floor() + dx
            seed = jitter[row.long() % cells, column.long() % cells]
            distances.append(torch.hypot(row + seed[..., 0] - y, column + seed[..., 1] - x))
    nearest = torch.stack(distances).topk(2, dim=0, largest=False).values
    return torch.exp(-(((nearest[1] - nearest[0]) / 0.03) ** 2))


@lru_cache(maxsize=32)
def noise_tile(device: torch.device, channel: int) -> Tensor:
    """Return one channel of the tile, (TILE + 1, TILE + 1)."""
    return _tile_on_host()[channel].contiguous().to(device)


@lru_cache(maxsize=8)
def _blotch_tile(device: torch.device) -> Tensor:
    """Make four independent clouds, (1, 4, TILE + 1, TILE + 1)."""
    cloud = _tile_on_host()[CLOUD, :-1, :-1]
    moved = [cloud.roll((151 * i, 97 * i), (0, 1)) for i in range(4)]
    return functional.pad(torch.stack(moved)[None], (0, 1, 0, 1), mode="circular").to(device)


@lru_cache(maxsize=8)
def _line_table(device: torch.device) -> Tensor:
    """Make a periodic cloud over a line, finely sampled, (16 · TILE,)."""
    row = _tile_on_host()[CLOUD, 77]
    fine = functional.interpolate(row[None, None], 16 * TILE + 1, mode="linear", align_corners=True)
    return fine[0, 0, :-1].contiguous().to(device)


def sample_noise(channel: int, u: Tensor, v: Tensor) -> Tensor:
    """Sample the tile at (u, v), bilinear and periodic.

    Args:
        channel: GRAIN, CLOUD, CRACK or SECOND.
        u: (...,) in periods of the tile; broadcasts with v.
        v: (...,) likewise.

    Returns:
        (...,).
    """
    u, v = torch.broadcast_tensors(u, v)
    return _bilinear(noise_tile(u.device, channel)[None, None], u, v)[0]


def blotches(along: Tensor, across: Tensor) -> Tensor:
    """Sample four slow noises over the road at once, (4, B, N): 1/f, features up to 60 m by 20 m."""
    return _bilinear(_blotch_tile(along.device), along * (1 / 173.0), across * (1 / 61.0))


def _bilinear(tile: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Interpolate periodic tiles (1, C, TILE + 1, TILE + 1) at (u, v) (...,) periods, (C, ...)."""
    grid = torch.view_as_real(torch.complex(u, v))  # a fast stack
    grid = grid.sub_(grid.floor()).mul_(2).sub_(1)
    values = functional.grid_sample(
        tile, grid.reshape(1, 1, -1, 2), align_corners=True, padding_mode="border"
    )
    return values.reshape(tile.shape[1], *u.shape)


def sample_grain(u: Tensor, v: Tensor) -> Tensor:
    """Sample the nearest texel of the tile of grain: for what is finer than a pixel, four times faster."""
    row, column = (v * TILE).int() & (TILE - 1), (u * TILE).int() & (TILE - 1)
    return take(noise_tile(u.device, GRAIN), row * (TILE + 1) + column)


def sample_line(u: Tensor) -> Tensor:
    """Sample a periodic noise over a line at u (...,) periods."""
    return take(_line_table(u.device), (u * (16 * TILE)).int() & (16 * TILE - 1))


def hash01(a: Tensor, b: Tensor, salt: float) -> Tensor:
    """Compute repeatable pseudo-random numbers in [0, 1) from two integer-valued float tensors."""
    value = (a * 12.9898 + b * 78.233 + salt * 37.719).sin() * 43758.5453
    return value - value.floor()


def smoothstep(low: float | Tensor, high: float | Tensor, value: Tensor) -> Tensor:
    """Return 0 below low and 1 above high, smooth between."""
    t = ((value - low) / (high - low)).clamp(0, 1)
    return t * t * torch.rsub(t, 3, alpha=2)
