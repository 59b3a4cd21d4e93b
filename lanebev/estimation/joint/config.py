"""Configuration of the joint calibrator."""

from dataclasses import dataclass, field

from lanebev.estimation.joint.dynamics import MotionConfig
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.readings import ReadingConfig
from lanebev.numbers import check_settings
from lanebev.types import NUM_BOUNDARIES


@dataclass(frozen=True)
class JointConfig:
    """Configuration of :class:`lanebev.JointCalibrator`; angles in rad, lengths in m, times in s.

    Attributes:
        num_boundaries: L.
        iterations: Gauss-Newton steps per frame.
        start_iterations: Gauss-Newton steps for every start of a first frame.
        lane_width_std: sigma of the common scale of the lane widths, m; 0: the widths are exact. ``LaneBEV``
            multiplies its effect on the covariance by ``pose_sigma_scale`` squared, as all of it.
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
        straight: standard deviations of c0 and c1 of a straight road, 1/m and 1/m².
        bends: prior probability that a start is on a bend, with the curvatures of ``prior``.
        open_deviation: standard deviation of a boundary's deviation on a road of unequal lanes, m, and the
            most that the evidence adds to it; 0: lanes are equal.
        min_support: sum of inlier weights of a usable frame.
        min_share, enter_share: fraction of inliers needed to continue tracking, and to start again.
        assumed_dt: time between frames, s, if dt is not finite or the clock jumped back by more than 1 s.
        restart_after: time, s, without fitting segments before a new search.
        lost_after: time, s, without usable segments before the status is LOST.
        readings: priors of the readings of a single image.
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
    straight: tuple[float, float] = (1e-4, 3e-6)
    bends: float = 0.2
    open_deviation: float = 0.12
    min_support: float = 3.0
    min_share: float = 0.15
    enter_share: float = 0.25
    assumed_dt: float = 1 / 30
    restart_after: float = 0.3
    lost_after: float = 5.0
    readings: ReadingConfig = field(default_factory=ReadingConfig)

    def __post_init__(self) -> None:
        if self.num_boundaries < 2 or self.num_boundaries % 2:
            raise ValueError(f"num_boundaries: expected an even number >= 2, got {self.num_boundaries}")
        if self.iterations < 1 or self.start_iterations < 1:
            got = min(self.iterations, self.start_iterations)
            raise ValueError(f"iterations: expected at least 1, got {got}")
        endless = ("scatter_memory", "lost_after", "restart_after")
        check_settings(self, positive=("scatter_memory", "assumed_dt"), infinite=endless)
        bend = (self.prior.curvature_std, self.prior.curvature_rate_std)
        if not all(0 < sharp < wide for sharp, wide in zip(self.straight, bend, strict=True)):
            raise ValueError(
                f"straight: expected sigmas between 0 and those of the prior, {bend}, got {self.straight}"
            )
        if not 0 < self.bends < 1:
            raise ValueError(f"bends: expected a probability between 0 and 1, got {self.bends}")


HILLY_ROADS = JointConfig(motion=MotionConfig(vertical_curvature_std=2e-5))
"""Numbers for roads that are nowhere plane: a vertical curvature of R = 50 km as the standard deviation."""
