"""The readings of a single image: which lines bound lanes, and how equal the lanes are.

One image seldom decides between them. :mod:`lanebev.estimation.joint.frame.averaging` fits every reading and
averages the fits by their evidence, so that the covariance contains the differences between them.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.estimation.joint.config import ReadingConfig


class Readings(NamedTuple):
    """C readings of a frame of L boundaries.

    Attributes:
        wrong: (C, L) bool, of a line that bounds no lane.
        shift: (C, L) lanes by which a boundary's index is wrong therefore.
        deviation_std: (C, L) m, of a boundary's deviation.
        heading_std: (C, L) rad, of its heading against the road's.
        vertical_curvature_std: (C,) 1/m, of the road's vertical curvature.
        kind: (C,) int64, index of the kind of road; the first readings are one of each, without wrong lines.
    """

    wrong: Tensor
    shift: Tensor
    deviation_std: Tensor
    heading_std: Tensor
    vertical_curvature_std: Tensor
    kind: Tensor


def readings(num_boundaries: int, cfg: ReadingConfig, like: Tensor) -> Readings:
    """List the readings: all lines bound lanes, on every kind of road; or all but one, on the first and last.

    Args:
        num_boundaries: L.
        cfg: the configuration.
        like: gives dtype and device.
    """
    wrong, shift = _single_wrong_lines(num_boundaries)
    kinds, faults = len(cfg.deviation_std), len(wrong)
    kind = [*range(kinds), *np.repeat([0, kinds - 1], faults)]
    none = [num_boundaries * [False]]
    is_wrong = torch.as_tensor(np.concatenate([none * kinds, wrong, wrong]), device=like.device)
    moved = np.concatenate([0 * np.array(none * kinds), shift, shift])
    stds = (cfg.deviation_std, cfg.heading_std, cfg.vertical_curvature_std)
    deviation, heading, vertical_curvature = (like.new_tensor(std)[kind] for std in stds)
    return Readings(
        wrong=is_wrong,
        shift=torch.as_tensor(moved).to(like),
        deviation_std=torch.where(is_wrong, cfg.no_boundary_std[0], deviation.unsqueeze(-1)),
        heading_std=torch.where(is_wrong, cfg.no_boundary_std[1], heading.unsqueeze(-1)),
        vertical_curvature_std=vertical_curvature,
        kind=torch.as_tensor(kind, device=like.device),
    )


@lru_cache(maxsize=16)
def _single_wrong_lines(num: int) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """List which lines bound no lane and by how many lanes the others are counted wrong, (F, L) each.

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
        cfg: the configuration.
    """
    any_wrong = ways.wrong.any(-1)
    seen = (ways.wrong & there.unsqueeze(1)).any(-1)  # (B, C)
    of_wrong = torch.where(seen, np.log(cfg.no_boundary_probability), -torch.inf)
    of_lines = torch.where(any_wrong, of_wrong, np.log(1 - cfg.no_boundary_probability)).to(ways.shift)
    of_kinds: Tensor = ways.shift.new_tensor(cfg.kind_probability).log()
    return of_lines + of_kinds[ways.kind]


def log_prior_of_half(there: Tensor, cfg: ReadingConfig) -> Tensor:
    """Compute the log odds (B,) that every second line bounds no lane, before looking.

    Arrows in the middle of every lane, or seams of the pavement, halve the distance between lines.

    Args:
        there: (B, L) bool, lines that were seen.
        cfg: the configuration.
    """
    more = (there.sum(-1) // 2 - 1).clamp(min=0)
    odds: Tensor = np.log(cfg.no_boundary_probability) + more.to(torch.float64) * np.log(
        cfg.another_probability
    )
    return odds
