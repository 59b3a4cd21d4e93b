"""The readings of a single image: which lines bound lanes, and how equal the lanes are.

One image seldom decides between them. :mod:`lanebev.estimation.joint.averaging` fits every reading and
averages the fits by their evidence, so that the covariance contains the differences between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class ReadingConfig:
    """Prior probabilities and standard deviations of the readings of a single image.

    Attributes:
        unequal: standard deviation of a boundary's place, m, one for each kind of road, from a motorway to a
            street whose lanes differ by half a metre.
        askew: standard deviation of a boundary's heading against the road's, rad, for each kind of road.
        profile: standard deviation of the road's vertical curvature, 1/m, for each kind of road.
        share: prior probability of each kind of road.
        no_boundary: probability that a line bounds no lane: a kerb, an arrow, a cycle path.
        another: probability that the next line does not either.
        anywhere: standard deviations of the place (m) and heading (rad) of such a line.
        information: exponent of the evidence, below 1 since no reading is exactly right and a detector's
            errors are correlated along a boundary.
        least: weight, as a fraction of the best reading's, below which a reading is left out.
    """

    unequal: tuple[float, ...] = (0.0005, 0.4, 0.1, 0.4)
    askew: tuple[float, ...] = (0.00005, 0.001, 0.003, 0.012)
    profile: tuple[float, ...] = (1e-8, 1e-4, 1e-4, 5e-4)
    share: tuple[float, ...] = (0.2, 0.2, 0.2, 0.4)
    no_boundary: float = 0.1
    another: float = 0.5
    anywhere: tuple[float, float] = (2.0, 0.1)
    information: float = 0.5
    least: float = 0.05

    def __post_init__(self) -> None:
        counts = [len(part) for part in (self.unequal, self.askew, self.profile, self.share)]
        if len(set(counts)) > 1 or not counts[0]:
            got = ", ".join(map(str, counts))
            raise ValueError(f"unequal, askew, profile, share: expected as many of each, got {got}")
        sigmas = (*self.unequal, *self.askew, *self.profile, *self.share, *self.anywhere)
        if not all(np.isfinite(sigma) and sigma > 0 for sigma in sigmas):
            raise ValueError(
                f"unequal, askew, profile, share, anywhere: expected positive numbers, got {sigmas}"
            )
        for name in ("no_boundary", "another", "information", "least"):
            value = getattr(self, name)
            if not 0.0 < value <= 1.0:
                raise ValueError(f"{name}: expected more than 0 and at most 1, got {value}")


class Readings(NamedTuple):
    """C readings of a frame of L boundaries.

    Attributes:
        wrong: (C, L) bool, of a line that bounds no lane.
        shift: (C, L) lanes by which a boundary's index is wrong therefore.
        place_std: (C, L) m, of a boundary's deviation from its place.
        heading_std: (C, L) rad, of its heading against the road's.
        profile_std: (C,) 1/m, of the road's vertical curvature.
        kind: (C,) int64, index of the kind of road; the first readings are one of each, without wrong lines.
    """

    wrong: Tensor
    shift: Tensor
    place_std: Tensor
    heading_std: Tensor
    profile_std: Tensor
    kind: Tensor


def readings(num_boundaries: int, cfg: ReadingConfig, like: Tensor) -> Readings:
    """List the readings: all lines bound lanes, on every kind of road; or all but one, on the first and last.

    Args:
        num_boundaries: L.
        cfg: the numbers.
        like: gives dtype and device.
    """
    wrong, shift = _single_wrong_lines(num_boundaries)
    kinds, faults = len(cfg.unequal), len(wrong)
    kind = [*range(kinds), *np.repeat([0, kinds - 1], faults)]
    none = [num_boundaries * [False]]
    is_wrong = torch.as_tensor(np.concatenate([none * kinds, wrong, wrong]), device=like.device)
    moved = np.concatenate([0 * np.array(none * kinds), shift, shift])
    place, heading, profile = (like.new_tensor(part)[kind] for part in (cfg.unequal, cfg.askew, cfg.profile))
    return Readings(
        wrong=is_wrong,
        shift=torch.as_tensor(moved).to(like),
        place_std=torch.where(is_wrong, cfg.anywhere[0], place.unsqueeze(-1)),
        heading_std=torch.where(is_wrong, cfg.anywhere[1], heading.unsqueeze(-1)),
        profile_std=profile,
        kind=torch.as_tensor(kind, device=like.device),
    )


@lru_cache(maxsize=16)
def _single_wrong_lines(num: int) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which lines bound no lane and by how many lanes the others are counted wrong, (F, L) each.

    A wrong line may have been counted as a boundary, or not: those beyond it close up, or stay.
    """
    index, alone = np.arange(num), np.eye(num, dtype=bool)
    outward = np.where(index >= num // 2, 1, -1)
    beyond = (outward == outward[:, None]) & ((index - index[:, None]) * outward > 0)  # [wrong, other]
    closed = -outward * beyond
    inner = slice(1, num - 1)  # an outermost line has none beyond it
    return np.concatenate([alone, alone[inner]]), np.concatenate([0 * closed, closed[inner]])


def log_prior(ways: Readings, there: Tensor, cfg: ReadingConfig) -> Tensor:
    """Compute the log prior (B, C) of every reading; -inf where a line that is wrong is not there.

    Args:
        ways: C readings.
        there: (B, L) bool, lines that were seen.
        cfg: the numbers.
    """
    any_wrong = ways.wrong.any(-1)
    seen = (ways.wrong & there.unsqueeze(1)).any(-1)  # (B, C)
    of_wrong = torch.where(seen, np.log(cfg.no_boundary), -torch.inf)
    of_lines = torch.where(any_wrong, of_wrong, np.log(1 - cfg.no_boundary)).to(ways.shift)
    of_kinds: Tensor = ways.shift.new_tensor(cfg.share).log()
    return of_lines + of_kinds[ways.kind]


def log_prior_of_half(there: Tensor, cfg: ReadingConfig) -> Tensor:
    """Compute the log odds (B,) that every second line bounds no lane, before looking.

    Arrows in the middle of every lane, or seams of the pavement, halve the distance between lines.

    Args:
        there: (B, L) bool, lines that were seen.
        cfg: the numbers.
    """
    more = (there.sum(-1) // 2 - 1).clamp(min=0)
    odds: Tensor = np.log(cfg.no_boundary) + more.to(torch.float64) * np.log(cfg.another)
    return odds
