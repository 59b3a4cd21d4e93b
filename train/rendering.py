"""Rendered views, mirrored and labelled: scenes on the CPU, all else on one device."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lanebev.render import WindowConfig
from lanebev.render.scene.world import Scene
from lanebev.render.views import render_scenes, sample_views
from train.data import Batch, Seed
from train.labels import ViewConfig
from train.maps import boundaries_as_taken, label_maps


class Views(NamedTuple):
    """Rendered images and their boundaries.

    Attributes:
        image: (B, 3, H, W) uint8 RGB.
        points: (B, L, P, 2) px as taken.
        painted: (B, L, P) bool, the boundary exists and is marked there.
        visible: (B, L, P) bool, and nothing stands in front of it.
    """

    image: Tensor
    points: Tensor
    painted: Tensor
    visible: Tensor


def combined_seed(seed: Seed) -> int:
    """Draw one seed by several numbers."""
    return int(np.random.default_rng(seed).integers(2**62))


class Scenes(NamedTuple):
    """Scenes on the CPU, with the seeds of their images' noise."""

    scene: Scene
    seeds: list[int]


def sample_scenes(count: int, size: tuple[int, int], seed: Seed, window: WindowConfig | None) -> Scenes:
    """Sample the scenes of views, see :func:`random_views`."""
    generator = torch.Generator().manual_seed(combined_seed(seed))
    return Scenes(*sample_views(count, size, generator, window=window))


@torch.no_grad()
def render_sampled(scenes: Scenes, size: tuple[int, int], device: torch.device, rows: int) -> Views:
    """Render sampled scenes, see :func:`random_views`."""
    frame = render_scenes(scenes.scene, size, scenes.seeds, device=device, rows=rows)
    image = (255 * frame.image).round_().clamp_(0, 255).byte()
    return Views(image, boundaries_as_taken(frame), frame.painted > 0.5, frame.visible > 0.5)


def random_views(
    count: int,
    size: tuple[int, int],
    seed: Seed,
    device: torch.device,
    window: WindowConfig | None,
    rows: int,
) -> Views:
    """Render views.

    Args:
        count: B.
        size: (height, width).
        seed: decides everything, on one kind of device.
        device: device of the rendering.
        window: window of the views; None for whole images.
        rows: views whose pixels are computed at once.
    """
    return render_sampled(sample_scenes(count, size, seed, window), size, device, rows)


def mirrored(views: Views, which: Tensor) -> Views:
    """Mirror some images and renumber their boundaries.

    Args:
        views: B of them.
        which: (B,) bool.
    """
    width = views.image.shape[-1]
    across = torch.cat([width - 1 - views.points[..., :1], views.points[..., 1:]], dim=-1)
    other = Views(views.image.flip(-1), across.flip(1), views.painted.flip(1), views.visible.flip(1))
    return Views(
        *(torch.where(which.view(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(views, other, strict=True))
    )


def labelled(views: Views, config: ViewConfig) -> Batch:
    """Draw the views' labels."""
    size = (views.image.shape[-2], views.image.shape[-1])
    maps = label_maps(views.points, views.painted, views.visible, size, config)
    return Batch(views.image, (255 * maps.target).round_().byte(), maps.weight.byte())
