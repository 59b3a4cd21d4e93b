"""Dynamics of the joint filter's state; ``low_pass`` has those of the pose, ``road`` those of the road."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.layout import NUM_POSE, SHAPE, layout
from lanebev.estimation.joint.measurement.residuals import OFFSET, VERTICAL
from lanebev.estimation.joint.motion.low_pass import ORDER, pose_transition
from lanebev.tensors import constant


class RoadMotion(NamedTuple):
    """The shape's motion over a step, see :func:`lanebev.estimation.joint.motion.road.propagate_road_shape`.

    Attributes:
        shape: (B, NUM_SHAPE) after it.
        phase: (B,) m, after it.
        transition: (B, NUM_SHAPE, NUM_SHAPE).
        by_speed: (B, NUM_SHAPE), derivative of the shape by the speed.
        noise: (B, NUM_SHAPE) variances.
    """

    shape: Tensor
    phase: Tensor
    transition: Tensor
    by_speed: Tensor
    noise: Tensor


class Spread(NamedTuple):
    """How far entries of the state move about their means.

    Attributes:
        pose_scale: (B, 4), factor on the pose's standard deviations about its slow mean.
        unequal: (B,) m, standard deviation of the deviations on a road of unequal lanes; 0 on equal lanes.
        vertical: (B,) 1/m, standard deviation of the road's vertical curvature.
    """

    pose_scale: Tensor
    unequal: Tensor
    vertical: Tensor


def motion(
    dt: Tensor, spread: Spread, road: RoadMotion, num_boundaries: int, cfg: MotionConfig
) -> tuple[Tensor, Tensor]:
    """Compute transition and process noise of the whole state.

    Args:
        dt: (B,) s, >= 0.
        spread: how far entries move about their means.
        road: how the shape moves.
        num_boundaries: L.
        cfg: the configuration.

    Returns:
        (B, D, D) F and (B, D, D) W.
    """
    num, size = num_boundaries, layout(num_boundaries).size
    pose_step, pose_noise = pose_transition(dt, cfg.bandwidth)
    to_mean = constant(((1,), (0,), (0,), (0,)), like=dt) - pose_step[:, :, :1]
    pose_step = torch.cat([pose_step, to_mean], dim=-1).flatten(1)  # (B, 20)
    offset_step, offset_noise = damped_velocity(dt, cfg.offset_memory)
    memories = (cfg.speed_memory, cfg.vertical_curvature_memory, cfg.deviation_memory, cfg.unequal_memory)
    step, unequal, vertical = (part.unsqueeze(-1) for part in (dt, *spread[1:]))  # (B, 1)
    decays = (-step / constant(memories, like=dt)).exp().chunk(4, dim=-1)
    speed_decay, vertical_decay, of_equal_lanes, of_unequal_lanes = decays
    deviation_decay = torch.where(unequal > 0, of_unequal_lanes, of_equal_lanes)
    moves = [
        *[pose_step] * NUM_POSE,
        torch.ones_like(spread.pose_scale),
        offset_step,
        road.transition.flatten(1),
        road.by_speed,
        speed_decay,
        deviation_decay.expand(-1, num),
        vertical_decay,
    ]
    std = constant(cfg.pose_std, like=dt)
    walk = constant((*[cfg.mean_angle_walk**2] * 3, cfg.mean_height_walk**2), like=dt)
    variance = (spread.pose_scale * std).square()
    deviation_noise = cfg.deviation_walk**2 * step + unequal.square() * (
        1 - deviation_decay * deviation_decay
    )
    noises = [
        (variance.unsqueeze(-1) * pose_noise.flatten(1).unsqueeze(1)).flatten(1),
        walk * step,
        cfg.offset_density * offset_noise,
        road.noise + cfg.curvature_walk**2 * step,
        (2 * cfg.speed_std**2 / cfg.speed_memory) * step,
        deviation_noise.expand(-1, num),
        vertical.square() * (1 - vertical_decay * vertical_decay),
    ]
    values = torch.cat([*moves, *noises], dim=-1)
    index = constant(_places(num), like=values, dtype=torch.int64).expand(values.shape[0], -1)
    flat = values.new_zeros(values.shape[0], 2 * size**2).scatter(1, index, values)
    transition, noise = flat.unflatten(1, (2, size, size)).unbind(1)
    return transition, noise


@lru_cache(maxsize=16)
def _places(num_boundaries: int) -> tuple[int, ...]:
    """Return the flat indices of the entries of F and, after it, W, in the order of :func:`motion`."""
    indices = layout(num_boundaries)

    def block(rows: Sequence[int], columns: Sequence[int]) -> list[int]:
        return [indices.size * row + column for row in rows for column in columns]

    def diagonal(entries: slice) -> list[int]:
        return [(indices.size + 1) * entry for entry in range(entries.start, entries.stop)]

    chains = [indices.chain(axis) for axis in range(NUM_POSE)]
    lateral = (OFFSET, indices.rates.start + OFFSET)
    shape = range(SHAPE.start, SHAPE.stop)
    speed = slice(indices.speed, indices.speed + 1)
    moves = [block(chain[:ORDER], chain) for chain in chains]
    moves += [
        diagonal(indices.means),
        block(lateral, lateral),
        block(shape, shape),
        block(shape, [indices.speed]),
    ]
    vertical = slice(VERTICAL, VERTICAL + 1)
    moves += [diagonal(speed), diagonal(indices.deviations), diagonal(vertical)]
    noises = [block(chain[:ORDER], chain[:ORDER]) for chain in chains]
    noises += [diagonal(indices.means), block(lateral, lateral), diagonal(SHAPE), diagonal(speed)]
    noises += [diagonal(indices.deviations), diagonal(vertical)]
    return (*itertools.chain(*moves), *(indices.size**2 + entry for entry in itertools.chain(*noises)))


def damped_velocity(dt: Tensor, memory: float) -> tuple[Tensor, Tensor]:
    """Compute transition and noise of a position whose velocity decays, driven by white acceleration.

    Args:
        dt: (B,) s.
        memory: s, time constant of the velocity.

    Returns:
        (B, 4) transition of (x, ẋ), row by row, and (B, 4) noise at unit density.
    """
    fade = (-dt / memory).exp()
    one, zero = torch.ones_like(dt), torch.zeros_like(dt)
    transition = torch.stack([one, memory * (1 - fade), zero, fade], dim=-1)
    short = dt.clamp(max=memory)  # the velocity's variance stops growing there
    square = short * short
    half = square / 2
    noise = torch.stack([square * dt / 3, half, half, short], dim=-1)
    return transition, noise
