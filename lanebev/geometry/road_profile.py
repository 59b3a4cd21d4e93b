"""The road's height profile, h + κ Z²/2 below the camera, and where directions meet it."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.types import check_tensor

FARTHEST = 200.0  # m; beyond it a pixel is tens of metres, and the shape of the road is not known

_BEFORE_CREST = 0.8  # of the distance at which a crest hides the road, up to which points are on the road

_AHEAD = 1e-3  # smallest component ahead of the direction of a point in front of the camera


def check_vertical_curvature(curvature: Tensor, batch: int) -> None:
    """Raise TypeError or ValueError unless this is a tensor (B,)."""
    check_tensor("vertical_curvature", curvature)
    if curvature.shape != (batch,):
        raise ValueError(
            f"vertical_curvature: expected ({batch},) 1/m, one for each camera, got {tuple(curvature.shape)}"
        )


class Profile(NamedTuple):
    """The road below the camera's path, h + κ Z²/2.

    Attributes:
        height: (B, 1) m, h, of the camera over the road below it.
        curvature: (B, 1) 1/m, κ, positive over a crest.
        least_slope: (B, 1), down by ahead, of the direction to the farthest point of the road.
    """

    height: Tensor
    curvature: Tensor
    least_slope: Tensor


def road_profile(height: Tensor, curvature: Tensor) -> Profile:
    """Return the profile of a height (B, 1) m and a vertical curvature (B, 1) 1/m.

    Its farthest point is at ``FARTHEST``, or nearer than where the sight touches a crest, √(2 h / κ).
    """
    positive = height.clamp(min=0.1)
    touching = 2 * _BEFORE_CREST**2 / FARTHEST**2 * positive  # 1/m, whose crest is as far as FARTHEST
    farthest = FARTHEST * (touching / torch.maximum(curvature, touching)).sqrt()
    return Profile(height, curvature, positive / farthest + 0.5 * curvature * farthest)


def meet_road(directions: Tensor, profile: Profile) -> Tensor:
    """Compute the distance Z (B, M) at which directions (B, 3, M) meet the road, at most the farthest.

    Source: (J1), for a vertical curvature the nearer root of κ Z²/2 - (d_y / d_z) Z + h = 0.
    """
    height, curvature, least = profile
    slope = torch.maximum(directions[:, 1] / directions[:, 2].clamp(min=_AHEAD), least)
    twice = 2 * height
    return twice / (slope + (slope * slope - curvature * twice).sqrt())


def meets_before_farthest(directions: Tensor, profile: Profile) -> Tensor:
    """Return (B, M) bool: these directions, (B, 3, M), meet the road before the farthest."""
    down, ahead = directions[:, 1], directions[:, 2]
    return (ahead > _AHEAD) & (down > ahead * profile.least_slope)


def before_farthest(directions: Tensor, profile: Profile) -> Tensor:
    """Return (B, N) bool: both end points, of directions (B, 3, 2 N), meet the road before the farthest."""
    first, second = meets_before_farthest(directions, profile).chunk(2, dim=-1)
    return first & second


def depth_below(height: Tensor, curvature: Tensor, z: Tensor) -> Tensor:
    """Compute how far the road is below the camera at a distance z, m: h + κ Z²/2, (J1).

    Args:
        height: m, h.
        curvature: 1/m, κ.
        z: m; the shapes of the three are broadcast.
    """
    return torch.addcmul(height, 0.5 * curvature, z * z)


def in_sight(height: Tensor, curvature: Tensor, z: Tensor) -> Tensor:
    """Return whether the road at a distance z can be seen over a crest.

    Source: the line through the camera that touches h + κ Z²/2 does so at Z = √(2 h / κ). The limit is 0.8 of
    that, as in :func:`road_profile`: beyond it a pixel is many metres of road. Arguments as of
    :func:`depth_below`.
    """
    return curvature * z * z < 2 * _BEFORE_CREST**2 * height
