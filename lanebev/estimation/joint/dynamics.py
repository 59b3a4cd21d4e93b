"""How the joint filter's state moves between frames, and what it is made of.

The mean is [pitch, yaw, roll, height, offset | curvature at the first knot and its steps | rates of the
first five | slow mean of the pose | speed | deviation of each boundary from its place].

The pose swings about its slow mean as a critically damped spring driven by white noise: within a frame a
constant-velocity model, over seconds of nothing a return to the mount's pose with a bounded sigma. What the
last frame did not determine swings on a stiffer spring with more noise: between seen frames any density
follows the swing, unseen its sigma must cover it, and a suspension does swing back.

Boundaries keep their places: deviations decay slowly, and on a road of unequal lanes fast, with noise that
keeps up how much they may be, since offset, height and roll mimic half of them.

How the road comes nearer is in ``joint_road``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from lanebev.estimation.joint.measurement import CURVATURE, NUM_STEPS, NUM_STRAIGHT, OFFSET

NUM_POSE = 4
NUM_SEEN = NUM_STRAIGHT + 1 + NUM_STEPS  # what a frame observes, the deviations apart
STEPS = slice(CURVATURE + 1, NUM_SEEN)
SHAPE = slice(CURVATURE, NUM_SEEN)
RATES = slice(NUM_SEEN, NUM_SEEN + 5)
MEANS = slice(NUM_SEEN + 5, NUM_SEEN + 9)
SPEED = NUM_SEEN + 9
NUM_COMMON = NUM_SEEN + 10  # then follow the L deviations


@dataclass(frozen=True)
class MotionConfig:
    """Numbers of the motion; angles in rad, lengths in m, times in s.

    Attributes:
        angular_density: of the angular acceleration, rad²/s³.
        height_density: of the vertical acceleration, m²/s³.
        spring: rad/s, rate of return to the slow mean.
        held_spring: rad/s, likewise of what the last frame did not determine.
        held_factor: by which its density is larger.
        mean_angle_walk: rad/√s, of the slow mean.
        mean_height_walk: m/√s.
        offset_density: of the lateral acceleration, m²/s³.
        offset_memory: s, of the lateral velocity.
        curvature_walk: 1/m/√s, of every knot.
        curvature_step: 1/m, sigma of a step that comes into view.
        speed, speed_std: m/s, before anything is known.
        speed_memory: s, over which it is forgotten.
        deviation_memory: s, decay of a boundary's deviation where lanes are equal.
        deviation_walk: m/√s.
        unequal_memory: s, decay of the deviations on a road of unequal lanes.
    """

    angular_density: float = 0.04
    height_density: float = 0.08
    spring: float = 2.5
    held_spring: float = 5.0
    held_factor: float = 6.0
    mean_angle_walk: float = 5e-4
    mean_height_walk: float = 1e-3
    offset_density: float = 0.2
    offset_memory: float = 2.0
    curvature_walk: float = 2e-6
    curvature_step: float = 1e-4
    speed: float = 20.0
    speed_std: float = 8.0
    speed_memory: float = 30.0
    deviation_memory: float = 20.0
    deviation_walk: float = 1e-4
    unequal_memory: float = 1.0


def motion(
    dt: Tensor, held: Tensor, unequal: Tensor, num_boundaries: int, cfg: MotionConfig
) -> tuple[Tensor, Tensor]:
    """Transition and process noise over dt, the road's coming nearer apart (``joint_road``).

    What is held is decided once for all of dt: half a second at once is not fifteen frames without segments.

    Args:
        dt: (B,) s, >= 0.
        held: (B, 4) bool, what of pitch, yaw, roll, height the last frame did not determine.
        unequal: (B,) m, sigma of the deviations on a road of unequal lanes; 0 on one of equal lanes.
        num_boundaries: L.
        cfg: the numbers.

    Returns:
        (B, D, D) F and (B, D, D) W, D = NUM_COMMON + L.
    """
    density = dt.new_tensor([cfg.angular_density] * 3 + [cfg.height_density])
    density = torch.where(held, cfg.held_factor * density, density)  # (B, 4)
    swing, drive = spring(dt.unsqueeze(-1), torch.where(held, cfg.held_spring, dt.new_tensor(cfg.spring)))
    swing = torch.cat([swing, 1 - swing[..., :1], -swing[..., 2:3]], dim=-1)  # (B, 4, 6)
    slide, push = _damped(dt, cfg.offset_memory)
    fade = (-dt / cfg.speed_memory).exp()
    memory = torch.where(unequal > 0, cfg.unequal_memory, dt.new_tensor(cfg.deviation_memory))
    settle = (-dt / memory).exp()
    still = torch.stack([torch.ones_like(dt), fade, settle], dim=-1)
    moves = torch.cat([swing.flatten(1), slide, still], dim=-1)  # (B, 31)
    drive = (density.unsqueeze(-1) * drive).flatten(1)
    wander = cfg.deviation_walk**2 * dt + unequal.square() * (1 - settle * settle)
    walks = torch.stack([dt, wander], dim=-1)
    shakes = torch.cat([drive, cfg.offset_density * push, walks], dim=-1)  # (B, 22)
    on_moves, on_shakes = _patterns(num_boundaries, cfg)
    transition = torch.einsum("bk,kij->bij", moves, torch.as_tensor(on_moves).to(dt))
    return transition, torch.einsum("bk,kij->bij", shakes, torch.as_tensor(on_shakes).to(dt))


@lru_cache(maxsize=16)
def _patterns(num_boundaries: int, cfg: MotionConfig) -> tuple[np.ndarray, np.ndarray]:
    """Where each of the 31 numbers of F and the 22 of W go, (31, D, D) and (22, D, D)."""
    size = NUM_COMMON + num_boundaries
    moves, shakes = np.zeros((31, size, size)), np.zeros((22, size, size))
    one, fade, settle, time, wander = 28, 29, 30, 20, 21
    walk = [cfg.mean_angle_walk] * 3 + [cfg.mean_height_walk]
    for x in range(NUM_POSE):
        rate, mean = RATES.start + x, MEANS.start + x
        places = ((x, x), (x, rate), (rate, x), (rate, rate), (x, mean), (rate, mean))
        for k, place in enumerate(places):
            moves[6 * x + k][place] = 1
        for k, place in enumerate(places[:4]):
            shakes[4 * x + k][place] = 1
        moves[one, mean, mean] = 1
        shakes[time, mean, mean] = walk[x] ** 2
    rate = RATES.start + OFFSET
    for k, place in enumerate(((OFFSET, OFFSET), (OFFSET, rate), (rate, OFFSET), (rate, rate))):
        moves[24 + k][place] = 1
        shakes[16 + k][place] = 1
    for knot in range(CURVATURE, NUM_SEEN):
        moves[one, knot, knot] = 1
        shakes[time, knot, knot] = cfg.curvature_walk**2
    moves[fade, SPEED, SPEED] = 1
    shakes[time, SPEED, SPEED] = 2 * cfg.speed_std**2 / cfg.speed_memory
    for own in range(NUM_COMMON, size):
        moves[settle, own, own] = 1
        shakes[wander, own, own] = 1
    return moves, shakes


def spring(dt: Tensor, rate: float | Tensor) -> tuple[Tensor, Tensor]:
    """Critically damped spring driven by white noise, ẍ = -2 ω ẋ - ω² x + w.

    Source: the exact discretisation; the impulse response is h(t) = t e^(-ω t), and the noise integrals are
    those of h², h ḣ and ḣ². For ω → 0 it is :func:`lanebev.estimation.kalman.constant_velocity`.

    Args:
        dt: (...) s.
        rate: ω, rad/s, float or broadcast against dt. The stationary variance of x is density / (4 ω³).

    Returns:
        (..., 4) transition of (x, ẋ), its 2 × 2 entries row by row, and (..., 4) noise at unit density.
    """
    turn = rate * dt
    decay = (-turn).exp()
    transition = torch.stack(
        [decay * (1 + turn), decay * dt, -decay * rate * turn, decay * (1 - turn)], dim=-1
    )
    faded = decay * decay
    # (1 - e^(-2a) (1 + 2a + 2a²)) / (4 ω³) and its like cancel at small a: as series, in float32 too
    small = turn < 0.1
    safe = torch.where(small, 1.0, turn)
    position = (1 - (-2 * safe).exp() * (1 + 2 * safe + 2 * safe**2)) / (4 * rate**3)
    position = torch.where(small, dt**3 * (1 / 3 - turn / 2 + 2 * turn**2 / 5 - 2 * turn**3 / 9), position)
    velocity = (1 - faded * (1 - 2 * turn + 2 * turn**2)) / (4 * rate)
    both = 0.5 * dt * dt * faded
    return transition, torch.stack([position, both, both, velocity], dim=-1)


def _damped(dt: Tensor, memory: float) -> tuple[Tensor, Tensor]:
    """Position and decaying velocity: (B, 4) transition and (B, 4) noise, as :func:`spring`."""
    fade = (-dt / memory).exp()
    one, zero = torch.ones_like(dt), torch.zeros_like(dt)
    transition = torch.stack([one, memory * (1 - fade), zero, fade], dim=-1)
    short = dt.clamp(max=memory)  # the velocity's variance stops growing there
    noise = torch.stack([short**2 * dt / 3, short * short / 2, short * short / 2, short], dim=-1)
    return transition, noise
