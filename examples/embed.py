"""Warp the features of a network to the road by the pose that the same images give, and train through it."""

import torch

import lanebev

model = lanebev.LaneBEV.from_pretrained()
trunk = torch.nn.Conv2d(3, 8, 3, stride=8, padding=1)
warp = lanebev.BEVWarp(lanebev.BEVGrid(x=(-10, 10), z=(5, 45), resolution=0.5))
images = torch.rand(1, 2, 3, 192, 320)  # (B, T, 3, H, W)
intrinsics = torch.tensor([[[260.0, 0, 159.5], [0, 260.0, 95.5], [0, 0, 1]]])
state = None
for image in images.unbind(1):
    out, state = model(image, intrinsics, state, dt=0.1)
    bev, valid = warp(trunk(image), intrinsics, out.calibration.extrinsics, image_size=(192, 320))
    bev[valid.expand_as(bev)].square().mean().backward()
    state = state.detach()
print(bev.shape, float(trunk.weight.grad.norm()))
