"""The pose of a single image, averaged over its readings.

Every reading (:mod:`lanebev.estimation.joint.frame.readings`) is fitted with a deviation and a heading of
its own for each boundary, Gaussian about the road's, and weighted by its evidence (Laplace's approximation).
Source: Bayesian model averaging (Hoeting et al. 1999) with Occam's window (Madigan and Raftery 1994) and
tempered evidence, since no model is exactly right (Grünwald and van Ommen 2017).
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot, softplus

from lanebev.batch import select_rows
from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.frame.bends import straight_or_bend
from lanebev.estimation.joint.frame.reading_fit import fit_readings, reading_model
from lanebev.estimation.joint.frame.readings import Readings, log_prior, log_prior_of_half, readings
from lanebev.estimation.joint.frame.start_search import linear_starts, spread_subset
from lanebev.estimation.joint.frame_prior import FramePrior, student_log
from lanebev.estimation.joint.layout import STEPS
from lanebev.estimation.joint.measurement.observations import Observations, boundary_places, observations
from lanebev.estimation.joint.measurement.residuals import HEIGHT, OFFSET, PITCH, ROLL
from lanebev.estimation.joint.measurement.road_curve import KNOT_SPACING
from lanebev.geometry.linalg import solve_spd
from lanebev.geometry.road import lane_width_covariance
from lanebev.observation.segments import LaneSegments
from lanebev.types import Calibration, Extrinsics

_START_STEPS, _STEPS = 6, 5  # Gauss-Newton steps of the start and of every reading
_SEGMENTS = 192  # segments that are fitted, at most
_ANGLES = [PITCH, ROLL]
_KEEP = 3.0  # the likeliest reading is kept if it is within so many sigmas of the average
_FARTHER = 0.5  # ... and at most so many sigmas farther from the prior than the average
_POSE = slice(0, HEIGHT + 1)


class AveragedPose(NamedTuple):
    """A frame's pose over all readings.

    Attributes:
        mean: (B, 4) rad and m.
        covariance: (B, 4, 4), within the readings and between them.
        bounds_lane: (B, L) probability of each line that it bounds a lane.
    """

    mean: Tensor
    covariance: Tensor
    bounds_lane: Tensor


def weigh_readings(
    calibration: Calibration,
    mean: Tensor,
    segments: LaneSegments,
    intrinsics: Tensor,
    lane_width: Tensor,
    cfg: JointConfig,
) -> Calibration:
    """Average the pose of every row that has started over all readings of its image.

    Args:
        calibration: calibration of the likeliest reading.
        mean: (B, D) of the filter's state with that frame.
        segments: segments of the frame, usable.
        intrinsics: (B, 3, 3) px.
        lane_width: (B, L-1) m.
        cfg: the configuration.

    Returns:
        the calibration; a segment is an inlier as far as its line bounds a lane.
    """
    seen = observations(segments, intrinsics)
    positions = boundary_places(lane_width, cfg.num_boundaries, mean)
    start = torch.cat([mean[:, : OFFSET + 2], mean[:, STEPS.start, None] / KNOT_SPACING], dim=-1)
    found = average_readings(start, seen, positions, cfg)
    scale = lane_width_covariance(found.mean[:, HEIGHT], cfg.lane_width_std / lane_width.mean(-1))
    begun = is_running(calibration.status)
    pose = calibration.extrinsics.stack()
    inliers = calibration.inliers * found.bounds_lane.gather(1, seen.boundary).to(pose)
    return calibration._replace(
        extrinsics=Extrinsics.unstack(select_rows(begun, found.mean.to(pose), pose)),
        covariance=select_rows(begun, (found.covariance + scale).to(pose), calibration.covariance),
        inliers=select_rows(begun, inliers, calibration.inliers),
    )


def average_readings(start: Tensor, seen: Observations, positions: Tensor, cfg: JointConfig) -> AveragedPose:
    """Average a frame's pose over all readings.

    The mean uses the evidence itself. If the pose of ``start`` is within ``_KEEP`` sigmas of the mean, and no
    farther from the prior, it is kept instead, since averaging readings that agree only adds noise. The
    covariance about it uses the evidence to a power below 1, which keeps more readings.

    Args:
        start: (B, 7) parameters near the likeliest reading.
        seen: what was observed.
        positions: (B, L) m, of the boundaries from the ego lane's middle, by the lane widths.
        cfg: the configuration.
    """
    num, prior, least = cfg.num_boundaries, cfg.prior, cfg.readings.least_weight
    seen, places = spread_subset(seen, positions.gather(1, seen.boundary), _SEGMENTS)
    ways = readings(num, cfg.readings, positions)
    pose, cov, evidence = fit_all_readings(start, seen, places, positions, ways, cfg)
    in_view = ((seen.weight > 0).unsqueeze(-1) & one_hot(seen.boundary, num).bool()).any(1)  # (B, L)
    before, half = log_prior(ways, in_view, cfg.readings), log_prior_of_half(in_view, cfg.readings)
    likely, tempered = (
        window(power * evidence + before, least) for power in (1.0, cfg.readings.evidence_exponent)
    )
    mean, _ = mixture_moments(*_with_half(pose, cov, likely, prior, half, least))
    centre, spread = mixture_moments(*_with_half(pose, cov, tempered, prior, half, least))
    keep = _agrees_with_average(start, mean, centre, spread, prior)
    mean = select_rows(keep, start[:, _POSE], mean)
    apart = centre - mean
    wrong = likely @ ways.wrong.to(positions)
    return AveragedPose(mean, spread + apart.unsqueeze(-1) * apart.unsqueeze(-2), 1 - wrong)


def fit_all_readings(
    start: Tensor, seen: Observations, places: Tensor, positions: Tensor, ways: Readings, cfg: JointConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit every reading, from the likeliest start on its kind of road.

    Args:
        start: (B, 7) parameters near the likeliest reading.
        seen: what was observed.
        places: (B, N) m, of the segments' boundaries.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        ways: C readings, the first of which are one of each kind of road.
        cfg: the configuration.

    Returns:
        pose (B, C, 4), its covariance (B, C, 4, 4), and log evidence (B, C), each on a straight or bent road.
    """
    batch, kinds, prior = len(positions), len(cfg.readings.deviation_std), cfg.prior
    starts = linear_starts(seen, places, replace(prior, roll_steps=1))
    starts = torch.cat([start.unsqueeze(1), starts], dim=1)  # (B, S, 7)
    tries = starts.shape[1]
    model = reading_model(seen, positions, Readings(*(part[:kinds] for part in ways)), tries, prior)
    begun = fit_readings(starts.repeat(1, kinds, 1).flatten(0, 1), model, _START_STEPS)
    likeliest = begun.evidence.view(-1, tries).argmax(-1)
    best = likeliest + tries * torch.arange(batch * kinds, device=likeliest.device)
    begin = begun.params[best].view(batch, kinds, -1)[:, ways.kind].flatten(0, 1)
    fits = fit_readings(begin, reading_model(seen, positions, ways, 1, prior), _STEPS)

    straight, bend = positions.new_tensor(cfg.straight), prior.std(positions)[OFFSET + 1 :]
    params, covariance, odds = straight_or_bend(fits.params, fits.covariance, straight, bend, cfg.bends)
    evidence = fits.evidence + softplus(odds)
    found = (params[:, _POSE], covariance[:, _POSE, _POSE], evidence)
    pose, cov, evidence = (part.unflatten(0, (batch, len(ways.kind))) for part in found)
    return pose, cov, evidence


def _agrees_with_average(
    start: Tensor, mean: Tensor, centre: Tensor, spread: Tensor, prior: FramePrior
) -> Tensor:
    """Return where the pose of the likeliest reading (B, 7) is as good as the average, (B,) bool.

    It is near the average by the tempered evidence, whose mean and covariance are ``centre`` and ``spread``,
    and its pitch and roll are not farther from the prior than those of ``mean`` are.
    """
    level = prior.mean(mean)[_ANGLES]
    farther = (start[:, _ANGLES] - level).abs() - (mean[:, _ANGLES] - level).abs()
    farther = (farther / prior.std(mean)[_ANGLES]).amax(-1)
    return (distance(start[:, _POSE] - centre, spread) < _KEEP) & (farther < _FARTHER)


def window(log_weight: Tensor, least: float) -> Tensor:
    """Normalise weights (B, C) and leave out those below a share of the largest.

    Source: Occam's window (Madigan and Raftery 1994).
    """
    weight = log_weight.softmax(-1)
    weight = torch.where(weight < least * weight.amax(-1, keepdim=True), 0.0, weight)
    total: Tensor = weight / weight.sum(-1, keepdim=True)
    return total


def mixture_moments(mean: Tensor, cov: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Compute mean (B, P) and covariance (B, P, P) of a mixture of C Gaussians.

    Source: (J24), the law of total covariance: the mean of the covariances and the covariance of the means.

    Args:
        mean: (B, C, P).
        cov: (B, C, P, P).
        weight: (B, C), of sum 1.
    """
    total = (weight.unsqueeze(-1) * mean).sum(1)
    apart = mean - total.unsqueeze(1)
    spread = cov + apart.unsqueeze(-1) * apart.unsqueeze(-2)
    return total, (weight[..., None, None] * spread).sum(1)


def distance(apart: Tensor, cov: Tensor) -> Tensor:
    """Compute the Mahalanobis distance (B,) of deviations (B, P), per root of P."""
    squared = (apart * solve_spd(cov, apart.unsqueeze(-1)).squeeze(-1)).mean(-1)
    return squared.clamp(min=0.0).sqrt()


def _with_half(
    mean: Tensor, cov: Tensor, weight: Tensor, prior: FramePrior, odds: Tensor, least: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Add to (B, C) poses those at half the height, over lines that are half a lane apart.

    The image is the same: only the prior of the height and that of such lines decide.
    """
    height = mean[..., HEIGHT]
    away = (torch.stack([0.5 * height, height], dim=-1) - prior.height) / prior.height_std
    of_half, of_whole = student_log(away.square().unsqueeze(-1), prior.freedom).unbind(-1)
    half = (odds.to(mean).unsqueeze(-1) + of_half - of_whole).sigmoid()
    half = torch.where(half < least, 0.0, half)
    halve = mean.new_tensor([1.0, 1.0, 1.0, 0.5])
    return (
        torch.cat([mean, mean * halve], dim=1),
        torch.cat([cov, cov * halve.unsqueeze(-1) * halve], dim=1),
        torch.cat([weight * (1 - half), weight * half], dim=1),
    )
