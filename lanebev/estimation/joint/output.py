"""The calibration that is given out: the pose, and its covariance with what the filter does not estimate."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.batch import has_flag
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.evidence import EQUAL
from lanebev.estimation.joint.filter.scatter import scatter_variance, shown_freedom, start_variance
from lanebev.estimation.joint.frame_prior import student_density
from lanebev.estimation.joint.layout import POSE, layout
from lanebev.estimation.joint.measurement.residuals import HEIGHT, OFFSET, ROLL
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.geometry.linalg import cholesky, solve_lower
from lanebev.geometry.road import lane_width_covariance
from lanebev.tensors import constant, identity
from lanebev.types import Calibration, Extrinsics

_ONLY_HEIGHT = (0.0, 0.0, 0.0, 1.0)
_ALWAYS_FIT = 3  # boundaries: some pose over equal lanes fits any three
_SCALES = (0.0, 0.15, 0.6, 2.4)  # possible sigmas of deviations, ratios to ``lane_deviation_std``
_SHARES = (0.957, 0.03, 0.01, 0.003)  # their prior probabilities
_EGO_BREAK, _OTHER_BREAK = 0.08, 0.02  # prior probability of a change of the crossfall at a boundary
_MISFIT_FACTOR = 4.0  # the odds that a line bounds no lane are so much larger where other lines do not fit
_EGO_LANE_SHARE = 0.2  # such a line's variance on the ego lane's boundaries, relative to that on the others
_NO_BOUNDARY_RANGE = 3.6  # m; the position of such a line is uniform over it
_ROLL_PATTERN = 6.0  # sum of squares of (1, -2, 1), the proportion in which three boundaries change roll
_LEAST_SENSITIVITY = 0.015  # rad/m or m/m of roll or height, from which a boundary counts as in view
_HEADING_LENGTH = 15.0  # m; a boundary keeps its own heading along it
_HEADING_BY_CURVATURE = 37.0  # m, see (J28): 25 m in waves of 160 m, times 1.5 for one degree of freedom
_VERTICAL_STD = 4e-4  # 1/m, prior of the vertical curvature that two boundaries show
_NOISE_FACTOR = 1.5  # so many times the noise variance is subtracted from its square
_LEAST_HEIGHT = 0.1  # m; smaller heights are not divided by
_LARGEST_DEVIATION = 0.6  # m; a line that deviates by more is on no boundary

_ROUNDING = 5e-8  # of the trace, by which eigenvalues of information in single precision may be too small


def single_deviation(deviations: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the variance (B,) m² of any boundary's deviation if exactly one deviates.

    Source: (J26).

    Args:
        deviations: (B, L) m, by the filter.
        cfg: the configuration.
    """
    size = cfg.open_deviation
    worst = deviations.abs().amax(-1)
    alone = (worst > EQUAL * size) & (worst < _LARGEST_DEVIATION)
    return torch.where(alone, worst.clamp(max=size).square(), 0.0)


def unverified_deviation(
    sensitivity: Tensor, deviations: Tensor, of_headings: Tensor, roll: Tensor, cfg: JointConfig
) -> Tensor:
    """Compute the variance (B, L) m² of each boundary's deviation where too few are in view to tell.

    Source: (J26). Three boundaries fit a pose of equal lanes, however unequal the lanes are; a fourth shows
    whether they are (:func:`learned_road`), unless it deviates so much that it bounds no lane.

    Args:
        sensitivity: (B, 4, L) change of the pose per metre of deviation of a boundary; 0 if not in view.
        deviations: (B, L) m, by the filter.
        of_headings: (B,) rad², variance of a boundary's own heading, which makes it deviate over
            ``_HEADING_LENGTH``.
        roll: (B,) rad.
        cfg: the configuration.
    """
    fits = deviations.abs() < _LARGEST_DEVIATION
    in_view = (sensitivity[:, ROLL:].abs().amax(1) / _LEAST_SENSITIVITY).clamp(max=1.0) * fits
    further = (in_view.sum(-1) - _ALWAYS_FIT).clamp(min=0.0)
    of_three = (1 - further).clamp(min=0.0)
    if not cfg.lane_deviation_std:
        return torch.zeros_like(deviations)
    by_headings = of_headings * _HEADING_LENGTH**2
    odd = no_boundary_deviation(sensitivity[:, ROLL], roll, ~fits.all(-1), cfg)
    of_any = (cfg.lane_deviation_std**2 + by_headings) * of_three
    return of_any.unsqueeze(-1) + odd * of_three.unsqueeze(-1)


class LearnedRoad(NamedTuple):
    """What the frames so far tell of how far the road is from a plane with equal lanes.

    Attributes:
        deviation: (B,) m², expected square of a boundary's deviation.
        breaks: (B, L - 2), expected square of the change of the crossfall at each inner boundary.
    """

    deviation: Tensor
    breaks: Tensor


def learned_road(places: Tensor, deviations: Tensor, by_break: Tensor, cfg: JointConfig) -> LearnedRoad:
    """Compute what the frames so far tell of deviations, and of a change of the crossfall.

    Source: (J35), Bayesian model averaging over the standard deviation of the deviations and the boundary at
    which the crossfall changes, if it does.

    Args:
        places: (B, L, L + 1), information on the deviations, matrix and vector.
        deviations: (B, L) m, by the filter; a boundary that bounds no lane tells nothing.
        by_break: (B, L - 2, L) m of :func:`deviation_by_break`.
        cfg: the configuration.
    """
    variances = constant(tuple((scale * cfg.lane_deviation_std) ** 2 for scale in _SCALES), like=places)
    free = torch.where(deviations.abs() < _LARGEST_DEVIATION, 0.0, 1.0)  # m²
    stds = (variances[:, None, None] + free).sqrt()  # (S, B, L)
    known, pull = places[..., :-1], places[..., -1:]
    matrix = stds.unsqueeze(-1) * known * stds.unsqueeze(-2)
    one = identity(places.shape[-2], places.dtype, places.device)
    spoiled = ~(cholesky(matrix + one).diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    rounding = _ROUNDING * matrix.diagonal(dim1=-2, dim2=-1).sum(-1) * spoiled
    factor = cholesky(matrix + (1 + rounding)[..., None, None] * one)
    size = cfg.crossfall_break_std * by_break.mT  # (B, L, K), deviations by a break of one sigma
    white = solve_lower(factor, stds.unsqueeze(-1) * torch.cat([pull, known @ size], dim=-1))
    plane, bent = white[..., :1], white[..., 1:]  # (S, B, L, 1), (S, B, L, K)
    evidence = 0.5 * plane.square().sum((-2, -1)) - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    inverse = (
        1 + (size * (known @ size)).sum(-2) - bent.square().sum(-2)
    )  # (S, B, K), of the break's variance
    variance = inverse.clamp(min=1.0).reciprocal()
    found = variance * ((size * pull).sum(-2) - (bent * plane).sum(-2))  # sigmas
    of_break = 0.5 * (found.square() / variance + variance.log())
    straight, broken = _break_shares(by_break.shape[1])
    evidence = evidence.unsqueeze(-1) + torch.cat([torch.zeros_like(of_break[..., :1]), of_break], dim=-1)
    prior = constant(tuple(map(math.log, _SHARES)), like=places)[:, None, None]
    prior = prior + constant(tuple(map(math.log, (straight, *broken))), like=places)
    weights = (evidence + prior).transpose(0, 1).flatten(1).softmax(-1).unflatten(-1, (len(_SCALES), -1))
    expected = cfg.crossfall_break_std**2 * (found.square() + variance).transpose(0, 1)
    return LearnedRoad((weights.sum(-1) * variances).sum(-1), (weights[..., 1:] * expected).sum(1))


def _break_shares(count: int) -> tuple[float, tuple[float, ...]]:
    """Return the prior probability that the crossfall changes nowhere, and at each inner boundary."""
    ego = (count // 2 - 1, count // 2)
    broken = tuple(_EGO_BREAK if k in ego else _OTHER_BREAK for k in range(count))
    return 1 - sum(broken), broken


def deviation_by_break(positions: Tensor, state: JointState) -> Tensor:
    """Compute the deviations (B, L - 2, L) m of the boundaries by a change of the crossfall at an inner one.

    Source: (J35). Beyond boundary k, seen from the ego lane, the road is lower by the change of the crossfall
    times the distance from k. A point that is lower by d at the lateral position X is seen where one of the
    plane is at X (1 - d / h).

    Args:
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        state: (B, ...).
    """
    at = positions + state.mean[:, OFFSET, None]
    count = at.shape[-1]
    side = constant((*[-1.0] * (count // 2 - 1), *[1.0] * (count // 2 - 1)), like=at).unsqueeze(-1)
    beyond = (side * (at.unsqueeze(1) - at[:, 1:-1, None])).clamp(min=0.0)
    height = state.mean[:, HEIGHT].clamp(min=_LEAST_HEIGHT)
    return -at.unsqueeze(1) * beyond / height[:, None, None]


def no_boundary_deviation(by_place: Tensor, roll: Tensor, misfit: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the variance (B, L) m² of the deviations because one line of three may bound no lane.

    Source: (J26). A kerb or the edge of a shoulder fits as a boundary if the roll is wrong. The larger that
    roll is, the less probable is it for a camera. The result gives roll the variance p r², where p is the
    probability that there is such a line and r the difference of the roll from the prior's mean. It is less
    probably one of the ego lane's boundaries.

    Args:
        by_place: (B, L), change of the roll (rad) per metre of deviation of a boundary; 0 if not in view.
        roll: (B,) rad.
        misfit: (B,) bool, other lines are in view that are on no boundary.
        cfg: the configuration.
    """
    total = by_place.square().sum(-1).clamp(min=_LEAST_SENSITIVITY**2)
    beyond = roll - cfg.prior.roll
    by_camera = student_density(beyond / cfg.prior.roll_std, cfg.prior.freedom) / cfg.prior.roll_std
    density = by_camera * (total / _ROLL_PATTERN).sqrt()  # 1/m, of the outer line's position
    odds = cfg.no_boundary_odds * torch.where(misfit, _MISFIT_FACTOR, 1.0) / (_NO_BOUNDARY_RANGE * density)
    of_roll = odds / (1 + odds) * beyond.square()
    ego = by_place.shape[-1] // 2 - 1
    share = torch.ones_like(by_place)
    share[:, ego : ego + 2] = _EGO_LANE_SHARE
    by_share = (share * by_place.square()).sum(-1).clamp(min=_EGO_LANE_SHARE * _LEAST_SENSITIVITY**2)
    return share * (of_roll / by_share).unsqueeze(-1)


def beyond_filter(expected: Tensor, variances: Tensor) -> Tensor:
    """Compute the variance (B, L) m² of the boundaries' deviations that the filter's covariance lacks.

    Source: (J26). Half of six independent deviations can be observed, so their variances by the filter sum to
    three times that of one.

    Args:
        expected: (B, L) m², of each boundary's deviation.
        variances: (B, L) m², of the deviations by the filter.
    """
    return (expected - 0.5 * variances.sum(-1, keepdim=True)).clamp(min=0.0)


def vertical_moment(information: Tensor) -> Tensor:
    """Compute the mean square (B,) 1/m² of the vertical curvature, at least 0, by the last frames alone.

    Source: (J28), of two boundaries: the square of the estimate less its noise.

    Args:
        information: (B, 2), matrix and vector.
    """
    known, pull = information.unbind(-1)
    variance = 1 / (known + _VERTICAL_STD**-2)
    return ((pull * variance).square() - _NOISE_FACTOR * variance).clamp(min=0.0)


def wander_of_two(state: JointState, width: Tensor) -> Tensor:
    """Compute the variance (B,) rad² of the headings of two boundaries that wander; 0 if more are in view.

    Source: (J28). Two lines fit parallel boundaries however they converge, but not if each has a curvature of
    its own. They then show a vertical curvature κ, since it curves the image of a boundary at the lateral
    position X as a curvature of κ X / h does. It counts the less, the more degrees of freedom the frames
    before have shown, with further boundaries.

    Args:
        state: (B, ...). Where a frame does not determine the roll, two boundaries are in view.
        width: (B,) m, between the two.
    """
    vertical = state.hills.maximum(vertical_moment(state.vertical))
    by_vertical = 0.5 * width / state.mean[:, HEIGHT].clamp(min=_LEAST_HEIGHT)
    alone = (-2 * shown_freedom(state.scatter)).exp() * has_flag(state.reasons, Reason.ROLL_UNSEEN)
    return alone * vertical * (_HEADING_BY_CURVATURE * by_vertical).square()


def heading_variance(state: JointState, of_scatter: Tensor, of_two: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the variance (B,) rad² of a boundary's own heading.

    Source: (J28), with that of a start and of two boundaries.

    Args:
        state: (B, ...).
        of_scatter: (B,) rad², by the scatter of the boundaries; noise if never more than two were in view.
        of_two: (B,) rad² of :func:`wander_of_two`.
        cfg: the configuration.
    """
    more_than_two = (state.pose_sensitivity[:, ROLL] != 0).any(-1)  # in some frame
    of_more = of_scatter + start_variance(state.scatter, cfg.start_heading_std)
    return of_two + torch.where(more_than_two, of_more, 0.0)


def place_variances(state: JointState, learned: Tensor, cfg: JointConfig) -> tuple[Tensor, Tensor]:
    """Compute the variances (B, L) m² of the boundaries' deviations that the filter's covariance lacks.

    Source: (J26), (J28), (J35).

    Args:
        state: (B, ...).
        learned: (B,) m², of :func:`learned_road`.
        cfg: the configuration.

    Returns:
        what frames have shown of them, and what is possible because too few boundaries are in view; the
        larger one counts.
    """
    own = layout(cfg.num_boundaries).deviations
    deviations, variances = state.mean[:, own], state.cov.diagonal(dim1=1, dim2=2)[:, own]
    of_places, of_headings = scatter_variance(state.scatter).unbind(-1)
    shown = single_deviation(deviations, cfg).maximum(learned)
    shown = of_places.unsqueeze(-1).maximum(beyond_filter(shown.unsqueeze(-1), variances))
    roll = state.mean[:, ROLL]
    unverified = unverified_deviation(state.pose_sensitivity, deviations, of_headings, roll, cfg)
    return shown.expand_as(unverified), beyond_filter(unverified, variances)


def covariance_by_boundaries(
    state: JointState, positions: Tensor, of_two: Tensor, cfg: JointConfig
) -> Tensor:
    """Compute the covariance (B, 4, 4) of the pose by the boundaries' own deviations and headings.

    Source: (J26), (J29) and (J35).

    Args:
        state: (B, ...).
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        of_two: (B,) rad² of :func:`wander_of_two`.
        cfg: the configuration.
    """
    road, by_breaks = road_of(state, positions, cfg)
    of_places = torch.maximum(*place_variances(state, road.deviation, cfg))
    of_headings = heading_variance(state, scatter_variance(state.scatter)[:, 1], of_two, cfg)
    by_heading = state.heading_sensitivity[:, POSE]
    covariance = by_places(state.pose_sensitivity, of_places) + by_breaks
    return covariance + of_headings[:, None, None] * torch.bmm(by_heading, by_heading.mT)


def road_of(state: JointState, positions: Tensor, cfg: JointConfig) -> tuple[LearnedRoad, Tensor]:
    """Compute what the frames tell of the road, and the covariance (B, 4, 4) by changes of its crossfall."""
    by_break = deviation_by_break(positions, state)
    deviations = state.mean[:, layout(cfg.num_boundaries).deviations]
    road = learned_road(state.places, deviations, by_break, cfg)
    return road, by_places(state.pose_sensitivity @ by_break.mT, road.breaks)


def by_places(sensitivity: Tensor, variances: Tensor) -> Tensor:
    """Compute the covariance (B, 4, 4) of the pose by independent deviations, or changes of the crossfall.

    Args:
        sensitivity: (B, 4, L), change of the pose by each.
        variances: (B, L).
    """
    return torch.bmm(variances.unsqueeze(1) * sensitivity, sensitivity.mT)


def scaled_covariance(
    covariance: Tensor, state: JointState, positions: Tensor, cfg: JointConfig, factor: float
) -> Tensor:
    """Multiply the standard deviations of a drive's pose, except the part for unverified lanes.

    Source: (J36). The factor is for errors of a detector. The part that is not multiplied is a prior of
    roads: with too few boundaries in view, lanes may be unequal, a line may bound no lane, the crossfall or
    the width of the lane may change.

    Args:
        covariance: (B, 4, 4) of :func:`as_calibration`.
        state: (B, ...), of the same frame.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        cfg: the configuration.
        factor: on the standard deviations.
    """
    road, by_breaks = road_of(state, positions, cfg)
    shown, unverified = place_variances(state, road.deviation, cfg)
    scaled = torch.maximum(factor**2 * shown, unverified)
    less = factor**2 * torch.maximum(shown, unverified) - scaled
    of_road = by_breaks + unusual_covariance(state)
    covariance = factor**2 * (covariance - of_road) + of_road
    return covariance - by_places(state.pose_sensitivity, less)


def unusual_covariance(state: JointState) -> Tensor:
    """Compute the covariance (B, 4, 4) by how far doubtful roll and height left their means (J37)."""
    unusual = pad(state.unusual, (ROLL, 0)).unsqueeze(-1)
    return unusual @ unusual.mT


def height_variance_by_roll(height: Tensor, left: Tensor, right: Tensor, roll_variance: Tensor) -> Tensor:
    """Compute the variance (B,) m² of the height by the second-order effect of an error of the roll.

    Source: (J30). The ego lane's boundaries stay where they are seen.

    Args:
        height: (B,) m.
        left: (B,) m, lateral position of the left boundary of the ego lane.
        right: (B,) m, of the right one.
        roll_variance: (B,) rad².
    """
    second = -2.0 * (height - left * right / height.clamp(min=_LEAST_HEIGHT))
    return 0.75 * (second * roll_variance).square()


def as_calibration(state: JointState, inliers: Tensor, positions: Tensor, cfg: JointConfig) -> Calibration:
    """Make the calibration of a state.

    Its covariance adds what the filter does not estimate: the common scale of the lane widths (J25); the
    boundaries' own deviations and headings (J29); the difference from the last frame, if it contradicted
    the state; the difference from the usual roll and height, where the frame tells them badly (J37); and, if
    roll is not observed, the second-order effect of its error on the height (J30).

    Args:
        state: (B, ...).
        inliers: (B, N).
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        cfg: the configuration.
    """
    cov = state.cov[:, POSE, POSE]
    height, ego = state.mean[:, HEIGHT], cfg.num_boundaries // 2 - 1
    left, right = (positions[:, ego : ego + 2] + state.mean[:, OFFSET, None]).unbind(-1)
    width = (positions[:, -1] - positions[:, 0]) / (cfg.num_boundaries - 1)
    by_roll = height_variance_by_roll(height, left, right, cov[:, ROLL, ROLL])
    by_roll = torch.where(has_flag(state.reasons, Reason.ROLL_UNSEEN), by_roll, 0.0)
    of_two = wander_of_two(state, right - left)
    by_wander = 2 * of_two * (_HEADING_LENGTH * height / width).square()
    only_height = constant(_ONLY_HEIGHT, like=cov)
    apart = state.contradiction.unsqueeze(-1)
    cov = cov + covariance_by_boundaries(state, positions, of_two, cfg) + apart @ apart.mT
    cov = cov + lane_width_covariance(height, cfg.lane_width_std / width) + unusual_covariance(state)
    cov = cov + (only_height * (by_roll + by_wander).unsqueeze(-1)).diag_embed()
    return Calibration(Extrinsics.unstack(state.mean[:, POSE]), cov, state.status, inliers)
