"""How the road ahead moves in the state of the joint filter, between frames.

The road does not change, it comes nearer: knots of its curvature stand in the world, and the camera passes
them at a speed that is estimated too. What was seen far ahead so holds when it is near, and new is only
the step that comes into view. The frame turns along with the road.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lanebev.estimation import kalman
from lanebev.estimation.joint.dynamics import SHAPE, SPEED, STEPS, MotionConfig
from lanebev.estimation.joint.measurement import CURVATURE, KNOT_SPACING, NUM_STEPS
from lanebev.geometry.linalg import cholesky, inverse_spd, solve_lower

CLEAR_BEND = (20.0, 40.0)  # chi-square of the five steps of curvature between which they come to tell speed
ENTRY = KNOT_SPACING / 3  # m, way over which a step comes into view
_SLOPE = 0.5 * (np.eye(1 + NUM_STEPS) + np.eye(1 + NUM_STEPS, k=1))  # at a knot, by the steps about it
_SLOPE[0] = np.eye(1 + NUM_STEPS)[1]
_CHANGE = np.diff(_SLOPE, axis=0, prepend=0.0) / KNOT_SPACING  # of the shape parameters by a metre, 1/m


def come_nearer(
    mean: Tensor, cov: Tensor, phase: Tensor, dt: Tensor, cfg: MotionConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """The camera passes knots: shape parameters move up, and new steps come into view.

    Args:
        mean: (B, D) with the speed about its prior.
        cov: (B, D, D).
        phase: (B,) m, how far the first knot lies behind the camera.
        dt: (B,) s.
        cfg: the numbers.

    Returns:
        mean, covariance and phase after it.
    """
    way = dt * (cfg.speed + mean[:, SPEED]).clamp(min=0.0)
    gone = phase + way
    passed = (gone / KNOT_SPACING).floor()  # (B,) knots
    shape = turn_along(mean[:, SHAPE], phase, way)
    order = torch.arange(NUM_STEPS, dtype=mean.dtype, device=mean.device)
    shift = (order[:, None] + passed[:, None, None] == order).to(mean)  # (B, NUM_STEPS, NUM_STEPS)
    left = (order < passed.unsqueeze(-1)).to(mean).unsqueeze(1)  # (B, 1, NUM_STEPS)
    first = torch.cat([torch.ones_like(left[..., :1]), left], dim=-1)
    moved = torch.cat([first, torch.cat([torch.zeros_like(shift[..., :1]), shift], dim=-1)], dim=1)

    change = _change_per_metre(shape, cov[:, SHAPE, SHAPE])
    by_speed = dt.unsqueeze(-1) * (moved @ change.unsqueeze(-1)).squeeze(-1)  # (B, 1 + NUM_STEPS)

    transition = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device).repeat(dt.shape[0], 1, 1)
    transition[:, SHAPE, SHAPE] = moved
    transition[:, SHAPE, SPEED] = by_speed
    noise = torch.zeros_like(mean)
    noise[:, STEPS] = cfg.curvature_step**2 * _come_into_view(phase, gone, passed)
    moved_mean = mean.clone()
    moved_mean[:, SHAPE] = (moved @ shape.unsqueeze(-1)).squeeze(-1)
    cov = kalman.symmetrise(transition @ cov @ transition.mT) + noise.diag_embed()
    return moved_mean, cov, gone - passed * KNOT_SPACING


def turn_along(shape: Tensor, phase: Tensor, way: Tensor) -> Tensor:
    """Shape parameters after the road frame turned with the road over a way, as it comes nearer.

    What the shape has at a knot is b'' = d²X/dZ², which is the road's curvature κ only where the road leads
    straight ahead: b'' = κ / cos³ of its heading, which falls by κ₀ a metre until the knot is reached. On an
    arc this takes back, to leading order, what coming nearer adds. Left out, as they gained nothing: a turn
    also brings knots nearer, by κ₀ b; and an arc tells less of the speed than a clothoid does, so that in
    sharp bends the speed is not to be trusted.

    Args:
        shape: (B, 1 + NUM_STEPS).
        phase: (B,) m, how far the first knot lies behind the camera.
        way: (B,) m.
    """
    bend = torch.cat([shape[:, :1], shape[:, :1] + shape[:, 1:].cumsum(-1)], dim=-1)  # b'' at the knots
    behind = phase.unsqueeze(-1)
    here = bend[:, :1] + behind / KNOT_SPACING * shape[:, 1:2]
    to_knots = (0.5 * KNOT_SPACING * (bend[:, 1:] + bend[:, :-1])).cumsum(-1)
    to_here = 0.5 * behind * (bend[:, :1] + here)
    heading = (torch.cat([torch.zeros_like(here), to_knots], dim=-1) - to_here).atan()
    places = KNOT_SPACING * torch.arange(1 + NUM_STEPS, dtype=shape.dtype, device=shape.device)
    after = heading - here * torch.minimum(way.unsqueeze(-1), (places - behind).clamp(min=0.0))
    bend = bend * (heading.cos() / after.cos().clamp(min=0.6)) ** 3
    return torch.cat([bend[:, :1], bend.diff(dim=-1)], dim=-1)


def straight_or_bend(
    params: Tensor, cov: Tensor, straight: Tensor, bend: Tensor, share: float
) -> tuple[Tensor, Tensor]:
    """One frame's fit, averaged over the road being straight and its being a bend.

    A bend far off and a yaw look alike. To take the likelier for certain is wrong by many sigmas as often as
    it is the other; so each counts by its evidence, and what parts them goes to the covariance. Source:
    Bayesian model averaging (Hoeting et al. 1999) of two Gaussians, moments matched. That the road is
    straight is a measurement of c0 = c1 = 0 of the noise that turns the one prior into the other.

    Args:
        params: (B, 7) fitted to a frame as a bend, in the order of ``joint_model``.
        cov: (B, 7, 7).
        straight: (2,) 1/m and 1/m², sigmas of c0 and c1 of a straight road.
        bend: (2,), those of a bend, larger, which the fit had for a prior.
        share: of roads that are bends, before looking.

    Returns:
        mean (B, 7) and covariance (B, 7, 7).
    """
    noise = 1 / (straight.square().reciprocal() - bend.square().reciprocal())
    curvature, gain = params[:, CURVATURE:], cov[:, :, CURVATURE:]
    predicted = cov[:, CURVATURE:, CURVATURE:] + noise.diag()
    inverse = inverse_spd(predicted)
    solved = inverse @ curvature.unsqueeze(-1)  # (B, 2, 1)
    chi2 = (curvature.unsqueeze(1) @ solved).flatten()
    sharper = 0.5 * (bend.square() + noise).log().sum()
    sharper = sharper - cholesky(predicted).diagonal(dim1=1, dim2=2).log().sum(-1)
    odds = math.log((1 - share) / share) + sharper - 0.5 * chi2
    is_straight = odds.sigmoid()[:, None, None]
    pull = gain @ solved  # (B, 7, 1), from the bend to the straight road
    known = gain @ inverse @ gain.mT
    spread = is_straight * (1 - is_straight) * (pull @ pull.mT)
    return params - (is_straight * pull).squeeze(-1), kalman.symmetrise(cov - is_straight * known + spread)


def _change_per_metre(shape: Tensor, cov: Tensor) -> Tensor:
    """Change of the shape parameters by a metre driven, (B, 1 + NUM_STEPS), as far as there is a bend.

    On a straight road the steps are noise, and noise does not come nearer. Taken for a bend it would tell
    that the car stands, and where knots are passed would be left to chance: precisions would drift apart.
    """
    change: Tensor = (torch.as_tensor(_CHANGE).to(shape) @ shape.unsqueeze(-1)).squeeze(-1)
    steps, spread = shape[:, 1:], cov[:, 1:, 1:]
    size = spread.diagonal(dim1=1, dim2=2).rsqrt()  # (B, NUM_STEPS)
    factor = cholesky(size.unsqueeze(-1) * spread * size.unsqueeze(-2))
    white = solve_lower(factor, (size * steps).unsqueeze(-1))
    chi2, (least, clear) = white.square().sum((1, 2)), CLEAR_BEND
    known: Tensor = ((chi2 - least) / (clear - least)).clamp(0, 1)  # (B,)
    return change * known.unsqueeze(-1)


def _come_into_view(phase: Tensor, gone: Tensor, passed: Tensor) -> Tensor:
    """Share (B, NUM_STEPS) of each step, numbered anew, that came into view on the way from phase to gone.

    The last step comes in over ``ENTRY`` metres, not at once when a knot is passed: so it matters little in
    which of two frames that is.
    """
    behind = torch.arange(NUM_STEPS - 1, -1, -1, dtype=gone.dtype, device=gone.device) * KNOT_SPACING
    since = behind - KNOT_SPACING * passed.unsqueeze(-1)  # m, less the way, since a step came into view
    after, before = gone.unsqueeze(-1) + since, phase.unsqueeze(-1) + since
    return (after.clamp(0.0, ENTRY) - before.clamp(0.0, ENTRY)) / ENTRY
