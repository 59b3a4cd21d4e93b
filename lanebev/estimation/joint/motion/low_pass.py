"""Motion of the pose about its slow mean: band-limited noise.

It is white noise through a fourth-order Butterworth low-pass. A vehicle's body moves like this, smoothly from
frame to frame and back to the mount's pose within a second.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.tensors import constant

Rows = tuple[tuple[float, ...], ...]

ORDER = 4
"""Of the low-pass: the pose and three derivatives."""


class LowPass(NamedTuple):
    """A low-pass with cut-off 1 rad/s, driven by white noise, at unit variance of its output.

    Attributes:
        modes: (4, 16), the transition matrix of (x, ẋ, ẍ, x⃛) as a sum of 4 × 4 matrices, row by row, one for
            each of exp(a₁t) cos(b₁t), exp(a₁t) sin(b₁t), exp(a₂t) cos(b₂t), exp(a₂t) sin(b₂t).
        decays: (2,) a, 1/s.
        turns: (2,) b, rad/s.
        covariance: (4, 4), stationary.
    """

    modes: Rows
    decays: tuple[float, ...]
    turns: tuple[float, ...]
    covariance: Rows


def butterworth() -> LowPass:
    """Return the fourth-order Butterworth low-pass.

    Source: Butterworth 1930, poles exp(iπ (2k + 3) / 8); modal decomposition of the companion matrix; the
    stationary covariance S solves A S + S Aᵀ + g gᵀ = 0 (Särkkä and Solin 2019, Sec. 6.5).
    """
    poles = np.exp(1j * np.pi * (2 * np.arange(1, ORDER + 1) + ORDER - 1) / (2 * ORDER))
    companion = np.eye(ORDER, k=1)
    companion[-1] = -np.poly(poles).real[:0:-1]
    values, vectors = np.linalg.eig(companion)
    inverse = np.linalg.inv(vectors)
    upper = [k for k in range(ORDER) if values[k].imag > 0]
    each = [2 * np.outer(vectors[:, k], inverse[k]) for k in upper]
    modes = np.stack([part.ravel() for matrix in each for part in (matrix.real, -matrix.imag)])
    eye, drive = np.eye(ORDER), np.zeros((ORDER, ORDER))
    drive[-1, -1] = 1.0
    lyapunov = np.kron(eye, companion) + np.kron(companion, eye)
    covariance = np.linalg.solve(lyapunov, -drive.ravel()).reshape(ORDER, ORDER)
    return LowPass(
        _as_rows(modes),
        tuple(values[upper].real.tolist()),
        tuple(values[upper].imag.tolist()),
        _as_rows(covariance / covariance[0, 0]),
    )


def _as_rows(matrix: NDArray[np.float64]) -> Rows:
    return tuple(map(tuple, matrix.tolist()))


_UNIT = butterworth()


def pose_covariance(bandwidth: float, like: Tensor) -> Tensor:
    """Return the stationary covariance (4, 4) of value and three derivatives, at unit variance of value."""
    return constant(_covariance(bandwidth), like=like)


def pose_variances(bandwidth: float) -> tuple[float, ...]:
    """Return the diagonal of :func:`pose_covariance`."""
    return tuple(row[k] for k, row in enumerate(_covariance(bandwidth)))


@lru_cache(maxsize=16)
def _covariance(bandwidth: float) -> Rows:
    cutoff = 2 * math.pi * bandwidth
    rows = enumerate(_UNIT.covariance)
    return tuple(tuple(cutoff ** (i + k) * value for k, value in enumerate(row)) for i, row in rows)


@lru_cache(maxsize=16)
def _modes(bandwidth: float) -> tuple[Rows, tuple[float, ...], tuple[float, ...]]:
    """Return the low-pass at a cut-off frequency (Hz): modes, cosines first; decays and turns, 1/s."""
    cutoff = 2 * math.pi * bandwidth
    powers = [cutoff ** (i - k) for i in range(ORDER) for k in range(ORDER)]
    modes = tuple(
        tuple(value * power for value, power in zip(_UNIT.modes[m], powers, strict=True))
        for m in (0, 2, 1, 3)
    )
    return modes, tuple(cutoff * part for part in _UNIT.decays), tuple(cutoff * part for part in _UNIT.turns)


def pose_transition(dt: Tensor, bandwidth: float) -> tuple[Tensor, Tensor]:
    """Compute transition and process noise of one axis of the pose about its mean, at unit variance.

    Source: (J11).

    Args:
        dt: (B,) s, >= 0.
        bandwidth: Hz, cut-off frequency.

    Returns:
        (B, 4, 4) F of value and three derivatives, and (B, 4, 4) W = S - F S Fᵀ.
    """
    modes, decays, turns = (constant(part, like=dt) for part in _modes(bandwidth))
    time = dt.unsqueeze(-1)
    fade, angle = (time * decays).exp(), time * turns
    mixed = torch.cat([fade * angle.cos(), fade * angle.sin()], dim=-1)  # (B, 4)
    transition = (mixed @ modes).unflatten(-1, (ORDER, ORDER))
    covariance = pose_covariance(bandwidth, dt)
    return transition, covariance - transition @ covariance @ transition.mT
