"""Images to per-boundary logits: an FCN on ResNet-18."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lanebev.observation.frames import check_scale
from lanebev.observation.resnet import ResNet18
from lanebev.tensors import constant
from lanebev.types import NUM_BOUNDARIES, check_tensor, check_type

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class SegmenterConfig:
    """Shape of a :class:`LaneSegmenter`.

    Attributes:
        num_boundaries: L, semantic lane boundaries.
        base_width: channels of the trunk's first stage; 64 is ResNet-18.
        trunk_stride: 8, 16 or 32; below 32 the trunk's last stages are dilated.
        output_stride: 1, 2 or 4 input pixels per logit.
        decoder_width: channels of the decoder.
        context: reach, in cells of stride 8, of each message passing step along the lanes.
        image_size: (height, width) that the weights were trained for; other sizes are less accurate.
        sigma_scale: factor on the standard deviation of every line vertex, measured for the weights. It makes
            up for errors of the network that are correlated along a line.
        pose_sigma_scale: factor on the standard deviations of the estimated pose, measured for the weights.
            The network's errors are correlated over frames, which a filter takes as independent. Larger
            vertex sigmas instead would also hide outliers.
    """

    num_boundaries: int = NUM_BOUNDARIES
    base_width: int = 64
    trunk_stride: int = 32
    output_stride: int = 2
    decoder_width: int = 48
    context: tuple[int, ...] = (1, 2, 4, 8)
    image_size: tuple[int, int] = (192, 320)
    sigma_scale: float = 1.0
    pose_sigma_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.num_boundaries < 1:
            raise ValueError(f"num_boundaries: expected at least 1, got {self.num_boundaries}")
        if self.output_stride not in (1, 2, 4):
            raise ValueError(f"output_stride: expected 1, 2 or 4, got {self.output_stride}")
        if len(self.image_size) != 2 or min(self.image_size) < 1:
            raise ValueError(f"image_size: expected (height, width) above 0, got {self.image_size}")
        if not self.sigma_scale > 0:
            raise ValueError(f"sigma_scale: expected more than 0, got {self.sigma_scale}")
        if not self.pose_sigma_scale > 0:
            raise ValueError(f"pose_sigma_scale: expected more than 0, got {self.pose_sigma_scale}")
        if self.base_width < 1:
            raise ValueError(f"base_width: expected at least 1, got {self.base_width}")
        if self.decoder_width < 4:
            raise ValueError(f"decoder_width: expected at least 4, got {self.decoder_width}")


class LaneSegmenter(nn.Module):
    """Segmentation network with one class per semantic lane boundary, and background.

    Source: Sect. "Experiments", FCN (Shelhamer et al. 2017) on ResNet-18. Deviation: the skips fuse features
    instead of scores, and strip convolutions pass messages along the lanes (after Pan et al. 2018 and Zheng
    et al. 2021), so that a dashed line becomes one line.

    Logit (i, j) is centred on input pixel (x, y) = (s·j, s·i), with s the output stride (see
    :class:`~lanebev.observation.resnet.ResNet18`).
    """

    def __init__(self, config: SegmenterConfig | None = None) -> None:
        super().__init__()
        check_type("config", config, SegmenterConfig)
        self.config = config = config or SegmenterConfig()
        width = config.decoder_width
        self.trunk = ResNet18(config.base_width, config.trunk_stride)
        stem, *skips = self.trunk.widths
        self.fine = nn.Conv2d(stem, 8, 1)
        self.lateral = nn.ModuleList(nn.Conv2d(channels, width, 1) for channels in skips)
        self.position = nn.Conv2d(2, width, 1)
        self.context = nn.ModuleList(StripMessage(width, reach) for reach in config.context)
        self.unfold = nn.Conv2d(32, width, 1)
        self.refine = nn.Conv2d(width, 32, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(32)
        self.shuffle = 4 // config.output_stride
        self.head = nn.Conv2d(32, (1 + config.num_boundaries) * self.shuffle**2, 1)
        nn.init.normal_(self.head.weight, std=0.01)

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) that the weights were trained for."""
        return self.config.image_size

    def forward(self, image: Tensor) -> Tensor:
        """Compute the logits of images.

        Args:
            image: (B, 3, H, W) RGB in [0, 1], any size; converted to the dtype of the network.

        Returns:
            (B, 1+L, ceil(H/s), ceil(W/s)) logits: background is channel 0, boundary k is channel 1+k.

        Raises:
            TypeError: not a tensor.
            ValueError: another shape, or whole numbers; on the CPU also values far beyond 0 or 1.
        """
        check_tensor("image", image)
        if image.ndim != 4 or image.shape[1] != 3:
            raise ValueError(f"image: expected (B, 3, H, W), got {tuple(image.shape)}")
        if not image.is_floating_point():
            raise ValueError(
                f"image: expected floating point in [0, 1], got {image.dtype}; divide bytes by 255"
            )
        check_scale("image", image)
        image = image.to(self.head.weight.dtype)
        mean, std = (constant(each, like=image).view(3, 1, 1) for each in (IMAGENET_MEAN, IMAGENET_STD))
        stem, c2, c3, c4, c5 = self.trunk(self._in_order((image - mean) / std))
        lateral2, lateral3, lateral4, lateral5 = self.lateral
        x = lateral5(c5) + self.position(_positions(c5))
        x = lateral4(c4) + upsample_aligned(x, c4.shape[-2:])
        x = F.relu(lateral3(c3) + upsample_aligned(x, c3.shape[-2:]))
        for message in self.context:
            x = message(x)
        x = (
            lateral2(c2)
            + upsample_aligned(x, c2.shape[-2:])
            + self.unfold(_fold(self.fine(stem), c2.shape[-2:]))
        )
        x = F.relu(self.norm(self.refine(F.relu(x))))
        logits = F.pixel_shuffle(self.head(x), self.shuffle)
        stride = self.config.output_stride
        cropped = logits[..., : -(-image.shape[-2] // stride), : -(-image.shape[-1] // stride)]
        return cropped.contiguous()

    def _in_order(self, image: Tensor) -> Tensor:
        """Return images (B, C, H, W) in channels-last order, in which convolutions take less time.

        Networks of other widths stay as they are: gradients of convolutions of four channels in this order
        corrupt the memory (torch 2.13, CPU).
        """
        if self.config.base_width % 8 or self.config.decoder_width % 8:
            return image
        # contiguous(memory_format=...) does not work in torch.vmap
        return image.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)


class StripMessage(nn.Module):
    """A message along the lanes: three rows ``reach`` cells apart, nine columns wide, as a residual.

    Source: Pan et al. 2018 (SCNN), with the sequential pass over rows replaced by doubling reaches as in
    Zheng et al. 2021 (RESA), and the 3×9 kernel by a 3×1 and a 1×9.
    """

    def __init__(self, channels: int, reach: int) -> None:
        super().__init__()
        self.down = nn.Conv2d(channels, channels, (3, 1), padding=(reach, 0), dilation=(reach, 1))
        self.across = nn.Conv2d(channels, channels, (1, 9), padding=(0, 4), bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        return x + F.relu(self.norm(self.across(F.relu(self.down(x)))))


def upsample_aligned(x: Tensor, size: torch.Size | tuple[int, int]) -> Tensor:
    """Double a map so that fine cell 2i is coarse cell i and fine cell 2i+1 the mean of its neighbours.

    Args:
        x: (B, C, h, w).
        size: (H, W), 2h - 1 or 2h by 2w - 1 or 2w; (h, w) itself returns x.

    Returns:
        (B, C, H, W); a last row or column without a right neighbour repeats its left one.
    """
    if tuple(size) == tuple(x.shape[-2:]):
        return x
    height, width = x.shape[-2:]
    padded = torch.cat([x, x[..., -1:, :]], dim=-2)
    padded = torch.cat([padded, padded[..., -1:]], dim=-1)
    doubled = F.interpolate(padded, (2 * height + 1, 2 * width + 1), mode="bilinear", align_corners=True)
    return doubled[..., : size[0], : size[1]]


def _fold(x: Tensor, size: torch.Size) -> Tensor:
    """Return stride-2 cells (2i, 2i+1) as channels of stride-4 cell i: (B, C, ·, ·) to (B, 4C, *size)."""
    padded = F.pad(x, (0, 2 * size[1] - x.shape[-1], 0, 2 * size[0] - x.shape[-2]))
    if x.shape[0] == 0:  # torch 2.13 makes no channels of it
        return padded.reshape(0, 4 * x.shape[1], *size)
    return F.pixel_unshuffle(padded, 2)


def _positions(features: Tensor) -> Tensor:
    """Return x and y of each cell, -1 to 1 over the map, (B, 2, h, w); a program computes them for any size.

    ONNX would have ``linspace`` as a constant.
    """
    y, x = (
        (2 * torch.arange(size, dtype=features.dtype, device=features.device) - (size - 1)) / max(size - 1, 1)
        for size in features.shape[-2:]
    )
    return torch.stack(torch.meshgrid(y, x, indexing="ij")).flip(0).expand(features.shape[0], -1, -1, -1)
