"""The prior of a frame's parameters: that of any camera, or that of a mount that is known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from torch import Tensor

from lanebev.geometry.linalg import inverse_spd
from lanebev.tensors import constant

_BODY_STD = (0.003, 0.015, 0.008, 0.03)  # rad, rad, rad, m of a frame's pose about the mount
_MOUNT_FREEDOM = 30.0  # degrees of freedom of a frame's pose about a mount that is known


@dataclass(frozen=True)
class FramePrior:
    """Prior of a single frame, as Student's t distributions, and the start of the search.

    The heavy tails allow a camera rolled by 20 deg. The prior matters only for what the observations leave
    open (roll on one lane, all but two numbers on one boundary). About a known mount it is nearly Gaussian: a
    vehicle's body does not lean by many of its standard deviations.

    Attributes:
        pitch, yaw, roll: means, rad.
        height: mean, m.
        pitch_std, yaw_std, roll_std: standard deviations, rad.
        height_std: standard deviation, m.
        offset_std: standard deviation of the ego lane's middle from the camera, m.
        curvature_std: standard deviation of c0, 1/m.
        curvature_rate_std: standard deviation of c1, 1/m².
        vertical_curvature_std: standard deviation of the vertical curvature where a drive starts, 1/m.
        freedom: degrees of freedom of all of them.
        pitch_range, roll_range: half widths of the search about the means, rad.
        pitch_steps, roll_steps: number of values searched in each; 1 is the mean alone.
    """

    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0
    height: float = 1.5
    pitch_std: float = 0.12
    yaw_std: float = 0.15
    roll_std: float = 0.05
    height_std: float = 0.5
    offset_std: float = 1.5
    curvature_std: float = 2e-3
    curvature_rate_std: float = 2e-5
    vertical_curvature_std: float = 3e-5
    freedom: float = 4.0
    pitch_range: float = 0.24
    roll_range: float = 0.4
    pitch_steps: int = 13
    roll_steps: int = 9

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name)
            if not math.isfinite(value):
                raise ValueError(f"{part.name}: expected a finite number, got {value}")
            if part.name.endswith(("_std", "freedom")) and value <= 0:
                raise ValueError(f"{part.name}: expected more than 0, got {value}")
            if part.name.endswith("_steps") and value < 1:
                raise ValueError(f"{part.name}: expected at least 1, got {value}")
        if self.height <= 0:
            raise ValueError(f"height: expected more than 0 m, got {self.height}")

    def mean(self, like: Tensor) -> Tensor:
        """Return the means (7,), in the order of ``measurement.residuals``."""
        return constant((self.pitch, self.yaw, self.roll, self.height, 0.0, 0.0, 0.0), like=like)

    def std(self, like: Tensor) -> Tensor:
        """Return the standard deviations (7,), in the same order."""
        angles = (self.pitch_std, self.yaw_std, self.roll_std)
        shape = (self.curvature_std, self.curvature_rate_std)
        return constant((*angles, self.height_std, self.offset_std, *shape), like=like)

    def precision(self, params: Tensor) -> Tensor:
        """Compute the precisions (..., P) of the prior, weighted as Student's t at the first P parameters."""
        std = self.std(params)[: params.shape[-1]]
        return student_weight(self._squared(params), self.freedom) / std.square()

    def log_density(self, params: Tensor) -> Tensor:
        """Compute the log density (...) of parameters (..., P), the constant left out."""
        return student_log(self._squared(params), self.freedom)

    def _squared(self, params: Tensor) -> Tensor:
        """Compute the squared normalised distances (..., P) of parameters from their means."""
        count = params.shape[-1]
        return ((params - self.mean(params)[:count]) / self.std(params)[:count]).square()


def prior_of_mount(pose: Sequence[float], std: Sequence[float]) -> FramePrior:
    """Make the prior of a frame from the camera's mount.

    The variances of a vehicle's body about the mount are added to the mount's own. Their standard deviations
    are 0.003 rad in pitch, 0.015 rad in yaw, 0.008 rad in roll and 0.03 m in height: the body moves on its
    suspension, has a heading in its lane and stands on a road with a crossfall. The range of the search
    follows the prior.

    Args:
        pose: pitch, yaw, roll (rad) and height (m) of the mount.
        std: their standard deviations; infinite for unknown axes, whose prior is that without a mount.
    """
    default = FramePrior()
    names = ("pitch", "yaw", "roll", "height")
    known = [name for name, sigma in zip(names, std, strict=True) if math.isfinite(sigma)]
    means = {name: value for name, value in zip(names, pose, strict=True) if name in known}
    wide = zip(names, std, _BODY_STD, strict=True)
    spread = {f"{name}_std": math.hypot(sigma, body) for name, sigma, body in wide if name in known}
    search = {
        f"{name}_range": min(3.0 * spread[f"{name}_std"], getattr(default, f"{name}_range"))
        for name in ("pitch", "roll")
        if name in known
    }
    freedom = {"freedom": _MOUNT_FREEDOM} if known else {}
    changes: dict[str, Any] = {**means, **spread, **search, **freedom}
    return replace(default, **changes)


def temper_frame(pose: Tensor, covariance: Tensor, prior: FramePrior, factor: float) -> tuple[Tensor, Tensor]:
    """Multiply the standard deviations of a frame's information, not those of the prior, by a factor.

    Source: (J31), the power posterior p(x) p(frame | x)^(1/factor²) of Gaussians (Grünwald and van Ommen
    2017).

    Args:
        pose: (B, 4) pitch, yaw, roll (rad), height (m), with the prior in it.
        covariance: (B, 4, 4).
        prior: prior of the frame.
        factor: on the standard deviations, at least 1.

    Returns:
        pose and covariance; those given at a factor of 1, the prior's at a large one.
    """
    mean = prior.mean(pose)[: pose.shape[-1]]
    apart, known = pose - mean, prior.precision(pose).diag_embed()
    share = factor**-2
    information = inverse_spd(covariance)
    weakened = inverse_spd(share * information + (1 - share) * known)
    moved: Tensor = share * (weakened @ information @ apart.unsqueeze(-1)).squeeze(-1)
    return mean + moved, weakened


def student_weight(squared: Tensor, freedom: float) -> Tensor:
    """Compute the weight of a prior, Student's t, at a squared normalised distance.

    It is 1 at the mean, not 1 + 1 / ``freedom``: near the mean the prior is Gaussian with the given sigma.
    """
    return (1 + squared / freedom).reciprocal()


def student_log(squared: Tensor, freedom: float) -> Tensor:
    """Compute its log density, (…, P) to (…), the constant left out."""
    return -0.5 * (freedom + 1) * (squared / freedom).log1p().sum(-1)


def student_density(away: Tensor, freedom: float) -> Tensor:
    """Compute the density of Student's t distribution at so many of its scales from its centre."""
    half = 0.5 * (freedom + 1)
    scale = math.exp(math.lgamma(half) - math.lgamma(half - 0.5)) / math.sqrt(freedom * math.pi)
    return scale * (1 + away.square() / freedom) ** -half
