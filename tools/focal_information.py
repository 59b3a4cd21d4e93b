"""Compute the Fisher information of lane boundaries on the focal length, on straights and in bends.

    python -m tools.focal_information

For each radius prints the standard deviation of the focal length, as a share of it, from one frame and from
a minute of independent frames (end points with a noise of 1 px; pose, place and curvature unknown), and by
how much the estimate would be off if the road's crossfall changed by 1 % over 100 m, if it had a crest of
10 km radius, and if one lane were 3 cm wider. On a straight road it is unknown, however many the frames.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.geometry.rotation import road_from_cam
from lanebev.testing.moments import CAMERA, IMAGE, PLACES
from train.commands import command_parser

RADII = (math.inf, 3000.0, 1000.0, 300.0, 150.0, 60.0)
POSE = (0.03, 0.02, 0.01, 1.5, 0.2)  # pitch, yaw, roll (rad), height, offset (m)
FOCAL = 7  # of the parameters: pose, offset, curvature, its change along the road, log focal length
UNEVEN = (1e-4, 1e-4, 0.03)  # 1/m of crossfall, 1/m of vertical curvature, m of a lane's width
FRAMES = 1800  # of a minute
_NEAR, _FAR, _POINTS, _STEPS = 5.0, 75.0, 60, 400


class Information(NamedTuple):
    """Information of one frame.

    Attributes:
        share: of the information about the focal length that is left when all else is unknown.
        std: standard deviation of the focal length, as a share of it.
        biases: (3,) errors of it by ``UNEVEN``.
    """

    share: float
    std: float
    biases: list[float]


def image_points(params: Tensor, uneven: Tensor) -> Tensor:
    """Project points of parallel boundaries on a bend, (6, S, 2) px.

    Args:
        params: (8,) see ``FOCAL``.
        uneven: (3,) change of crossfall (1/m), vertical curvature (1/m), error of the right lane's width (m).
    """
    pitch, yaw, roll, height, offset, curvature, change, log_focal = params.unbind()
    arc = torch.linspace(1 / _NEAR, 1 / _FAR, _POINTS, dtype=params.dtype).reciprocal()
    along = torch.linspace(0, 1, _STEPS, dtype=params.dtype).unsqueeze(-1) * arc
    heading = curvature * along + 0.5 * change * along.square()
    middle = [torch.trapezoid(part, dim=0) * arc / (_STEPS - 1) for part in (heading.sin(), heading.cos())]
    wider = uneven[2] * (torch.arange(6) == 5)
    side = (PLACES + offset + wider).unsqueeze(-1)
    x, z = middle[0] + side * heading[-1].cos(), middle[1] - side * heading[-1].sin()
    y = height + uneven[0] * arc * side + 0.5 * uneven[1] * arc.square()
    rays = torch.stack([x, y, z], dim=-1) @ road_from_cam(pitch, yaw, roll)
    scale = CAMERA.diagonal()[:2] * log_focal.exp()
    return scale * rays[..., :2] / rays[..., 2:] + CAMERA[:2, 2]


def frame_information(radius: float) -> Information:
    """Compute what a frame of boundaries in a bend of this radius (m) tells about the focal length."""
    params = torch.tensor([*POSE, 1 / radius, 0.0, 0.0], dtype=torch.float64)
    flat = torch.zeros(3, dtype=torch.float64)
    pixels = image_points(params, flat)
    by_params, by_uneven = torch.func.jacfwd(image_points, argnums=(0, 1))(params, flat)
    tangent = torch.gradient(pixels, dim=1)[0]
    normal = torch.stack([-tangent[..., 1], tangent[..., 0]], dim=-1) / tangent.norm(dim=-1, keepdim=True)
    inside = ((pixels >= 0) & (pixels <= pixels.new_tensor(IMAGE[::-1]) - 1)).all(-1)
    jacobian, disturbed = (
        (part * normal.unsqueeze(-1)).sum(-2)[inside] for part in (by_params, by_uneven)
    )  # (M, 8), (M, 3) px
    size = jacobian.norm(dim=0).clamp(min=1e-12)
    others = torch.arange(len(params)) != FOCAL
    basis = torch.linalg.qr((jacobian / size)[:, others]).Q
    own = jacobian[:, FOCAL] - basis @ (basis.mT @ jacobian[:, FOCAL])  # what nothing else explains
    info = own.square().sum()
    biases = disturbed.mT @ own / info * disturbed.new_tensor(UNEVEN)
    return Information(float(info / size[FOCAL] ** 2), float(info.rsqrt()), biases.tolist())


def main() -> None:
    parser = command_parser(__doc__)
    parser.parse_args()
    print(f"{'radius':>8} | one frame | a minute | crossfall, crest, wide lane")
    for radius in RADII:
        found = frame_information(radius)
        if found.share < 1e-9:
            print(f"{'straight':>8} | unknown: {found.share:.0e} of the information is left")
            continue
        by = "  ".join(f"{abs(bias):.1%}" for bias in found.biases)
        print(f"{radius:>6.0f} m | {found.std:>9.1%} | {found.std / math.sqrt(FRAMES):>8.2%} | {by}")


if __name__ == "__main__":
    main()
