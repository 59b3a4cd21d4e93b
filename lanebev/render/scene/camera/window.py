"""Windows: what a crop about the horizon of a camera with more pixels would see, as other intrinsics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lanebev.render.scene.sampler import BatchSampler


@dataclass(frozen=True)
class WindowConfig:
    """The distribution of windows of the camera's native image.

    The native image has the proportions of the rendered one and as many pixels as the window needs.

    Attributes:
        scale: range of the window's width as a share of the native image's.
        stretch: standard deviation of the logarithm of the window's vertical scale over its horizontal one.
        horizon: range of the vanishing point's height in the window, as a share from the top.
        shift: largest sideways shift of the window's middle from the native image's, as a share of what
            one is wider than the other; at most 0.5 keeps the narrower one inside of the wider one.

    Raises:
        ValueError: a range that is empty or not positive, or a negative stretch or shift.
    """

    scale: tuple[float, float] = (0.45, 1.05)
    stretch: float = 0.08
    horizon: tuple[float, float] = (0.0, 0.45)
    shift: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.scale[0] <= self.scale[1]:
            raise ValueError(f"scale: expected 0 < low <= high, got {self.scale}")
        if not self.horizon[0] <= self.horizon[1]:
            raise ValueError(f"horizon: expected low <= high, got {self.horizon}")
        if not (self.stretch >= 0 and self.shift >= 0):
            raise ValueError(f"expected stretch, shift >= 0, got {self.stretch} and {self.shift}")


def window_from_native(
    sampler: BatchSampler, config: WindowConfig, scale: Tensor, size: tuple[int, int], vanishing_point: Tensor
) -> Tensor:
    """Sample the maps from native pixels to pixels of windows about the horizon.

    Args:
        sampler: the randomness.
        config: config of the windows.
        scale: (B,) the windows' width as a share of the native image's.
        size: (height, width) of the native image and of the window, px.
        vanishing_point: (B, 2) px of the native image as taken.

    Returns:
        (B, 3, 3) affine, diagonal but for the shift; pixel centres at integers.
    """
    height, width = size
    across = 1 / scale
    down = across * sampler.normal(config.stretch).exp()
    spare = (width * across - width).abs()
    middle = 0.5 * (width - 1) + sampler.uniform(-config.shift, config.shift) * spare
    horizon = sampler.uniform(*config.horizon) * height - 0.5
    zero, one = torch.zeros_like(across), torch.ones_like(across)
    shift_x, shift_y = middle - across * 0.5 * (width - 1), horizon - down * vanishing_point[:, 1]
    entries = [across, zero, shift_x, zero, down, shift_y, zero, zero, one]
    matrix: Tensor = torch.stack(entries, dim=-1).unflatten(-1, (3, 3))
    return matrix
