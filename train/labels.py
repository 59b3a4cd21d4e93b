"""Boundary points to thin, soft, anti-aliased label maps, and views of a labelled image."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Float = npt.NDArray[np.float32]
Byte = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

SUPERSAMPLING = 4  # a row's centre is drawn to 0.07 label px, without bias
_FRACTION_BITS = 6


class LabelledImage(NamedTuple):
    """One image and its boundaries.

    Attributes:
        image: (H, W, 3) RGB.
        points: (L, P, 2) px as taken, near to far; NaN where there is none.
        painted: (L, P), the boundary exists and is marked there.
        visible: (L, P), and nothing stands in front of it.
        vanishing_point: (2,) px, or NaN where not known.
    """

    image: Byte
    points: Float
    painted: Bool
    visible: Bool
    vanishing_point: Float


class LabelledView(NamedTuple):
    """Input and target of the network's training.

    Attributes:
        image: (3, H, W).
        target: (L, h, w), 0..255, the share of each label pixel that each boundary's stripe covers.
        weight: (h, w), 0 or 1; 0 where an occluded boundary passes.
    """

    image: Byte
    target: Byte
    weight: Byte


def draw_boundaries(points: Float, shown: Bool, size: tuple[int, int], half_width: float) -> Byte:
    """Draw stripes of constant perpendicular half-width about polylines, anti-aliased.

    Args:
        points: (L, P, 2) label px, centres at integers.
        shown: (L, P); a piece is drawn where both of its ends are shown.
        size: (h, w) of the map.
        half_width: label px; drawn as the nearest odd number of eighths.

    Returns:
        (L, h, w) 0..255. Where stripes overlap, they share: the sum over boundaries is at most 255.
    """
    height, width = size
    fine = points * SUPERSAMPLING + 0.5 * (SUPERSAMPLING - 1)
    maps = np.zeros((len(points), height, width), np.float32)
    for line, mask, out in zip(fine, shown, maps, strict=True):
        runs = _runs(line, mask & (np.abs(line) < 20 * SUPERSAMPLING * max(size)).all(-1))
        if not runs:
            continue
        canvas = np.zeros((height * SUPERSAMPLING, width * SUPERSAMPLING), np.uint8)
        thickness = max(1, 2 * round(half_width * SUPERSAMPLING - 0.5) - 1)  # of odd t OpenCV draws t + 2
        cv2.polylines(canvas, runs, False, 255, thickness, cv2.LINE_8, _FRACTION_BITS)
        out[:] = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
    maps *= 255 / np.maximum(maps.sum(0), 255)
    return np.rint(maps).astype(np.uint8)


def _runs(line: Float, mask: Bool) -> list[npt.NDArray[np.int32]]:
    """Return connected pieces of a polyline where the mask holds, in fixed point."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    near = np.clip(np.nan_to_num(line), -1e6, 1e6)  # what is farther is masked, and no int32
    fixed = np.rint(near * 2**_FRACTION_BITS).astype(np.int32)
    return [fixed[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]


def separated(points: Tensor, exists: Tensor, gap: float) -> Tensor:
    """Return where a boundary is at least ``gap`` px from the next one of the same distance ahead.

    Towards the horizon the boundaries run together; what cannot be told apart is not worth learning.

    Args:
        points: (..., L, P, 2) px.
        exists: (..., L, P) bool.
        gap: px.

    Returns:
        (..., L, P) bool.
    """
    apart = points.diff(dim=-3).norm(dim=-1) >= gap  # (..., L - 1, P)
    apart = apart | ~(exists[..., 1:, :] & exists[..., :-1, :])
    free = exists.clone()
    free[..., 1:, :] &= apart
    free[..., :-1, :] &= apart
    return free


@dataclass(frozen=True)
class ViewConfig:
    """Ranges of the random views of a labelled image.

    Attributes:
        output_stride: output stride of the network whose labels these are.
        half_width: half width of the stripes, label px (paper.md T3).
        gap: least distance of neighbouring boundaries, label px.
        scale: range of the view's width as a share of the image's.
        rotation_deg: standard deviation of the rotation.
        wild_share: share of views with five times that rotation.
        stretch: standard deviation of the log aspect ratio.
        horizon: range of the vanishing point's height in the view, as a share from the top.
        flip: probability of mirroring, with the boundaries renumbered.
    """

    output_stride: int = 2
    half_width: float = 1.125
    gap: float = 2.0
    scale: tuple[float, float] = (0.6, 1.05)
    rotation_deg: float = 2.0
    wild_share: float = 0.1
    stretch: float = 0.08
    horizon: tuple[float, float] = (0.0, 0.45)
    flip: float = 0.5


def full_view(sample: LabelledImage, size: tuple[int, int], config: ViewConfig) -> LabelledView:
    """Return the whole image at (height, width)."""
    height, width = sample.image.shape[:2]
    sy, sx = size[0] / height, size[1] / width
    matrix = np.array([[sx, 0, 0.5 * (sx - 1)], [0, sy, 0.5 * (sy - 1)], [0, 0, 1]])
    return _view(sample, size, matrix, config)


def random_view(
    sample: LabelledImage, size: tuple[int, int], config: ViewConfig, rng: np.random.Generator
) -> LabelledView:
    """Sample a random crop, zoom, stretch, rotation and mirroring of the image at (height, width)."""
    height, width = sample.image.shape[:2]
    scale = size[1] / (width * rng.uniform(*config.scale))
    stretch = np.exp(config.stretch * rng.standard_normal())
    angle = np.deg2rad(config.rotation_deg) * rng.standard_normal()
    angle *= 5.0 if rng.random() < config.wild_share else 1.0
    c, s = np.cos(angle), np.sin(angle)
    linear = np.array([[c, s], [-s, c]]) @ np.diag([scale, scale * stretch])
    anchor, place = np.array([0.5 * width, 0.5 * height]), np.array([0.5 * size[1], 0.5 * size[0]])
    spare = abs(width * scale - size[1])
    place[0] += rng.uniform(-0.5, 0.5) * spare
    if np.isfinite(sample.vanishing_point).all():
        anchor[1] = sample.vanishing_point[1]
        place[1] = rng.uniform(*config.horizon) * size[0]
    mirrored = rng.random() < config.flip
    if mirrored:
        linear = np.diag([-1.0, 1.0]) @ linear
        sample = sample._replace(
            points=sample.points[::-1], painted=sample.painted[::-1], visible=sample.visible[::-1]
        )
        place[0] = size[1] - 1 - place[0]
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = linear, place - linear @ anchor
    return _view(sample, size, matrix, config)


def _view(
    sample: LabelledImage, size: tuple[int, int], matrix: npt.NDArray[np.float64], config: ViewConfig
) -> LabelledView:
    """Warp image and points by the same (3, 3) affine map, view px from image px."""
    height, width = size
    shrink = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    image = sample.image
    if shrink < 0.45:  # bilinear sampling averages two pixels, no more
        image = cv2.GaussianBlur(image, (0, 0), 0.4 / shrink)
    image = cv2.warpAffine(
        image, matrix[:2], (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    stride = config.output_stride
    points = (sample.points @ matrix[:2, :2].T + matrix[:2, 2]).astype(np.float32) / np.float32(stride)
    there = torch.from_numpy(sample.painted & np.isfinite(points).all(-1))
    exists = separated(torch.from_numpy(points), there, config.gap).numpy()
    label_size = (-(-height // stride), -(-width // stride))
    target = draw_boundaries(points, exists & sample.visible, label_size, config.half_width)
    hidden = draw_boundaries(points, exists & ~sample.visible, label_size, 2 * config.half_width)
    weight = ((hidden.max(0) == 0) | (target.max(0) > 0)).astype(np.uint8)
    return LabelledView(np.ascontiguousarray(image.transpose(2, 0, 1)), target, weight)
