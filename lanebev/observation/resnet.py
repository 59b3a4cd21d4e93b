"""The ResNet-18 trunk, with torchvision's parameter names."""

from collections.abc import Mapping

import torch.nn.functional as F
from torch import Tensor, nn

STRIDES = (2, 4, 8, 16, 32)
"""Strides of the five feature maps without dilation."""


class BasicBlock(nn.Module):
    """Two 3×3 convolutions and the identity.

    Source: He et al. 2016, Fig. 5 left.
    """

    def __init__(self, in_channels: int, channels: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.conv1 = _conv3x3(in_channels, channels, stride, dilation)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = _conv3x3(channels, channels, 1, dilation)
        self.bn2 = nn.BatchNorm2d(channels)
        self.stride = stride
        self.downsample: nn.Module | None = None
        if stride != 1 or in_channels != channels:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_channels, channels, 1, bias=False), nn.BatchNorm2d(channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, channels, ceil(H / stride), ceil(W / stride))."""
        # no stride of the 1 × 1 convolution: its gradient crashes in channels-last order (torch 2.13, CPU)
        identity = x if self.downsample is None else self.downsample(x[..., :: self.stride, :: self.stride])
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        return F.relu(self.bn2(self.conv2(x)) + identity, inplace=True)


class ResNet18(nn.Module):
    """ResNet-18 without its classifier: an image to five feature maps.

    All strided layers have odd kernels and symmetric padding, so cell (i, j) of the map of stride s is
    centred exactly on input pixel (s·j, s·i), at every level.

    Args:
        base_width: channels of the first stage; 64 is ResNet-18.
        output_stride: 8, 16 or 32: stride of the last map; later strides become dilation.

    Raises:
        ValueError: another output stride, or a width below 1.
    """

    def __init__(self, base_width: int = 64, output_stride: int = 32) -> None:
        super().__init__()
        if output_stride not in (8, 16, 32):
            raise ValueError(f"output_stride: expected 8, 16 or 32, got {output_stride}")
        if base_width < 1:
            raise ValueError(f"base_width: expected at least 1, got {base_width}")
        widths = tuple(base_width * factor for factor in (1, 1, 2, 4, 8))
        self.widths = widths
        self.conv1 = nn.Conv2d(3, widths[0], 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(widths[0])
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.layer1 = _stage(widths[0], widths[1])
        self.layer2 = _stage(widths[1], widths[2], stride=2)
        self.layer3 = _stage(widths[2], widths[3], *((2, 1) if output_stride >= 16 else (1, 2)))
        self.layer4 = _stage(
            widths[3], widths[4], *((2, 1) if output_stride == 32 else (1, 32 // output_stride))
        )
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            if isinstance(module, BasicBlock):
                nn.init.zeros_(module.bn2.weight)  # every block starts as the identity (Goyal et al. 2017)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Map (B, 3, H, W), normalised, to five (B, widths[i], ceil(H/s), ceil(W/s)), s = STRIDES[i]."""
        c1 = F.relu(self.bn1(self.conv1(image)), inplace=True)
        c2 = self.layer1(self.maxpool(c1))
        c3 = self.layer2(c2)
        c4 = self.layer3(c3)
        return c1, c2, c3, c4, self.layer4(c4)

    def load_torchvision(self, state_dict: Mapping[str, Tensor]) -> None:
        """Load torchvision's ResNet-18 weights, strictly but for the classifier, which is not here."""
        self.load_state_dict({k: v for k, v in state_dict.items() if not k.startswith("fc.")}, strict=True)


def _conv3x3(in_channels: int, channels: int, stride: int, dilation: int) -> nn.Conv2d:
    return nn.Conv2d(in_channels, channels, 3, stride, dilation, dilation, bias=False)


def _stage(in_channels: int, channels: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        BasicBlock(in_channels, channels, stride, dilation), BasicBlock(channels, channels, 1, dilation)
    )
