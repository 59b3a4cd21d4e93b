"""Configuration of the joint calibrator."""

from dataclasses import dataclass, field, fields

import numpy as np

from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.numbers import check_settings
from lanebev.types import NUM_BOUNDARIES


@dataclass(frozen=True)
class MotionConfig:
    """Configuration of the motion model; angles in rad, lengths in m, times in s.

    Attributes:
        bandwidth: Hz, cut-off frequency of the pose's motion.
        angle_std: rad, standard deviation of pitch, yaw and roll about their slow means.
        height_std: m, standard deviation of the height about its slow mean.
        unobserved_scale: least factor on these if the last frame did not determine an angle or the height.
        mean_angle_walk: rad/√s, random walk of the slow mean of an angle.
        mean_height_walk: m/√s, random walk of the slow mean of the height.
        offset_density: spectral density of the lateral acceleration, m²/s³.
        offset_memory: s, time constant of the lateral velocity.
        vertical_curvature_std: 1/m, standard deviation of the road's vertical curvature where nothing says
            that it is curved.
        vertical_curvature_memory: s, time constant of the return to it.
        hill_memory: s, time constant of the return to that standard deviation after a crest or a dip.
        curvature_walk: 1/m/√s, random walk of every knot.
        curvature_step: 1/m, sigma of a step that comes into view on a straight road.
        speed, speed_std: m/s, prior of the speed.
        speed_memory: s, time constant of the return to it.
        measured_speed_std: m/s, standard deviation of a given speed.
        deviation_memory: s, time constant of a boundary's deviation where lanes are equal.
        deviation_walk: m/√s, random walk of a boundary's deviation.
        unequal_memory: s, time constant of the deviations on a road of unequal lanes.
    """

    bandwidth: float = 1.0
    angle_std: float = 0.011
    height_std: float = 0.02
    unobserved_scale: float = 2.0
    mean_angle_walk: float = 5e-4
    mean_height_walk: float = 1e-3
    offset_density: float = 0.2
    offset_memory: float = 2.0
    vertical_curvature_std: float = 1e-6
    vertical_curvature_memory: float = 10.0
    hill_memory: float = 20.0
    curvature_walk: float = 1.4e-6
    curvature_step: float = 5e-5
    speed: float = 20.0
    speed_std: float = 9.0
    speed_memory: float = 30.0
    measured_speed_std: float = 0.5
    deviation_memory: float = 20.0
    deviation_walk: float = 1e-4
    unequal_memory: float = 1.0

    def __post_init__(self) -> None:
        memories = [part.name for part in fields(self) if part.name.endswith("_memory")]
        endless = [name for name in memories if name != "offset_memory"]
        check_settings(self, positive=["bandwidth", *memories], infinite=endless)

    @property
    def pose_std(self) -> tuple[float, float, float, float]:
        """Standard deviations of pitch, yaw, roll (rad) and height (m) about their slow means."""
        return self.angle_std, self.angle_std, self.angle_std, self.height_std


@dataclass(frozen=True)
class ReadingConfig:
    """Prior probabilities and standard deviations of the readings of a single image.

    Attributes:
        deviation_std: standard deviation of a boundary's deviation, m, one for each kind of road, from a
            motorway to a street whose lanes differ by half a metre.
        heading_std: standard deviation of a boundary's heading against the road's, rad, for each kind of
            road.
        vertical_curvature_std: standard deviation of the road's vertical curvature, 1/m, for each kind of
            road.
        kind_probability: prior probability of each kind of road.
        no_boundary_probability: probability that a line bounds no lane: a kerb, an arrow, a cycle path.
        another_probability: probability that the next line does not either.
        no_boundary_std: standard deviations of the deviation (m) and heading (rad) of such a line.
        evidence_exponent: exponent of the evidence, below 1 since no reading is exactly right and a
            detector's errors are correlated along a boundary.
        least_weight: weight, as a fraction of the best reading's, below which a reading is left out.
    """

    deviation_std: tuple[float, ...] = (0.0005, 0.4, 0.1, 0.4)
    heading_std: tuple[float, ...] = (0.00005, 0.001, 0.003, 0.012)
    vertical_curvature_std: tuple[float, ...] = (1e-8, 1e-4, 1e-4, 5e-4)
    kind_probability: tuple[float, ...] = (0.2, 0.2, 0.2, 0.4)
    no_boundary_probability: float = 0.1
    another_probability: float = 0.5
    no_boundary_std: tuple[float, float] = (2.0, 0.1)
    evidence_exponent: float = 0.5
    least_weight: float = 0.05

    def __post_init__(self) -> None:
        kinds = (self.deviation_std, self.heading_std, self.vertical_curvature_std, self.kind_probability)
        names = "deviation_std, heading_std, vertical_curvature_std, kind_probability"
        counts = [len(part) for part in kinds]
        if len(set(counts)) > 1 or not counts[0]:
            got = ", ".join(map(str, counts))
            raise ValueError(f"{names}: expected as many of each, got {got}")
        numbers = (*[number for part in kinds for number in part], *self.no_boundary_std)
        if not all(np.isfinite(number) and number > 0 for number in numbers):
            raise ValueError(f"{names}, no_boundary_std: expected positive numbers, got {numbers}")
        for name in ("no_boundary_probability", "another_probability", "evidence_exponent", "least_weight"):
            value = getattr(self, name)
            if not 0.0 < value <= 1.0:
                raise ValueError(f"{name}: expected more than 0 and at most 1, got {value}")


@dataclass(frozen=True)
class JointConfig:
    """Configuration of :class:`lanebev.JointCalibrator`; angles in rad, lengths in m, times in s.

    Attributes:
        num_boundaries: L.
        iterations: Gauss-Newton steps per frame.
        start_iterations: Gauss-Newton steps for every start of a first frame.
        lane_width_std: sigma of the common scale of the lane widths, m; 0: the widths are exact. ``LaneBEV``
            also multiplies this part of the covariance by ``pose_sigma_scale`` squared.
        scatter_memory: time constant, s, of the mean squares of the boundaries' own deviations and headings;
            inf: they are taken for 0.
        start_heading_std: standard deviation of a boundary's own heading at a start, rad, unless frames show
            that boundaries are parallel; its variance decays over twice ``scatter_memory``.
        lane_deviation_std: sigma of a boundary's deviation where too few are in view to tell whether lanes
            are equal, m; 0: lanes are equal.
        crossfall_break_std: standard deviation of the change of the crossfall at a boundary, as at the crown
            of a road with two directions, where there is one; 0: the road is plane across.
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
    crossfall_break_std: float = 0.04
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
