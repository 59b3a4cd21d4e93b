"""Embed lanebev in a network: resample its features to a bird's-eye view by the pose from the same image."""

import torch
from torch import nn

import lanebev


class Detector(nn.Module):
    def __init__(self):
        super().__init__()
        self.trunk = nn.Conv2d(3, 16, kernel_size=7, stride=8, padding=3)
        self.lanes = lanebev.LaneBEV.from_pretrained(grid=lanebev.BEVGrid(resolution=0.5))
        self.head = nn.Conv2d(16, 1, kernel_size=3, padding=1)

    def forward(self, image, intrinsics, state=None):
        out, state = self.lanes(image, intrinsics, state, dt=1 / 30)
        pose, size = out.calibration.extrinsics, image.shape[-2:]
        bev, _ = self.lanes.warp(self.trunk(image), intrinsics, pose, image_size=size, strides=8)
        return self.head(bev), state.detach()


intrinsics = torch.tensor([[[250.0, 0, 159.5], [0, 250.0, 95.5], [0, 0, 1]]])
scores, state = Detector()(torch.rand(1, 3, 192, 320), intrinsics)
scores.sum().backward()
print(scores.shape, state.status)
