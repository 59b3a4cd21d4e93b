"""State, configuration and reasons of the joint filter, and how a state starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

from torch import Tensor
from torch.nn.functional import pad

from lanebev.estimation.joint.dynamics import MotionConfig
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.layout import NUM_POSE, STEPS, layout
from lanebev.estimation.joint.low_pass import pose_variances
from lanebev.estimation.joint.measurement import CURVATURE, NUM_PARAMS, NUM_SHAPE, NUM_STRAIGHT, VERTICAL
from lanebev.estimation.joint.readings import ReadingConfig
from lanebev.estimation.joint.road import straight_or_bend
from lanebev.estimation.joint.road_curve import KNOT_SPACING
from lanebev.estimation.reasons import Reason
from lanebev.numbers import check_settings
from lanebev.tensors import constant, map_tensors
from lanebev.torch_internals import register_pytree
from lanebev.types import NUM_BOUNDARIES

_OFFSET_RATE_STD = 0.5  # m/s, of a start


@dataclass(frozen=True)
class JointConfig:
    """Configuration of :class:`lanebev.JointCalibrator`; angles in rad, lengths in m, times in s.

    Attributes:
        num_boundaries: L.
        iterations: Gauss-Newton steps per frame.
        start_iterations: Gauss-Newton steps for every start of a first frame.
        lane_width_std: sigma of the common scale of the lane widths, m; 0: the widths are exact.
        scatter_memory: time constant, s, of the mean squares of the boundaries' own deviations and headings;
            inf: they are taken for 0.
        start_heading_std: standard deviation of a boundary's own heading at a start, rad, unless frames show
            that boundaries are parallel; its variance decays over twice ``scatter_memory``.
        lane_deviation_std: sigma of a boundary's deviation where too few are in view to tell whether lanes
            are equal, m; 0: lanes are equal.
        no_boundary_odds: prior odds that one of three lines in view bounds no lane; 0: each does.
        motion: motion model.
        prior: prior of a start and range of its search.
        open_pose: standard deviation of the process noise that the evidence (J16) adds to the pose where it
            is ten sigmas, rad (and ten times that in m for the height); proportional to the evidence.
        open_curvature, open_step: the same for the curvature at the first knot and for its steps, 1/m.
        straight: standard deviations of c0 and c1 of a straight road, 1/m and 1/m².
        bends: prior probability that a start is on a bend, with the curvatures of ``prior``.
        open_vertical_curvature: as ``open_pose``, for the vertical curvature, 1/m.
        open_deviation: standard deviation of a boundary's deviation on a road of unequal lanes, m, and the
            most that the evidence adds to it; 0: lanes are equal.
        evidence_time: time constant of the evidence (J15), s.
        motion_scale_rise: time, s, in which the variance of the pose's motion grows by a factor e if it is
            half of the right one.
        motion_scale_memory: time constant, s, of the decay to the variance of ``motion``.
        motion_scale_most: largest factor on that variance.
        min_support: sum of inlier weights of a usable frame.
        min_share, enter_share: fraction of inliers needed to continue tracking, and to start again.
        assumed_dt: time between frames, s, if dt is not finite or the clock jumped back by more than 1 s.
        restart_after: time, s, without fitting segments before a new search.
        lost_after: time, s, without usable segments before the status is LOST.
        readings: priors of the readings of a single image.
        doubt_frames: number of frames after a jump or a misfit that are fitted alone and compared with the
            state.
        contrary_frames: number of consecutive usable frames that must contradict it for a restart.
    """

    num_boundaries: int = NUM_BOUNDARIES
    iterations: int = 2
    start_iterations: int = 8
    lane_width_std: float = 0.0
    scatter_memory: float = 1.0
    start_heading_std: float = 0.003
    lane_deviation_std: float = 0.05
    no_boundary_odds: float = 0.25
    motion: MotionConfig = field(default_factory=MotionConfig)
    prior: FramePrior = field(default_factory=FramePrior)
    open_pose: float = 0.01
    open_curvature: float = 3e-4
    open_step: float = 1e-3
    open_vertical_curvature: float = 2e-4
    straight: tuple[float, float] = (1e-4, 3e-6)
    bends: float = 0.2
    open_deviation: float = 0.12
    evidence_time: float = 0.15
    motion_scale_rise: float = 0.3
    motion_scale_memory: float = 1.0
    motion_scale_most: float = 1e4
    min_support: float = 3.0
    min_share: float = 0.15
    enter_share: float = 0.25
    assumed_dt: float = 1 / 30
    restart_after: float = 0.3
    lost_after: float = 5.0
    readings: ReadingConfig = field(default_factory=ReadingConfig)
    doubt_frames: int = 15
    contrary_frames: int = 5

    def __post_init__(self) -> None:
        if self.num_boundaries < 2 or self.num_boundaries % 2:
            raise ValueError(f"num_boundaries: expected an even number >= 2, got {self.num_boundaries}")
        if self.iterations < 1 or self.start_iterations < 1:
            got = min(self.iterations, self.start_iterations)
            raise ValueError(f"iterations: expected at least 1, got {got}")
        times = ("scatter_memory", "evidence_time", "motion_scale_rise", "motion_scale_memory", "assumed_dt")
        check_settings(self, positive=times, infinite=(*times[:-1], "lost_after", "restart_after"))
        bend = (self.prior.curvature_std, self.prior.curvature_rate_std)
        if not all(0 < sharp < wide for sharp, wide in zip(self.straight, bend, strict=True)):
            raise ValueError(
                f"straight: expected sigmas between 0 and those of the prior, {bend}, got {self.straight}"
            )
        if not 0 < self.bends < 1:
            raise ValueError(f"bends: expected a probability between 0 and 1, got {self.bends}")


HILLY_ROADS = JointConfig(motion=MotionConfig(vertical_curvature_std=2e-5))
"""Numbers for roads that are nowhere plane: a vertical curvature of R = 50 km as the standard deviation."""


@register_pytree
class JointState(NamedTuple):
    """The state of the calibrator between frames, tensors only.

    Attributes:
        mean: (B, D), see :class:`~lanebev.estimation.joint.layout.Layout`.
        cov: (B, D, D).
        phase: (B,) m, how far the first knot of the road's curvature lies behind the camera.
        evidence: (B, 11 + L) evidence against the motion, the accumulated scores of (J15).
        pose_sensitivity: (B, 4, 2 L) change of the pose by each boundary's own deviation (per m) and heading
            (per rad), in the last frames that determined the pose.
        scatter: (B, 2, 3) mean over the last frames, for the boundaries' own deviations (m²) and headings
            (rad²): sum of squares, degrees of freedom, weight of the frames.
        motion_scale: (B, 4) >= 1, factor on the variance of the pose's motion, adapted to the drive.
        hills: (B,) 1/m², variance of the road's vertical curvature beyond that of a plane road, by the crests
            and dips so far (J21).
        early: (B,) s by which the state is ahead of the last frame, which came out of order.
        unseen: (B,) s since the last usable frame.
        misfit: (B,) s for which there were segments that did not fit.
        doubt: (B,) number of further frames to be fitted alone and compared with the state.
        contrary: (B,) number of consecutive usable frames that contradicted the state.
        status: (B,) int64, values of Status.
        reasons: (B,) int64, :class:`Reason` flags of the last frame; those of what is unseen decide how the
            next prediction moves.
    """

    mean: Tensor
    cov: Tensor
    phase: Tensor
    evidence: Tensor
    pose_sensitivity: Tensor
    scatter: Tensor
    motion_scale: Tensor
    hills: Tensor
    early: Tensor
    unseen: Tensor
    misfit: Tensor
    doubt: Tensor
    contrary: Tensor
    status: Tensor
    reasons: Tensor

    def detach(self) -> JointState:
        """Return the state without the graph that computed it."""
        return map_tensors(Tensor.detach, self)


def state_from_fit(
    params: Tensor, param_cov: Tensor, by_vertical: Tensor, cfg: JointConfig
) -> tuple[Tensor, Tensor]:
    """Start a state from one frame's fit.

    The fit takes the road as plane: see :func:`with_vertical_curvature`.

    Args:
        params: (B, 7), see ``NUM_PARAMS``.
        param_cov: (B, 7, 7).
        by_vertical: (B, 7), change of the fit per 1/m of vertical curvature.
        cfg: the configuration.

    Returns:
        mean (B, D) and covariance (B, D, D).
    """
    straight, bend = constant(cfg.straight, like=params), cfg.prior.std(params)[CURVATURE:]
    params, param_cov = straight_or_bend(params, param_cov, straight, bend, cfg.bends)
    params = pad(params, (0, 1))  # the vertical curvature's mean is 0
    param_cov = with_vertical_curvature(param_cov, by_vertical, cfg.prior.vertical_curvature_std)
    copies = constant(_by_parameters(cfg.num_boundaries), like=params)
    own = constant(_start_variances(cfg.num_boundaries, cfg.motion), like=params)
    return params @ copies.mT, copies @ param_cov @ copies.mT + own.diag()


def with_vertical_curvature(cov: Tensor, by_vertical: Tensor, std: float) -> Tensor:
    """Add the road's vertical curvature κ to the covariance of a fit that takes it as 0.

    Source: (J22). The fit is off by g κ and the estimate 0 of κ by -κ, so both errors are correlated.

    Args:
        cov: (B, P, P) of the fit.
        by_vertical: (B, P), g, change of the fit per 1/m.
        std: 1/m, prior standard deviation of κ.

    Returns:
        (B, P + 1, P + 1), κ last.
    """
    error = std * pad(by_vertical, (0, 1), value=-1.0).unsqueeze(-1)
    return pad(cov, (0, 1, 0, 1)) + error @ error.mT


@lru_cache(maxsize=16)
def _by_parameters(num_boundaries: int) -> tuple[tuple[float, ...], ...]:
    """The state's entries by parameters and vertical curvature of one frame, D × 8.

    The slow mean begins at the pose.
    """
    indices = layout(num_boundaries)
    factors = {(k, k): 1.0 for k in (*range(NUM_STRAIGHT), CURVATURE)}
    factors |= {(step, CURVATURE + 1): KNOT_SPACING for step in range(STEPS.start, STEPS.stop)}
    factors |= {(VERTICAL, NUM_PARAMS): 1.0}
    factors |= {(indices.means.start + axis, axis): 1.0 for axis in range(NUM_POSE)}
    return tuple(tuple(factors.get((k, p), 0.0) for p in range(NUM_PARAMS + 1)) for k in range(indices.size))


@lru_cache(maxsize=16)
def _start_variances(num_boundaries: int, motion: MotionConfig) -> tuple[float, ...]:
    """Variances (D,) of a start beside those of the frame's fit."""
    swing = (*[motion.angle_std**2] * 3, motion.height_std**2)
    _, rate, acceleration, jerk = pose_variances(motion.bandwidth)
    return (
        *[0.0] * NUM_STRAIGHT,
        *[motion.curvature_step**2] * NUM_SHAPE,
        0.0,
        *[motion.deviation_walk**2] * num_boundaries,
        *(rate * variance for variance in swing),
        _OFFSET_RATE_STD**2,
        *(acceleration * variance for variance in swing),
        *(jerk * variance for variance in swing),
        *swing,
        motion.speed_std**2,
    )


def unobserved_mask(reasons: Tensor) -> Tensor:
    """Tell what of pitch, yaw, roll and height the last frame did not determine, (B, 4) bool."""
    bits = (Reason.DIRECTION_UNSEEN, Reason.DIRECTION_UNSEEN, Reason.ROLL_UNSEEN, Reason.HEIGHT_UNSEEN)
    return (reasons.unsqueeze(-1) & constant(tuple(map(int, bits)), like=reasons)) != 0
