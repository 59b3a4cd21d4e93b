"""Evidence against the motion model: normalised scores, and the process noise that follows from them."""

import math
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.update import FrameInformation, innovation_score
from lanebev.estimation.joint.layout import DEVIATIONS, NUM_POSE, POSE, SHAPE
from lanebev.estimation.joint.measurement.residuals import NUM_SHAPE, VERTICAL
from lanebev.estimation.joint.state import JointState
from lanebev.tensors import constant

_COMMON_ERROR = 0.2  # sigmas: standard deviation of the error that all end points of a boundary share
_LEAST_VARIANCE = 1e-3  # ratio of a score's variance to Λᵢᵢ below which the prediction fixes the entry
_FREE_POSE = (0.05, 0.05, 0.05, 0.3)  # rad, m: sigmas added where the pose is free
_LARGEST_EXCESS = 4.0  # excess of a squared score over 1; a larger one is a jump
EQUAL = 0.1  # lanes are equal up to this fraction of ``JointConfig.open_deviation``
_OVER_HORIZON = 0.01  # if more of the segments are over the horizon, the others are too low
_CURVED_SIGMAS = 2.0  # ratio of the vertical curvature to its sigma from which it is a crest or a dip
_POSE_DECAY = 0.85  # factor per frame on the pose's evidence, since a detector's errors last over frames
CALL = 5.0  # sigmas of evidence at which half of the noise is admitted
EVIDENCE_TIME = 0.15  # s, time constant of the evidence
_OPEN_CURVATURE, _OPEN_STEP = 3e-4, 7e-4  # 1/m, of curvature and steps, as ``open_pose``
_OPEN_VERTICAL_CURVATURE = 2e-4  # 1/m, likewise
_SCALE_RISE = 0.3  # s, in which the variance of the motion grows by a factor e if it is half of the right one
_SCALE_MEMORY = 1.0  # s, time constant of the decay to the variance of ``MotionConfig``
_LARGEST_SCALE = 1e4  # largest factor on the variance of the motion


def normalized_score(cov: Tensor, frame: FrameInformation, count: Tensor, weight: Tensor) -> Tensor:
    """Compute the normalised score of every entry that moves: N(0, 1) each if the motion model is right.

    Source: (J14), the score test (Rao 1948) for more process noise in one entry. For bends and unequal lanes
    the pose is free: the test depends on near against far vertices of one frame, and unexpected motion of the
    pose is no evidence. A detector's errors are correlated along a boundary, so for its deviation and for the
    vertical curvature its n end points count as 1 / (1 / n + 0.2²). Where the noise raises end points
    over the horizon, those that are left are too low and look like a dip: then the vertical curvature has 0.

    Args:
        cov: (B, O, O) of the prediction.
        frame: linearised at the prediction.
        count: (B, L) end points that each boundary was seen with.
        weight: (B, N) of the segments.

    Returns:
        (B, 5 + NUM_SHAPE + L) of pose, shape, vertical curvature, deviations; 0 where the frame has no
        information on an entry.
    """
    priors = torch.cat([cov, cov + constant(_free_pose(cov.shape[-1]), like=cov)])  # (2 B, O, O)
    score, variance = (
        part.unflatten(0, (2, -1))
        for part in innovation_score(
            priors, torch.cat([frame.matrix, frame.matrix]), torch.cat([frame.vector, frame.vector])
        )
    )
    known = variance > (_LEAST_VARIANCE * frame.matrix.diagonal(dim1=1, dim2=2)).clamp(min=0.0)
    mean_count = count.square().sum(-1, keepdim=True) / count.sum(-1, keepdim=True).clamp(min=1.0)
    counts = torch.cat([mean_count, count], dim=-1)  # for the vertical curvature, and for each boundary
    inflation = pad(_COMMON_ERROR**2 * counts, (cov.shape[-1] - counts.shape[-1], 0)) + 1
    normal = torch.where(known, score * torch.where(known, variance * inflation, 1.0).rsqrt(), 0.0)
    raised = (weight * ~frame.residuals.valid).sum(-1) > _OVER_HORIZON * weight.sum(-1)
    crest = torch.where(raised, 0.0, normal[1, :, VERTICAL]).unsqueeze(-1)
    return torch.cat([normal[0, :, POSE], normal[1, :, SHAPE], crest, normal[1, :, DEVIATIONS]], dim=-1)


@lru_cache(maxsize=16)
def _free_pose(count: int) -> tuple[tuple[float, ...], ...]:
    """Return the covariance O × O that is added where the pose is free."""
    added = [sigma**2 for sigma in _FREE_POSE] + [0.0] * (count - NUM_POSE)
    return tuple(tuple(value * (k == i) for k in range(count)) for i, value in enumerate(added))


def accumulate_evidence(before: Tensor, score: Tensor, dt: Tensor, memory: float) -> Tensor:
    """Accumulate the scores, those of shape, vertical curvature and deviations at unit variance.

    Source: (J15); Page 1954, cumulative sum. The pose's evidence is the larger of this frame's score and
    0.85 times the accumulated value: a jump of the pose is evident in one frame, a fall only in several. The
    0.85 is applied in every frame, so the pose's evidence fades faster than with ``memory``, by a factor that
    depends on the frame rate, and has no unit variance. Where it exceeded ``CALL`` in the last frame, it is
    accumulated from 0 again.

    Args:
        before: (B, M), evidence so far.
        score: (B, M), of this frame.
        dt: (B,) s.
        memory: s.
    """
    fade = (-dt / memory).exp().unsqueeze(-1)
    others = before.shape[-1] - NUM_POSE
    decay, call, now = (
        constant((of_pose,) * NUM_POSE + (of_others,) * others, like=before)
        for of_pose, of_others in ((_POSE_DECAY, 1.0), (CALL, math.inf), (1.0, 0.0))
    )
    before = torch.where(before.abs() > call, 0.0, before)
    total = decay * (before * fade + (1 - fade * fade).clamp(min=1e-12).sqrt() * score)
    return torch.where((now * score).abs() > total.abs(), score, total)


def adapt_motion_scale(before: Tensor, score: Tensor, dt: Tensor) -> Tensor:
    """Raise the variance of the pose's motion while its scores are too large, and let it decay.

    Source: (J17), covariance matching (Mehra 1972), axis by axis, as a multiplicative step: with the right
    variance the squared score has mean 1. If a frame does not determine roll, its score is that of the offset
    and is given as 1, which changes nothing.

    Args:
        before: (B, 4) >= 1, factor on the variance so far.
        score: (B, 4), normalised, of pitch, yaw, roll and height.
        dt: (B,) s.
    """
    gain = 1 - (-dt / _SCALE_RISE).exp().unsqueeze(-1)
    excess = (score.square() - 1).clamp(max=_LARGEST_EXCESS)
    fade = (-dt / _SCALE_MEMORY).exp().unsqueeze(-1)
    raised = before * (gain * excess).exp()
    return (1 + (raised - 1) * fade).clamp(1.0, _LARGEST_SCALE)


def adaptive_process_noise(evidence: Tensor, cov: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the process noise variances (B, O) from the evidence; almost zero below 3 sigmas.

    Source: (J16).

    Of the deviations only that with the largest score gets noise, and at most ``open_deviation``: a
    detector's error on one boundary may last for seconds, and if all deviations were free, it would be taken
    for a road of unequal lanes and change the roll.

    Args:
        evidence: (B, 5 + NUM_SHAPE + L).
        cov: (B, O, O), predicted.
        cfg: the configuration.
    """
    parts = evidence.square().split([NUM_POSE, NUM_SHAPE, 1, cfg.num_boundaries], dim=-1)
    worst = [part.amax(-1, keepdim=True) for part in parts]
    most = torch.cat(worst, dim=-1)
    pose, bend, crest, own = (0.01 * torch.sigmoid(0.5 * (most - CALL**2)) * most).chunk(4, dim=-1)
    jump = constant((*[cfg.open_pose**2] * 3, (10 * cfg.open_pose) ** 2, 0.0), like=evidence)
    change = constant((_OPEN_CURVATURE**2, *[_OPEN_STEP**2] * (NUM_SHAPE - 1)), like=evidence)
    room = cfg.open_deviation**2 - cov.diagonal(dim1=1, dim2=2)[:, DEVIATIONS]
    freed = (parts[3] == worst[3]) * own.clamp(max=1.0) * room.clamp(min=0.0)
    return torch.cat([pose * jump, bend * change, crest * _OPEN_VERTICAL_CURVATURE**2, freed], dim=-1)


def with_process_noise(cov: Tensor, variances: Tensor) -> Tensor:
    """Add variances (B, O) of the observed entries to a covariance (B, D, D)."""
    return cov + pad(variances, (0, cov.shape[-1] - variances.shape[-1])).diag_embed()


def deviation_prior_std(deviations: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the prior standard deviation (B,) m of deviations from the second largest; 0 for equal lanes.

    Source: (J20).

    A single deviating boundary is a detector's error, and lasting errors let a second one deviate by
    ``EQUAL`` of ``open_deviation``. That is subtracted in variance, so that a slightly larger deviation has
    little effect. Three combinations of six deviations cannot be observed, since changes of offset, height
    and roll have the same effect, so the estimated deviations are smaller than the true ones. With twice the
    second largest, the mean squared error of roll is 1.0 times its variance.
    """
    size = cfg.open_deviation
    second = deviations.abs().topk(2, dim=-1).values[:, 1]
    excess = second.square() - (EQUAL * size) ** 2
    unequal = excess > 0
    return torch.where(unequal, 2 * torch.where(unequal, excess, 1.0).sqrt(), 0.0).clamp(max=size)


def hill_variance(state: JointState, dt: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the variance (B,) 1/m² of the vertical curvature beyond that of a plane road.

    Source: (J21). Otherwise the prior of a plane road would pull the estimate to 0 all along a crest, and
    again in the dip behind it until there is evidence of it.

    Args:
        state: after the last frame.
        dt: (B,) s since then.
        cfg: the configuration.
    """
    curvature, variance = state.mean[:, VERTICAL], state.cov[:, VERTICAL, VERTICAL]
    excess = (curvature.square() - _CURVED_SIGMAS**2 * variance).clamp(min=0.0)
    return (state.hills * (-dt / cfg.motion.hill_memory).exp()).maximum(excess)
