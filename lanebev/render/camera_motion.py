"""The motion of a camera on its vehicle: suspension, bumps and lane changes."""

import math

import torch

from lanebev.render.scene.places.street import Street
from lanebev.render.scene.road.layout import Layout
from lanebev.render.scene.sampler import BatchSampler
from lanebev.types import Extrinsics

_LANE_CHANGE = 4.5  # s
_DAMPING, _BUMP_RATE = 4.0, 9.0  # 1/s and rad/s of a suspension after a bump


class SmoothNoise:
    """A sum of sinusoids: a repeatable, band-limited signal at any time.

    Args:
        sampler: the randomness, one row.
        amplitude: about the largest value.
        low: Hz, lowest frequency.
        high: Hz, highest frequency.
    """

    def __init__(
        self, sampler: BatchSampler, amplitude: float, low: float, high: float, terms: int = 6
    ) -> None:
        self.rate = 2 * math.pi * low * (high / low) ** sampler.uniform(0, 1, terms)[0].double()
        self.phase = sampler.uniform(0, 2 * math.pi, terms)[0].double()
        weight = self.rate**-0.5
        self.weight = amplitude * weight / weight.norm() / math.sqrt(2)

    def __call__(self, time: float) -> float:
        """Return the value at ``time`` s."""
        return float((self.weight * (self.rate * time + self.phase).sin()).sum())


class LanePath:
    """The vehicle's way across the road: the middle of a lane, smooth lane changes, and wander.

    Args:
        sampler: the randomness, one row.
        street: tells the lanes of the own direction.
        layout: the boundaries.
        first: lane at the start.
        duration: s of the drive.
        changes: whether lanes are changed.
    """

    def __init__(
        self,
        sampler: BatchSampler,
        street: Street,
        layout: Layout,
        first: int,
        duration: float,
        changes: bool,
    ) -> None:
        lowest, lanes = int(street.first), int(street.own) or int(layout.exists.sum()) - 1
        self._layout = layout
        self._changes: list[tuple[float, int, int]] = []  # start (s), from lane, to lane
        self._first = lane = min(first, lowest + max(lanes - 1, 0))
        time = float(sampler.uniform(3.0, 7.0))
        while changes and lanes > 1 and time + _LANE_CHANGE < duration:
            step = 1 if bool(sampler.chance(0.5)) else -1
            target = lane + step if lowest <= lane + step < lowest + lanes else lane - step
            self._changes.append((time, lane, target))
            lane, time = target, time + float(sampler.uniform(7.0, 16.0))
        self._wander = SmoothNoise(sampler, 0.25, 0.05, 0.25)

    def across(self, time: float) -> float:
        """Return the lateral position at a time, m in the layout's frame."""
        place = self._middle(self._first)
        for start, old, new in self._changes:
            u = min(max((time - start) / _LANE_CHANGE, 0.0), 1.0)
            blend = u**3 * (10 - 15 * u + 6 * u * u)
            place += blend * (self._middle(new) - self._middle(old))
        return place + self._wander(time)

    def _middle(self, lane: int) -> float:
        return float(self._layout.across[0, lane : lane + 2].mean())


class BodyMotion:
    """The camera's pose beside the path's direction: mount, suspension and bumps.

    Args:
        sampler: the randomness, one row.
        duration: s of the drive.
        factor: factor of all suspension movement.
        mount: pitch, yaw, roll (rad) and height (m) of the camera at rest; None draws it.
    """

    def __init__(
        self, sampler: BatchSampler, duration: float, factor: float, mount: Extrinsics | None
    ) -> None:
        degree = math.pi / 180 * factor
        self._noises = (
            SmoothNoise(sampler, 0.45 * degree, 0.15, 2.0),  # pitch
            SmoothNoise(sampler, 0.15 * degree, 0.1, 0.8),  # yaw, beside that of the path
            SmoothNoise(sampler, 0.35 * degree, 0.1, 1.5),  # roll
            SmoothNoise(sampler, 0.015 * factor, 0.2, 2.0),  # height
        )
        bumps = max(1, int(duration / 6))
        self._bump_times = sampler.uniform(1.0, max(duration, 1.5), bumps)[0].double()
        self._bump_sizes = sampler.uniform(-1.0, 1.0, bumps)[0].double() * degree
        if mount is None:
            angles = sampler.normal(1.0, 3)[0].clamp(-2, 2) * torch.tensor([1.5, 1.0, 0.6]) * (math.pi / 180)
            self._mount = [*angles.tolist(), float(sampler.uniform(1.25, 1.6))]
        else:
            self._mount = [float(value) for value in mount]

    def pose(self, time: float) -> tuple[float, float, float, float]:
        """Return pitch, yaw, roll (rad) and height (m) at a time."""
        since = (time - self._bump_times).clamp(min=0)
        bump = self._bump_sizes * (-_DAMPING * since).exp() * (_BUMP_RATE * since).sin()
        pitch, yaw, roll, height = (
            m + noise(time) for m, noise in zip(self._mount, self._noises, strict=True)
        )
        return pitch + float(bump.sum()), yaw, roll, height
