"""Cameras, poses and a grid of the tests of views, and their check of gradients."""

import torch

from lanebev import BEVGrid, Camera, Extrinsics

GRID = BEVGrid(x=(-4.0, 4.0), z=(5.0, 25.0), resolution=0.1)
CAMERA = Camera.from_parameters(300.0, 300.0, 160.0, 90.0, 320, 180)
LENS = Camera.from_parameters(300.0, 300.0, 160.0, 90.0, 320, 180, [-0.2, 0.03, 0.001, -0.001, 0.0])
LENSES = [  # distortion and model of every kind
    ((), "pinhole"),
    ((-0.2, 0.03, 0.001, -0.001), "pinhole"),
    ((-0.2, 0.03, 0.001, -0.001, 0.01), "pinhole"),
    ((-0.2, 0.03, 0.001, -0.001, 0.01, 0.1, 0.05, 0.01), "pinhole"),
    ((-0.2, 0.03, 0.001, -0.001, 0.01, 0.1, 0.05, 0.01, 1e-3, 1e-4, -1e-3, 2e-4), "pinhole"),
    ((-0.2, 0.03, 1e-3, -1e-3, 0.01, 0.1, 0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.02, -0.01), "pinhole"),
    ((0.9, -0.2, 0.03, 0.001, -0.001), "omni"),
    ((-0.05, 0.01, -0.003, 0.001), "fisheye"),
]


def pose(*rows, dtype=torch.float64):
    """Extrinsics of rows of pitch, yaw, roll, height."""
    return Extrinsics.unstack(torch.tensor(rows, dtype=dtype))


def has_gradient(view, shape, values, lens=()):
    """Whether ``view(image, extrinsics, *lens)`` has the gradient of finite differences in all of them."""
    image = torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inputs = [image, *(torch.tensor([row], dtype=torch.float64) for row in (values, *lens))]
    return torch.autograd.gradcheck(
        lambda image, rows, *lens: view(image, Extrinsics.unstack(rows), *lens),
        [each.requires_grad_() for each in inputs],
        atol=1e-6,
    )
