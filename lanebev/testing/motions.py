"""Motions of a camera over the road, as functions of time, that no estimator was tuned for.

Each is drawn from a stated family by a seed. The random numbers are those of :class:`random.Random`, which
are the same in every version of Python.
"""

import math
from collections.abc import Callable
from random import Random

Pose = tuple[float, float, float, float]
"""Pitch, yaw, roll in rad and height in m."""

Motion = Callable[[float], Pose]
"""A pose at a time in s."""

MOUNT: Pose = (0.0, 0.0, 0.0, 1.5)

_GRAVITY = 9.81  # m/s²
_DROP = 1.2  # m, height of a fall


def sinusoids(
    seed: int, largest_deg: float = 1.5, largest_m: float = 0.05, highest_hz: float = 1.2, mount: Pose = MOUNT
) -> Motion:
    """Draw a motion whose pitch, yaw, roll and height are sums of three sinusoids about the mount.

    Frequencies are uniform between 0.1 Hz and the highest, phases uniform, amplitudes uniform and scaled to
    add up to the largest.

    Args:
        seed: seed of the draw.
        largest_deg: sum of the amplitudes of each angle.
        largest_m: sum of the amplitudes of height.
        highest_hz: see above.
        mount: pose about which it moves.
    """
    random = Random(seed)

    def one(largest: float) -> list[tuple[float, float, float]]:
        sizes = [0.2 + random.random() for _ in range(3)]
        return [
            (
                largest * size / sum(sizes),
                2 * math.pi * random.uniform(0.1, highest_hz),
                random.uniform(0, 2 * math.pi),
            )
            for size in sizes
        ]

    axes = [one(math.radians(largest_deg)) for _ in range(3)] + [one(largest_m)]

    def pose(t: float) -> Pose:
        swings = (sum(size * math.sin(rate * t + phase) for size, rate, phase in axis) for axis in axes)
        pitch, yaw, roll, height = (rest + swing for rest, swing in zip(mount, swings, strict=True))
        return pitch, yaw, roll, height

    return pose


def suspension(seed: int, seconds: float, bumps_per_s: float = 1.5, mount: Pose = MOUNT) -> Motion:
    """Draw the motion of a car's body on a rough road: every bump starts a damped oscillation.

    Bumps come at random; pitch, roll and height answer at 1.3, 1.7 and 1.5 Hz with a fifth of the critical
    damping, by up to 1°, 0.7° and 3 cm; yaw swings by 0.3° at 0.2 Hz, as a driver's steering does.

    Args:
        seed: seed of the draw.
        seconds: from -2 s to which there are bumps.
        bumps_per_s: on average.
        mount: pose about which it moves.
    """
    random = Random(seed)
    times = sorted(random.uniform(-2.0, seconds) for _ in range(round(bumps_per_s * (seconds + 2.0))))
    kicks = [(t, *(random.uniform(-1.0, 1.0) for _ in range(3))) for t in times]
    phase = random.uniform(0, 2 * math.pi)

    def pose(t: float) -> Pose:
        past = [(t - at, *sizes) for at, *sizes in kicks if at < t]
        pitch = math.radians(1.0) * sum(size * damped(since, 1.3) for since, size, _, _ in past)
        roll = math.radians(0.7) * sum(size * damped(since, 1.7) for since, _, size, _ in past)
        height = 0.03 * sum(size * damped(since, 1.5) for since, _, _, size in past)
        yaw = math.radians(0.3) * math.sin(2 * math.pi * 0.2 * t + phase)
        return mount[0] + pitch, mount[1] + yaw, mount[2] + roll, mount[3] + height

    return pose


def damped(t: float, hz: float, damping: float = 0.2) -> float:
    """Compute the response of a damped oscillator t s after an impulse, relative to the undamped amplitude.

    Source: impulse response of a second-order system, e^(-ζωt) sin(ω √(1 - ζ²) t).
    """
    rate = 2 * math.pi * hz
    return math.exp(-damping * rate * t) * math.sin(rate * math.sqrt(1 - damping**2) * t)


def fall(t: float) -> Pose:
    """Compute the difference of a falling car's pose from its pose at rest.

    It begins at rest 1.2 m above, 3° nose up and rolled by 2°, falls freely for half a second,
    turns level as it falls, and its suspension swings at 2.5 Hz: 12 cm, 2° in pitch and 1° in roll at most.

    Args:
        t: s since the beginning of the fall.

    Returns:
        differences of pitch, yaw, roll (rad) and height (m).
    """
    landing = landing_time()
    if t < landing:
        left = 1 - t / landing
        return (-math.radians(3.0) * left, 0.0, math.radians(2.0) * left, _DROP - 0.5 * _GRAVITY * t * t)
    swing = damped(t - landing, 2.5, 0.4)
    return math.radians(2.0) * swing, 0.0, -math.radians(1.0) * swing, -0.12 * swing


def landing_time() -> float:
    """Compute the time, s, of the free fall."""
    return math.sqrt(2 * _DROP / _GRAVITY)


def share_done(t: float, start: float, seconds: float) -> float:
    """Return the share of a change that is done at t (s): 0 up to its start, 1 after so many seconds."""
    return min(max((t - start) / seconds, 0.0), 1.0)


def moved(pose: Pose, by: Pose, share: float = 1.0) -> Pose:
    """Return a pose with differences added, or a share of them."""
    pitch, yaw, roll, height = (value + share * more for value, more in zip(pose, by, strict=True))
    return pitch, yaw, roll, height
