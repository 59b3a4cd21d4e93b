"""Dynamics of the shape of the road in the joint filter.

The knots of the road's curvature are fixed to the road, and the camera passes them at a speed that is
estimated too: the curvature seen far ahead becomes the curvature near by. Process noise enters at the
farthest step, as it comes into view, and in sharp bends at every knot.
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
_BEND_STEP = 0.12  # standard deviation of the next step in a bend, as a fraction of that curvature
_WALK = 75.0  # √m³, random walk of a knot per curvature to the third power: R = 25 m by an eighth in a metre
_SHARPEST = 1 / 15  # 1/m, curvature from which the walk grows no more
_NOISE = 5.0  # χ² of the steps' estimates, which is seldom exceeded on a straight road
_SLOPE = 0.5 * (np.eye(1 + NUM_STEPS) + np.eye(1 + NUM_STEPS, k=1))  # at a knot: the mean of its steps
_SLOPE[0] = np.eye(1 + NUM_STEPS)[1]
_CHANGE = np.diff(_SLOPE, axis=0, prepend=0.0) / KNOT_SPACING  # 1/m, of the shape per metre driven
_CHANGE_BY_SHAPE = tuple(map(tuple, _CHANGE.T.tolist()))
_ORDER = range(1 + NUM_STEPS)
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
    shape = mean[:, SHAPE]
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
        noise=torch.addcmul(pad(seen, (1, 0)), way.unsqueeze(-1), sharp_bend_walk(shape)),
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


def sharp_bend_walk(shape: Tensor) -> Tensor:
    """Compute the variance (B, NUM_SHAPE) 1/m² by which the curvature at each knot walks in a metre driven.

    Source: (J12). In a sharp bend the curvature differs more from the spline, between knots and beyond the
    farthest vertices. If such errors were not expected, the speed would be estimated from them. The walk of a
    knot that no vertex shows is limited, else its curvature and its variance would increase each other.

    Args:
        shape: (B, NUM_SHAPE).
    """
    curvature = shape.cumsum(-1).clamp(-_SHARPEST, _SHARPEST)
    variance: Tensor = (_WALK * curvature**3).square()
    return variance


def _renumbering(passed: Tensor) -> Tensor:
    """Return the transition (B, NUM_SHAPE, NUM_SHAPE) by which step j becomes step j - passed.

    Row and column 0 are the curvature at the first knot: it takes up the steps up to the last knot passed.
    """
    least, most = constant(_PASSED, like=passed)  # knots, between which an entry is one
    passed = passed[:, None, None]
    transition: Tensor = ((passed >= least) & (passed <= most)).to(passed.dtype)
    return transition


def speed_share(shape: Tensor, cov: Tensor) -> Tensor:
    """Compute the share (B,) by which the shape of the road tells the speed.

    Source: (J12). On a straight road the steps are estimation noise, which does not move with the road. Were
    the speed estimated from it, the vehicle would seem to stand still. So the gain of the speed is multiplied
    by the share of the steps' χ² that exceeds that of noise (Wiener filter); for the rest its
    uncertainty is considered, but it is not estimated (Schmidt 1966).

    Args:
        shape: (B, NUM_SHAPE).
        cov: (B, NUM_SHAPE, NUM_SHAPE).
    """
    steps, spread = shape[:, 1:], cov[:, 1:, 1:]
    size = spread.diagonal(dim1=1, dim2=2).rsqrt()  # (B, NUM_STEPS)
    factor = cholesky(size.unsqueeze(-1) * spread * size.unsqueeze(-2))
    white = solve_lower(factor, (size * steps).unsqueeze(-1))
    chi2 = white.square().sum((1, 2))
    share: Tensor = 1 - _NOISE / chi2.clamp(min=_NOISE)
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
