"""Scaling of the standard deviations of a single image's information."""

from torch import Tensor

from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.geometry.linalg import inverse_spd


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
