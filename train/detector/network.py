"""A small detector: image features, bird's-eye features by the pose, CenterPoint's maps."""

import torch
from torch import Tensor, nn

from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid
from lanebev.view.warp import BEVWarp
from train.detector.targets import CHANNELS

STRIDE = 4


def _layer(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, dilation, dilation, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class VehicleDetector(nn.Module):
    """Vehicles on the road from one image and the pose of its camera.

    Args:
        grid: grid of the bird's-eye view.
        width: channels of the image features.
        bev_width: channels of the bird's-eye features.
        top: px of the image above which nothing is used.
    """

    def __init__(self, grid: BEVGrid, width: int = 32, bev_width: int = 48, top: int = 96) -> None:
        super().__init__()
        self.top = top
        self.trunk = nn.Sequential(
            _layer(3, 16, stride=2), _layer(16, width, stride=2), _layer(width, width), _layer(width, width)
        )
        self.warp = BEVWarp(grid)
        self.neck = nn.Sequential(
            _layer(width + 2, bev_width),
            _layer(bev_width, bev_width, dilation=2),
            _layer(bev_width, bev_width, dilation=4),
            _layer(bev_width, bev_width),
        )
        self.head = nn.Conv2d(bev_width, CHANNELS, 1)
        self.rare: Tensor
        rare = torch.tensor([-4.0] + [0.0] * (CHANNELS - 1)).view(-1, 1, 1)  # as centres are
        self.register_buffer("rare", rare, persistent=False)
        place = grid.cells().permute(2, 0, 1) / grid.z[1]
        self.place: Tensor
        self.register_buffer("place", place, persistent=False)

    def features(self, image: Tensor) -> Tensor:
        """Compute features (B, C, h, w) of the rows from ``top`` on of images (B, 3, H, W) in [0, 1]."""
        taken: Tensor = self.trunk(image[:, :, self.top :] - 0.45)
        return taken

    def detect(
        self, features: Tensor, intrinsics: Tensor, extrinsics: Extrinsics, image_size: tuple[int, int]
    ) -> Tensor:
        """Convert features to maps (B, 7, U, V).

        Args:
            features: (B, C, h, w).
            intrinsics: (B, 3, 3) px of the whole image.
            extrinsics: each (B,).
            image_size: (H, W) of the whole image.
        """
        shift = intrinsics.new_tensor([[0.0, 0.0, 0.0], [0.0, 0.0, self.top], [0.0, 0.0, 0.0]])
        size = (image_size[0] - self.top, image_size[1])
        bev, _ = self.warp(features, intrinsics - shift, extrinsics, image_size=size, strides=STRIDE)
        place = self.place.expand(len(bev), -1, -1, -1)
        maps: Tensor = self.head(self.neck(torch.cat([bev, place], dim=1))) + self.rare
        return maps

    def forward(self, image: Tensor, intrinsics: Tensor, extrinsics: Extrinsics) -> Tensor:
        """Convert images (B, 3, H, W) in [0, 1] to maps (B, 7, U, V)."""
        size = (image.shape[-2], image.shape[-1])
        return self.detect(self.features(image), intrinsics, extrinsics, size)
