"""Indices of the state vector of the joint filter."""

from functools import lru_cache
from typing import NamedTuple

from lanebev.estimation.joint.measurement.residuals import CURVATURE, NUM_STRAIGHT, VERTICAL

NUM_POSE = 4
NUM_COMMON = VERTICAL + 1  # entries that all boundaries depend on
POSE = slice(0, NUM_POSE)
SHAPE = slice(CURVATURE, VERTICAL)  # 1/m: curvature at the first knot, then its steps
STEPS = slice(CURVATURE + 1, VERTICAL)
DEVIATIONS = slice(NUM_COMMON, None)  # m; of the observed entries, those of the boundaries' deviations


class Layout(NamedTuple):
    """Indices of the state vector for L boundaries.

    A frame observes the first entries: pose, offset, shape and vertical curvature of the road and the
    deviation of each boundary from its place. The others follow from the motion model only.

    Attributes:
        observed: pose, offset, shape, vertical curvature, deviations.
        deviations: m.
        rates: rates of pitch, yaw, roll, height and offset, per s.
        accelerations: accelerations of the pose, per s².
        jerks: jerks of the pose, per s³.
        means: slow mean of the pose.
        speed: m/s, above ``MotionConfig.speed``.
        size: D.
    """

    observed: slice
    deviations: slice
    rates: slice
    accelerations: slice
    jerks: slice
    means: slice
    speed: int
    size: int

    def chain(self, axis: int) -> tuple[int, int, int, int, int]:
        """Return the indices of an axis of the pose: its value, three derivatives and slow mean."""
        starts = (0, self.rates.start, self.accelerations.start, self.jerks.start, self.means.start)
        first, second, third, fourth, fifth = (int(start) + axis for start in starts)
        return first, second, third, fourth, fifth


@lru_cache(maxsize=16)
def layout(num_boundaries: int) -> Layout:
    """Return the indices for so many boundaries."""
    seen = NUM_COMMON + num_boundaries
    rates = seen + NUM_STRAIGHT
    accelerations, jerks, means = (rates + NUM_POSE * k for k in (1, 2, 3))
    return Layout(
        observed=slice(0, seen),
        deviations=slice(NUM_COMMON, seen),
        rates=slice(seen, rates),
        accelerations=slice(rates, accelerations),
        jerks=slice(accelerations, jerks),
        means=slice(jerks, means),
        speed=means,
        size=means + 1,
    )
