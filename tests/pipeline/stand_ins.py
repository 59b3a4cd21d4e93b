"""A LaneBEV whose network and line extraction are stand-ins: quick, and right about known lanes."""

import torch
from torch import nn

from lanebev import (
    BEVGrid,
    BEVWarp,
    LaneBEV,
    LaneSegmenter,
    LaneSegments,
    LineExtractor,
    SegmenterConfig,
    TwoStageCalibrator,
)
from lanebev.geometry.lens import distort_points
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes

GRID = BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5)
SIZE = (72, 128)
SCALE = 0.1  # of K, made for 1280 × 720
INTRINSICS = torch.diag(torch.tensor([SCALE, SCALE, 1.0], dtype=torch.float64)) @ K


class BrightnessSegmenter(nn.Module):
    """Stands in for the network: logits that depend on the image, so that gradients have a way back."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(0.1, dtype=torch.float64))
        self.seen = []

    def forward(self, image):
        self.seen.append(tuple(image.shape))
        return self.gain * image.mean(1, keepdim=True).repeat(1, 7, 1, 1)


class FixedExtractor(nn.Module):
    """Vertices of true segments, shifted a little by the logits."""

    def __init__(self, distortion=None):
        super().__init__()
        self.distortion = distortion

    def vertices(self, logits, image_size, network_size):
        assert image_size == SIZE
        assert network_size in (SIZE, (32, 64))
        batch = logits.shape[0]
        segments = LaneSegments(*(v.expand(batch, *v.shape[1:]) for v in lanes(noise=0.0)))
        points = SCALE * segments.endpoints.unflatten(1, (6, 8)).transpose(2, 3).flatten(
            2, 3
        )  # (B, 6, 16, 2)
        if self.distortion is not None:
            flat = distort_points(points.flatten(1, 2), INTRINSICS.expand(batch, 3, 3), self.distortion)
            points = flat.view_as(points)
        points = points + 0.01 * logits.mean((1, 2, 3))[:, None, None, None]
        weight, sigma = (v.unflatten(1, (6, 8)).repeat(1, 1, 2) for v in (segments.weight, segments.sigma))
        return BoundaryVertices(points, weight, 0.1 * sigma, segments.boundary.unflatten(1, (6, 8))[..., 0])


def model(**kwargs):
    return LaneBEV(
        BrightnessSegmenter(), FixedExtractor(kwargs.pop("distortion", None)), TwoStageCalibrator(),
        BEVWarp(GRID), **kwargs,
    )  # fmt: skip


def small_model(calibrator=None, seed=0):
    """A real network, untrained and small, with a real extractor, in single precision."""
    torch.manual_seed(seed)
    config = SegmenterConfig(base_width=4, decoder_width=8)
    calibrator = calibrator or TwoStageCalibrator()
    return LaneBEV(LaneSegmenter(config), LineExtractor.for_network(config), calibrator, BEVWarp(GRID))


def images(*shape, seed=0):
    return torch.rand(*shape, 3, *SIZE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
