"""The calibration that is given out: the pose, and its covariance with what the filter does not estimate."""

import math

import torch
from torch import Tensor

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
    whether they are (:func:`learned_deviation`), unless it deviates so much that it bounds no lane.

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


def learned_deviation(places: Tensor, deviations: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the expected square (B,) m² of a boundary's deviation by what the frames so far tell of them.

    Source: (J35), Bayesian model averaging over the standard deviation of the deviations.

    Args:
        places: (B, L, L + 1), information on the deviations, matrix and vector.
        deviations: (B, L) m, by the filter; a boundary that bounds no lane tells nothing.
        cfg: the configuration.
    """
    variances = constant(tuple((scale * cfg.lane_deviation_std) ** 2 for scale in _SCALES), like=places)
    free = torch.where(deviations.abs() < _LARGEST_DEVIATION, 0.0, 1.0)  # m²
    stds = (variances[:, None, None] + free).sqrt()  # (S, B, L)
    matrix = stds.unsqueeze(-1) * places[..., :-1] * stds.unsqueeze(-2)
    one = identity(places.shape[-2], places.dtype, places.device)
    spoiled = ~(cholesky(matrix + one).diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    rounding = _ROUNDING * matrix.diagonal(dim1=-2, dim2=-1).sum(-1) * spoiled
    factor = cholesky(matrix + (1 + rounding)[..., None, None] * one)
    white = solve_lower(factor, (stds * places[..., -1]).unsqueeze(-1))
    evidence = 0.5 * white.square().sum((-2, -1)) - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    weights = (evidence + constant(tuple(map(math.log, _SHARES)), like=places).unsqueeze(-1)).softmax(0)
    return (weights * variances.unsqueeze(-1)).sum(0)


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


def place_variances(state: JointState, cfg: JointConfig) -> tuple[Tensor, Tensor]:
    """Compute the variances (B, L) m² of the boundaries' deviations that the filter's covariance lacks.

    Source: (J26), (J28), (J35).

    Args:
        state: (B, ...).
        cfg: the configuration.

    Returns:
        what frames have shown of them, and what is possible because too few boundaries are in view; the
        larger one counts.
    """
    own = layout(cfg.num_boundaries).deviations
    deviations, variances = state.mean[:, own], state.cov.diagonal(dim1=1, dim2=2)[:, own]
    of_places, of_headings = scatter_variance(state.scatter).unbind(-1)
    shown = single_deviation(deviations, cfg).maximum(learned_deviation(state.places, deviations, cfg))
    shown = of_places.unsqueeze(-1).maximum(beyond_filter(shown.unsqueeze(-1), variances))
    roll = state.mean[:, ROLL]
    unverified = unverified_deviation(state.pose_sensitivity, deviations, of_headings, roll, cfg)
    return shown.expand_as(unverified), beyond_filter(unverified, variances)


def covariance_by_boundaries(state: JointState, of_two: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the covariance (B, 4, 4) of the pose by the boundaries' own deviations and headings.

    Source: (J26) and (J29).

    Args:
        state: (B, ...).
        of_two: (B,) rad² of :func:`wander_of_two`.
        cfg: the configuration.
    """
    of_places = torch.maximum(*place_variances(state, cfg))
    of_headings = heading_variance(state, scatter_variance(state.scatter)[:, 1], of_two, cfg)
    by_heading = state.heading_sensitivity[:, POSE]
    covariance = by_places(state.pose_sensitivity, of_places)
    return covariance + of_headings[:, None, None] * torch.bmm(by_heading, by_heading.mT)


def by_places(sensitivity: Tensor, variances: Tensor) -> Tensor:
    """Compute the covariance (B, 4, 4) of the pose by deviations of the boundaries.

    Args:
        sensitivity: (B, 4, L), change of the pose per metre.
        variances: (B, L) m².
    """
    return torch.bmm(variances.unsqueeze(1) * sensitivity, sensitivity.mT)


def scaled_covariance(covariance: Tensor, state: JointState, cfg: JointConfig, factor: float) -> Tensor:
    """Multiply the standard deviations of a drive's pose, except the part for unverified lanes.

    Source: (J36). The factor is for errors of a detector. The part that is not multiplied is a prior of
    roads: with too few boundaries in view, lanes may be unequal or a line may bound no lane.

    Args:
        covariance: (B, 4, 4) of :func:`as_calibration`.
        state: (B, ...), of the same frame.
        cfg: the configuration.
        factor: on the standard deviations.
    """
    shown, unverified = place_variances(state, cfg)
    scaled = torch.maximum(factor**2 * shown, unverified)
    less = factor**2 * torch.maximum(shown, unverified) - scaled
    return factor**2 * covariance - by_places(state.pose_sensitivity, less)


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
    the state; and, if roll is not observed, the second-order effect of its error on the height (J30).

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
    cov = cov + covariance_by_boundaries(state, of_two, cfg) + apart @ apart.mT
    cov = cov + lane_width_covariance(height, cfg.lane_width_std / width)
    cov = cov + (only_height * (by_roll + by_wander).unsqueeze(-1)).diag_embed()
    return Calibration(Extrinsics.unstack(state.mean[:, POSE]), cov, state.status, inliers)
