"""Probability maps to line segments in pixels of the image, differentiable in the probabilities."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lanebev.geometry.lens import (
    invert_distortion,
    placeholder_intrinsics,
    undistorted_sigma,
    usable_cameras,
)
from lanebev.geometry.precision import full_precision
from lanebev.observation.segmenter import SegmenterConfig
from lanebev.observation.vertices import LineConfig, representative_vertices, scan_vertices, take
from lanebev.types import LaneSegments, check_tensor

NETWORK_CORRELATION = 10.0
"""``LineConfig.correlation``, px: what rows of ``lanes.json`` are apart, so that LaneBEV and a run agree."""


class LineExtractor(nn.Module):
    """Logits to :class:`~lanebev.LaneSegments`.

    Source: Sect. "Experiments": where a boundary's probability is larger than 0.5, the mean position of its
    on-pixels, then representative vertices. Deviation: so it is on maps of zeros and ones; on others a pixel
    counts by its probability, so that gradients flow and a faint line is a line with less weight. Rows are
    scanned for steep boundaries and columns for shallow ones. A representative vertex is the mean of its
    stretch of the boundary, not one sample of it.

    Vertex i of 2S along a boundary is paired with vertex i + S: each is used once, so end points' errors are
    independent, and every segment is half as long as the boundary. It is as sure as the less sure of them.
    """

    def __init__(self, config: LineConfig | None = None) -> None:
        super().__init__()
        self.config = config or LineConfig()

    @classmethod
    def for_network(cls, network: SegmenterConfig, correlation: float = NETWORK_CORRELATION) -> LineExtractor:
        """As a network's maps are to be read; single frames, where nothing lasts, want no ``correlation``."""
        stride, factor = network.output_stride, network.sigma_scale
        return cls(LineConfig(stride=stride, sigma_scale=factor, correlation=correlation))

    @full_precision
    def forward(
        self, logits: Tensor, image_size: tuple[int, int], network_size: tuple[int, int] | None = None
    ) -> LaneSegments:
        """Extract.

        Args:
            logits: (B, 1+L, h, w), background first; of half precision they are raised to float32.
            image_size: (H, W) of the image in whose pixels the segments are wanted.
            network_size: (H', W') of the same image, resized, as the network had it; None is the map's size
                times the stride.

        Returns:
            Segments with N = L·S, in pixels of the image as it came (undistorted if that was).

        Raises:
            ValueError: another shape, or a map that is not of the network's input by the stride.
        """
        check_tensor("logits", logits)
        if logits.ndim != 4 or logits.shape[1] < 2:
            raise ValueError(f"logits: expected (B, 1+L, h, w), got {tuple(logits.shape)}")
        return extract_segments(logits.softmax(1)[:, 1:], image_size, self.config, network_size)


@full_precision
def extract_segments(
    probabilities: Tensor,
    image_size: tuple[int, int],
    config: LineConfig,
    network_size: tuple[int, int] | None = None,
) -> LaneSegments:
    """Probability maps (B, L, h, w), without background, to segments; see :class:`LineExtractor`."""
    if probabilities.ndim != 4:
        raise ValueError(f"probabilities: expected (B, L, h, w), got {tuple(probabilities.shape)}")
    batch, boundaries, rows, columns = probabilities.shape
    if network_size is None:
        network_size = (rows * config.stride, columns * config.stride)
    expected = tuple(-(-side // config.stride) for side in network_size)
    if (rows, columns) != expected:
        raise ValueError(
            f"maps: expected {expected[0]} x {expected[1]}, the network's input by the extractor's stride of "
            f"{config.stride}, got {rows} x {columns}; see LineExtractor.for_network"
        )
    vertices = representative_vertices(scan_vertices(probabilities, config), config)
    scale = probabilities.new_tensor([image_size[1] / network_size[1], image_size[0] / network_size[0]])
    points = (config.stride * vertices.points + 0.5) * scale - 0.5  # network pixel s·j under cell j
    half = (vertices.density > 0).sum(-1) // 2  # (B, L) pairs; vertices are filled from the front
    first = torch.arange(config.segments, device=points.device).expand(batch, boundaries, -1)
    second = (first + half.unsqueeze(-1)).clamp(max=2 * config.segments - 1)
    ends = torch.stack([take(points, first), take(points, second)], dim=-2)  # (B, L, S, 2, 2)
    weight = torch.minimum(vertices.weight.gather(-1, first), vertices.weight.gather(-1, second))
    weight = torch.where(first < half.unsqueeze(-1), weight, 0.0)
    along = (ends[..., 1, :] - ends[..., 0, :]).square()  # (B, L, S, 2)
    shrink = (along / scale.square()).sum(-1) / along.sum(-1).clamp(min=1e-12)
    stretch = config.stride * scale.prod() * shrink.clamp(min=1e-12).sqrt()  # areas keep their ratio
    variance = vertices.common_var + vertices.own_var
    sigma = (0.5 * (variance.gather(-1, first) + variance.gather(-1, second))).sqrt() * stretch
    sigma = config.sigma_scale * sigma
    if config.correlation > 0:
        sigma = sigma * _redundancy(points[..., 1], vertices.density > 0, config.correlation).unsqueeze(-1)
    seen = weight > 0
    index = torch.arange(boundaries, device=points.device).view(1, -1, 1).expand_as(first)
    return LaneSegments(
        endpoints=torch.where(seen[..., None, None], ends, 0.0).flatten(1, 2),
        boundary=index.flatten(1),
        weight=weight.flatten(1),
        sigma=torch.where(seen, sigma, 1.0).flatten(1),
    )


def undistort_segments(
    segments: LaneSegments, intrinsics: Tensor, distortion: Tensor | None, model: str = "pinhole"
) -> LaneSegments:
    """Segments in pixels of the image as it came to undistorted ones, their sigmas too.

    Segments with an end that the lens cannot have imaged have weight zero. In a row whose lens can't be used
    all have weight zero, and the gradient of the others stays finite.

    Args:
        segments: (B, N).
        intrinsics: (B, 3, 3) px.
        distortion: (B, D), or None for an ideal lens.
        model: "pinhole", "fisheye" or "omni".
    """
    if distortion is None or distortion.shape[-1] == 0:
        return segments
    good = usable_cameras(intrinsics) & distortion.isfinite().all(-1)  # (B,)
    segments = segments._replace(weight=torch.where(good.unsqueeze(-1), segments.weight, 0.0))
    intrinsics = torch.where(good[:, None, None], intrinsics, placeholder_intrinsics(intrinsics))
    distortion = torch.where(good.unsqueeze(-1), distortion, 0.0)
    lens = (intrinsics, distortion, model)
    flat, valid = invert_distortion(segments.endpoints.flatten(1, 2), *lens)
    whole = valid.unflatten(1, (-1, 2)).all(-1)
    segments = segments._replace(weight=torch.where(whole, segments.weight, 0.0))
    ends = flat.reshape(segments.endpoints.shape)
    along = (ends[..., 1, :] - ends[..., 0, :]).repeat_interleave(2, dim=1)
    sigma = undistorted_sigma(segments.sigma.repeat_interleave(2, dim=1), flat, along, *lens)
    variance = sigma.square().unflatten(1, (-1, 2)).mean(-1)  # of both ends
    variance = torch.where(segments.weight > 0, variance, segments.sigma.square())
    return segments._replace(endpoints=ends, sigma=variance.sqrt())


def _redundancy(y: Tensor, there: Tensor, correlation: float) -> Tensor:
    """(B, L) at least 1, by which V vertices (B, L, V) of a line are less sure than independent ones."""
    low, high = (torch.where(there, y.detach(), end) for end in (torch.inf, -torch.inf))
    extent = (high.amax(-1) - low.amin(-1)).clamp(min=0.5 * correlation)  # also where there are none
    return (there.sum(-1) * correlation / extent).clamp(min=1.0).sqrt()
