"""Probability maps to boundary vertices in pixels of the image, differentiable in the probabilities."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lanebev.batch import readable
from lanebev.geometry.precision import full_precision
from lanebev.observation.boundary_vertices import BoundaryVertices, line_directions, move_to_front
from lanebev.observation.scans import scan_vertices
from lanebev.observation.segmenter import SegmenterConfig
from lanebev.observation.segments import LaneSegments, pair_vertices
from lanebev.observation.vertices import LineConfig, representative_vertices
from lanebev.tensors import constant
from lanebev.types import check_tensor, check_type

NETWORK_CORRELATION = 10.0
"""``LineConfig.correlation`` of a network, px: how far along a line its errors are one error."""

_OFF_ONE = 0.02  # most by which a sum of probabilities of half precision is off


class LineExtractor(nn.Module):
    """Converts logits to the vertices of lane boundaries, or to :class:`~lanebev.LaneSegments`.

    Source: Sect. "Experiments": where a boundary's probability is larger than 0.5, the mean position of its
    on-pixels, then representative vertices. Deviation: pixels are weighted by their probability, so that
    gradients flow and a faint line has less weight; on maps of zeros and ones this is the paper's rule. Rows
    are scanned for steep boundaries and columns for shallow ones. A representative vertex is the mean of its
    stretch of the boundary, not one sample of it.
    """

    def __init__(self, config: LineConfig | None = None) -> None:
        super().__init__()
        check_type("config", config, LineConfig)
        self.config = config or LineConfig()

    @classmethod
    def for_network(cls, network: SegmenterConfig, correlation: float = NETWORK_CORRELATION) -> LineExtractor:
        """Return the extractor for a network's maps; single frames are calibrated without ``correlation``."""
        stride, factor = network.output_stride, network.sigma_scale
        return cls(LineConfig(stride=stride, sigma_scale=factor, correlation=correlation))

    def forward(
        self, logits: Tensor, image_size: tuple[int, int], network_size: tuple[int, int] | None = None
    ) -> LaneSegments:
        """Extract segments in pixels of the given image; they are undistorted only if the image is.

        Args:
            logits: as for :meth:`vertices`.
            image_size: as for :meth:`vertices`.
            network_size: as for :meth:`vertices`.

        Returns:
            Segments with N = L·S.

        Raises:
            ValueError: as for :meth:`vertices`.
        """
        return pair_vertices(self.vertices(logits, image_size, network_size))

    @full_precision
    def vertices(
        self, logits: Tensor, image_size: tuple[float, float], network_size: tuple[int, int] | None = None
    ) -> BoundaryVertices:
        """Extract vertices, which :func:`~lanebev.observation.segments.segments_from_vertices` pairs.

        Args:
            logits: (B, 1+L, h, w), background first; half precision is converted to float32.
            image_size: (H, W) of the image in whose pixels the vertices are returned.
            network_size: (H', W') of the network's input, the resized image; None is the map's size times
                the stride.

        Returns:
            Vertices of L boundaries, at most 2S on each, those with a weight first.

        Raises:
            ValueError: another shape, or a map that is not of the network's input by the stride; on the CPU
                also probabilities.
        """
        check_tensor("logits", logits)
        if logits.ndim != 4 or logits.shape[1] < 2:
            raise ValueError(f"logits: expected (B, 1+L, h, w), got {tuple(logits.shape)}")
        if not logits.is_floating_point():
            raise ValueError(f"logits: expected floating point, got {logits.dtype}")
        if _are_probabilities(logits):
            raise ValueError(
                "logits: expected those before the softmax, got probabilities; leave the softmax out"
            )
        return extract_vertices(logits.softmax(1)[:, 1:], image_size, self.config, network_size)


@full_precision
def extract_vertices(
    probabilities: Tensor,
    image_size: tuple[float, float],
    config: LineConfig,
    network_size: tuple[int, int] | None = None,
) -> BoundaryVertices:
    """Extract vertices from probability maps (B, L, h, w), without background; see :class:`LineExtractor`."""
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
    found = representative_vertices(scan_vertices(probabilities, config), config)
    resized = (image_size[1] / network_size[1], image_size[0] / network_size[0])
    scale = constant(resized, like=probabilities)
    offset = constant(tuple(0.5 * side - 0.5 for side in resized), like=probabilities)
    points = config.stride * scale * found.points + offset  # network pixel s·j under cell j
    weight = torch.where(found.weight >= config.least_weight, found.weight, 0.0)
    stretch = _across_scale(line_directions(points, found.density > 0), scale)
    sigma = (config.sigma_scale * config.stride) * stretch * (found.common_var + found.own_var).sqrt()
    if config.correlation > 0:
        sigma = sigma * _redundancy(points[..., 1], weight > 0, config.correlation).unsqueeze(-1)
    index = torch.arange(boundaries, device=points.device).expand(batch, -1)
    return move_to_front(BoundaryVertices(points, weight, sigma, index))


def extract_segments(
    probabilities: Tensor,
    image_size: tuple[int, int],
    config: LineConfig,
    network_size: tuple[int, int] | None = None,
) -> LaneSegments:
    """Extract segments from probability maps (B, L, h, w), without background; see :class:`LineExtractor`."""
    return pair_vertices(extract_vertices(probabilities, image_size, config, network_size))


def _are_probabilities(logits: Tensor) -> bool:
    """Return whether maps (B, 1+L, h, w), where they can be read, are at least 0 and their sums 1."""
    if not readable(logits) or logits.numel() == 0 or bool(logits.detach().amin() < 0):
        return False
    return bool(((logits.detach().sum(1) - 1).abs() < _OFF_ONE).all())


def _across_scale(along: Tensor, scale: Tensor) -> Tensor:
    """Compute by how much distances across a line grow where an image is resized.

    Areas grow by the product of the two scales and lengths along the line by s, so distances across by
    their ratio.

    Args:
        along: (..., 2) direction of the line after it, of any length.
        scale: (2,) of x and y.

    Returns:
        (...,); the geometric mean of the scales where there is no direction.
    """
    squared = along.square()
    length = squared.sum(-1)
    known = length > 1e-12
    shrink = (squared / scale.square()).sum(-1) / torch.where(known, length, 1.0)  # 1 / s²
    return scale.prod() * torch.where(known, shrink, 1 / scale.prod()).sqrt()


def _redundancy(y: Tensor, there: Tensor, correlation: float) -> Tensor:
    """Return (B, L): the factor, at least 1, by which the vertices (B, L, V) of a line are redundant."""
    low, high = (torch.where(there, y.detach(), end) for end in (torch.inf, -torch.inf))
    extent = (high.amax(-1) - low.amin(-1)).clamp(min=0.5 * correlation)  # also where there are none
    return (there.sum(-1) * correlation / extent).clamp(min=1.0).sqrt()
