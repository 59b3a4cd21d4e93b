"""Average of one frame's fit over a straight and a bent road."""

import math

from torch import Tensor

from lanebev.estimation import kalman
from lanebev.estimation.joint.measurement.residuals import CURVATURE
from lanebev.geometry.linalg import cholesky, inverse_spd


def straight_or_bend(
    params: Tensor, cov: Tensor, straight: Tensor, bend: Tensor, share: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Average one frame's fit over two models of the road, straight and bent, weighted by their evidence.

    Source: (J18).

    A distant bend and a yaw have nearly the same effect. Choosing the likelier model would be wrong by many
    standard deviations if the other holds, so the difference of the two fits enters the covariance. Source:
    Bayesian model averaging (Hoeting et al. 1999) of two Gaussians, moments matched. The straight road is a
    measurement of c0 = c1 = 0 whose noise turns the one prior into the other.

    Args:
        params: (B, 7) fitted to a frame as a bend, in the order of ``NUM_PARAMS``.
        cov: (B, 7, 7).
        straight: (2,) 1/m and 1/m², sigmas of c0 and c1 of a straight road.
        bend: (2,), those of a bend, larger, which the fit had for a prior.
        share: prior probability of bends.

    Returns:
        mean (B, 7), covariance (B, 7, 7), and the log odds (B,) of a straight road against a bend.
    """
    noise = 1 / (straight.square().reciprocal() - bend.square().reciprocal())
    curvature, gain = params[:, CURVATURE:], cov[:, :, CURVATURE:]
    predicted = cov[:, CURVATURE:, CURVATURE:] + noise.diag()
    inverse = inverse_spd(predicted)
    chi2 = (curvature.unsqueeze(1) @ inverse @ curvature.unsqueeze(-1)).flatten()
    sharper = 0.5 * (bend.square() + noise).log().sum()
    sharper = sharper - cholesky(predicted).diagonal(dim1=1, dim2=2).log().sum(-1)
    odds = math.log((1 - share) / share) + sharper - 0.5 * chi2
    is_straight = odds.sigmoid()[:, None, None]
    pull = gain @ (inverse @ curvature.unsqueeze(-1))  # (B, 7, 1), from the bend to the straight road
    known = gain @ inverse @ gain.mT
    spread = is_straight * (1 - is_straight) * (pull @ pull.mT)
    mean = params - (is_straight * pull).squeeze(-1)
    return mean, kalman.symmetrise(cov - is_straight * known + spread), odds
