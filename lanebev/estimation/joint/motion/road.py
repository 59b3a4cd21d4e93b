"""Dynamics of the shape of the road in the joint filter.

The knots of the road's curvature are fixed to the road, and the camera passes them at a speed that is
estimated too: the curvature seen far ahead becomes the curvature near by. Process noise enters only at the
farthest step, as it comes into view. The road frame turns with the road.
"""

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.layout import SHAPE, Layout
from lanebev.estimation.joint.measurement.road_curve import KNOT_SPACING, NUM_STEPS
from lanebev.estimation.joint.motion.dynamics import RoadMotion
from lanebev.geometry.linalg import cholesky, solve_lower
from lanebev.tensors import constant

ENTRY = KNOT_SPACING / 3  # m; a step comes into view while the camera drives so far
_BENT = 3.0  # the road bends at the farthest knot if its curvature there is so many sigmas
_BEND_STEP = 0.07  # standard deviation of the next step in a bend, as a fraction of that curvature
_SLOPE = 0.5 * (np.eye(1 + NUM_STEPS) + np.eye(1 + NUM_STEPS, k=1))  # at a knot: the mean of its steps
_SLOPE[0] = np.eye(1 + NUM_STEPS)[1]
_CHANGE = np.diff(_SLOPE, axis=0, prepend=0.0) / KNOT_SPACING  # 1/m, of the shape per metre driven
_CHANGE_BY_SHAPE = tuple(map(tuple, _CHANGE.T.tolist()))
_ORDER = range(1 + NUM_STEPS)
_KNOTS = tuple(KNOT_SPACING * knot for knot in _ORDER)  # m, from the first
_BEHIND = tuple(KNOT_SPACING * (NUM_STEPS - 1 - step) for step in range(NUM_STEPS))  # m
_PASSED = (  # row 0 sums the steps up to the last knot passed, the others move by the knots passed
    tuple(tuple(k - i if i == 0 or k > 0 else math.inf for k in _ORDER) for i in _ORDER),
    tuple(tuple(k - i if i > 0 else math.inf for k in _ORDER) for i in _ORDER),
)


def propagate_road_shape(
    mean: Tensor, shape_cov: Tensor, phase: Tensor, dt: Tensor, indices: Layout, cfg: MotionConfig
) -> RoadMotion:
    """Predict the shape of the road as the camera passes knots and new steps come into view.

    Source: (J12).

    Args:
        mean: (B, D) of the state.
        shape_cov: (B, NUM_SHAPE, NUM_SHAPE) of its shape.
        phase: (B,) m, how far the first knot lies behind the camera.
        dt: (B,) s.
        indices: of the state vector.
        cfg: the configuration.

    Returns:
        shape and phase after it, with derivatives and noise.
    """
    way = dt * (cfg.speed + mean[:, indices.speed]).clamp(min=0.0)
    gone = phase + way
    passed = (gone / KNOT_SPACING).floor()  # (B,) knots
    shape = turn_along(mean[:, SHAPE], phase, way)
    moved = _renumbering(passed)
    change = shape @ constant(_CHANGE_BY_SHAPE, like=shape)  # 1/m, per metre driven
    both = torch.bmm(moved, torch.stack([shape, dt.unsqueeze(-1) * change], dim=-1))  # (B, NUM_SHAPE, 2)
    step = step_variance(shape, shape_cov, cfg).unsqueeze(-1)
    seen = step * _share_in_view(phase, gone, passed)
    return RoadMotion(
        shape=both[..., 0],
        phase=gone - passed * KNOT_SPACING,
        transition=moved,
        by_speed=both[..., 1],
        noise=pad(seen, (1, 0)),
    )


def step_variance(shape: Tensor, shape_cov: Tensor, cfg: MotionConfig) -> Tensor:
    """Compute the variance (B,) 1/m² of the step of curvature that comes into view.

    Source: (J12). In a clothoid the curvature changes from knot to knot by much more than on a road that is
    nearly straight, and a bend that was entered is also left again.

    Args:
        shape: (B, NUM_SHAPE).
        shape_cov: (B, NUM_SHAPE, NUM_SHAPE).
        cfg: the configuration.
    """
    farthest, variance = shape.sum(-1), shape_cov.sum((1, 2))  # curvature at the last knot, and its variance
    excess = (farthest.square() - _BENT**2 * variance).clamp(min=0.0)
    total: Tensor = cfg.curvature_step**2 + _BEND_STEP**2 * excess
    return total


def _renumbering(passed: Tensor) -> Tensor:
    """Return the transition (B, NUM_SHAPE, NUM_SHAPE) by which step j becomes step j - passed.

    Row and column 0 are the curvature at the first knot: it takes up the steps up to the last knot passed.
    """
    least, most = constant(_PASSED, like=passed)  # knots, between which an entry is one
    passed = passed[:, None, None]
    transition: Tensor = ((passed >= least) & (passed <= most)).to(passed.dtype)
    return transition


def turn_along(shape: Tensor, phase: Tensor, way: Tensor) -> Tensor:
    """Compute the shape parameters after the road frame turned with the road over a way.

    The shape at a knot is b'' = d²X/dZ² = κ / cos³ of the road's heading there, κ its curvature. The heading
    decreases by κ₀ per metre driven until the knot is reached. On an arc this cancels, to leading order, the
    change because the knots approach. Two effects are left out because they improved nothing: a turn also
    brings knots nearer, by κ₀ b; and an arc determines the speed less well than a clothoid does.

    Args:
        shape: (B, 1 + NUM_STEPS).
        phase: (B,) m, how far the first knot lies behind the camera.
        way: (B,) m.
    """
    bend = shape.cumsum(-1)  # b'' at the knots
    behind = phase.unsqueeze(-1)
    here = bend[:, :1] + behind / KNOT_SPACING * shape[:, 1:2]
    to_knots = (0.5 * KNOT_SPACING * (bend[:, 1:] + bend[:, :-1])).cumsum(-1)
    to_here = 0.5 * behind * (bend[:, :1] + here)
    heading = (pad(to_knots, (1, 0)) - to_here).atan()
    places = constant(_KNOTS, like=shape)
    after = heading - here * torch.minimum(way.unsqueeze(-1), (places - behind).clamp(min=0.0))
    bend = bend * (heading.cos() / after.cos().clamp(min=0.6)) ** 3
    return torch.cat([bend[:, :1], bend.diff(dim=-1)], dim=-1)


def speed_share(shape: Tensor, cov: Tensor) -> Tensor:
    """Compute the share (B,) by which the shape of the road tells the speed.

    Source: (J12). On a straight road the steps are estimation noise, which does not move with the road. Were
    the speed estimated from it, the vehicle would seem to stand still. So the gain of the speed is multiplied
    by the share of the steps' χ² that exceeds its mean for noise (Wiener filter); for the rest its
    uncertainty is considered, but it is not estimated (Schmidt 1966).

    Args:
        shape: (B, NUM_SHAPE).
        cov: (B, NUM_SHAPE, NUM_SHAPE).
    """
    steps, spread = shape[:, 1:], cov[:, 1:, 1:]
    size = spread.diagonal(dim1=1, dim2=2).rsqrt()  # (B, NUM_STEPS)
    factor = cholesky(size.unsqueeze(-1) * spread * size.unsqueeze(-2))
    white = solve_lower(factor, (size * steps).unsqueeze(-1))
    chi2 = white.square().sum((1, 2))  # its mean for noise is NUM_STEPS
    share: Tensor = 1 - NUM_STEPS / chi2.clamp(min=NUM_STEPS)
    return share


def _share_in_view(phase: Tensor, gone: Tensor, passed: Tensor) -> Tensor:
    """Compute the share (B, NUM_STEPS) of each step, after renumbering, that came into view on the way.

    The farthest step comes in over ``ENTRY`` metres and not when a knot is passed, so that rounding does not
    decide in which of two frames its noise is added.
    """
    # m, less the way, since a step came into view
    since = constant(_BEHIND, like=gone) - KNOT_SPACING * passed.unsqueeze(-1)
    after, before = gone.unsqueeze(-1) + since, phase.unsqueeze(-1) + since
    return (after.clamp(0.0, ENTRY) - before.clamp(0.0, ENTRY)) / ENTRY
