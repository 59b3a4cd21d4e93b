"""Batched Kalman prediction and update, independent of lanes and cameras.

The update is in information form: N scalar measurements enter as a D × D matrix and a D-vector, so it
costs O(N D²) where the gain form inverts an N × N matrix (Eq. (15)), and a measurement of weight zero has no
effect.
"""

import torch
from torch import Tensor

from lanebev.geometry.linalg import cholesky, solve_lower, solve_spd


def predict(mean: Tensor, cov: Tensor, transition: Tensor, process_noise: Tensor) -> tuple[Tensor, Tensor]:
    """Predict mean and covariance by a linear system model.

    Source: Eqs. (12)-(13).

    Args:
        mean: (..., D).
        cov: (..., D, D).
        transition: (..., D, D), F.
        process_noise: (..., D, D), W.

    Returns:
        mean (..., D) and covariance (..., D, D).
    """
    predicted = (transition @ mean.unsqueeze(-1)).squeeze(-1)
    return predicted, symmetrise(transition @ cov @ transition.mT + process_noise)


def innovation(predicted: Tensor) -> Tensor:
    """Compute the innovation of measurements that are all zero.

    Source: Eq. (14), y = -h(x̂).

    Args:
        predicted: (..., N), the measurement model at the predicted state.

    Returns:
        (..., N).
    """
    return -predicted


def information(
    innovation: Tensor, jacobian: Tensor, measurement_noise: Tensor, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Compute the information of N independent scalar measurements, Hᵀ Q⁻¹ H and Hᵀ Q⁻¹ y.

    Args:
        innovation: (..., N), measured minus predicted.
        jacobian: (..., N, D), of the predicted measurement by the state.
        measurement_noise: (..., N) variances, > 0 where the weight is.
        weight: (..., N) in [0, 1], or None for all 1. Measurements of weight 0 are ignored.

    Returns:
        (..., D, D) and (..., D).
    """
    if weight is None:
        weight = torch.ones_like(innovation)
    there = weight > 0
    precision = torch.where(there, weight, 0.0) / torch.where(there, measurement_noise, 1.0)
    jacobian = torch.where(there.unsqueeze(-1), jacobian, 0.0)
    scaled = jacobian * precision.unsqueeze(-1)  # (..., N, D)
    vector = scaled.mT @ torch.where(there, innovation, 0.0).unsqueeze(-1)
    return scaled.mT @ jacobian, vector.squeeze(-1)


def update_gain_form(
    mean: Tensor, cov: Tensor, innovation: Tensor, jacobian: Tensor, measurement_noise: Tensor
) -> tuple[Tensor, Tensor]:
    """Update with N independent scalar measurements as the paper prints it.

    Source: Eqs. (15)-(17), S = H P Hᵀ + Q, G = P Hᵀ S⁻¹, x + G y and (I - G H) P. S is N × N: the calibrators
    use :func:`update`, which is equal to rounding.

    Args:
        mean: (..., D), predicted.
        cov: (..., D, D), predicted.
        innovation: (..., N), y.
        jacobian: (..., N, D), H.
        measurement_noise: (..., N) variances, the diagonal of Q.

    Returns:
        mean (..., D) and covariance (..., D, D).
    """
    innovation_cov = jacobian @ cov @ jacobian.mT + measurement_noise.diag_embed()
    gain = torch.linalg.solve(innovation_cov, jacobian @ cov).mT  # P Hᵀ S⁻¹, S being symmetric
    eye = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
    return mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1), (eye - gain @ jacobian) @ cov


def update(mean: Tensor, cov: Tensor, info_matrix: Tensor, info_vector: Tensor) -> tuple[Tensor, Tensor]:
    """Update with the information of any number of measurements.

    Source: Eqs. (15)-(17). Deviation: information form instead of the gain form, equal to rounding, since
    S is N × N; and Joseph form of the covariance, since (I - G H) P loses symmetry and, in float32, sign.

    With P = L Lᵀ: P⁺ = L (I + Lᵀ Λ L)⁻¹ Lᵀ, which needs no inverse of P; then
    P⁺ = (I - P⁺ Λ) P (I - P⁺ Λ)ᵀ + P⁺ Λ P⁺, the Joseph form for the gain G = P⁺ Hᵀ Q⁻¹.

    Args:
        mean: (..., D), predicted.
        cov: (..., D, D), predicted, positive definite.
        info_matrix: (..., D, D), Λ = Hᵀ Q⁻¹ H.
        info_vector: (..., D), Hᵀ Q⁻¹ y with y the innovation at ``mean``.

    Returns:
        mean (..., D) and covariance (..., D, D).
    """
    root = cholesky(cov)
    eye = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
    half = solve_lower(cholesky(eye + root.mT @ info_matrix @ root), root.mT)  # (..., D, D)
    posterior = half.mT @ half
    keep = eye - posterior @ info_matrix
    joseph = keep @ cov @ keep.mT + posterior @ info_matrix @ posterior
    return mean + (posterior @ info_vector.unsqueeze(-1)).squeeze(-1), symmetrise(joseph)


def smoother_gain(cov: Tensor, transition: Tensor, process_noise: Tensor, linked: Tensor) -> Tensor:
    """Compute the gain of a smoother, C = P Fᵀ (F P Fᵀ + W)⁻¹, its entries outside of a mask being zero.

    Source: (J32) of docs/method/joint.md; Särkkä 2013, Bayesian Filtering and Smoothing, Sec. 8.2.

    Args:
        cov: (..., D, D), P, filtered.
        transition: (..., D, D), F, to the later state.
        process_noise: (..., D, D), W.
        linked: (..., D, D) bool, [i, j]: entry j of the later state has information on entry i. Blocks are
            solved separately; an entry without information has a column of zeros.

    Returns:
        (..., D, D).
    """
    crossed = transition @ cov  # (..., D, D)
    predicted = symmetrise(crossed @ transition.mT + process_noise)
    known = linked.diagonal(dim1=-2, dim2=-1)  # (..., D) of the later state
    among = linked & known.unsqueeze(-1)
    predicted = torch.where(among, predicted, 0.0) + (~known).to(cov).diag_embed()
    return solve_spd(predicted, torch.where(linked.mT, crossed, 0.0)).mT


def smoother_covariance(cov: Tensor, transition: Tensor, process_noise: Tensor, gain: Tensor) -> Tensor:
    """Compute the covariance of a smoothed state if the later one were known exactly.

    Source: (J33); Särkkä 2013, Sec. 8.2, P + C (P' - F P Fᵀ - W) Cᵀ. Deviation: as a sum of positive terms,
    (I - C F) P (I - C F)ᵀ + C W Cᵀ + C P' Cᵀ, which holds for every C and keeps sign in floating point. The
    last term, with the later state's covariance P', is left to the recursion.

    Args:
        cov: (..., D, D), P, filtered.
        transition: (..., D, D), F, to the later state.
        process_noise: (..., D, D), W.
        gain: (..., D, D), C.
    """
    keep = torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device) - gain @ transition
    return symmetrise(keep @ cov @ keep.mT + gain @ process_noise @ gain.mT)


def gate(
    innovation: Tensor, jacobian: Tensor, measurement_noise: Tensor, cov: Tensor, sigmas: float
) -> Tensor:
    """Return which measurements are within so many standard deviations of their prediction.

    Args:
        innovation: (..., N).
        jacobian: (..., N, D).
        measurement_noise: (..., N) variances.
        cov: (..., D, D), predicted.
        sigmas: bound on |innovation| over its standard deviation sqrt(h P hᵀ + q).

    Returns:
        (..., N) bool.
    """
    predicted = ((jacobian @ cov) * jacobian).sum(-1)
    return innovation.square() <= sigmas**2 * (predicted + measurement_noise)


def constant_velocity(dt: Tensor, spectral_density: Tensor) -> tuple[Tensor, Tensor]:
    """Return transition and process noise of D/2 positions followed by their D/2 rates.

    Source: Eqs. (9), (10); Bar-Shalom, Li, Kirubarajan 2001, Sec. 6.2.2. Deviation: the noise is a white
    acceleration integrated over dt, which reaches the positions too, so that frames of any spacing agree.

    Args:
        dt: (B,) s, >= 0.
        spectral_density: (D/2,) of the acceleration, unit² / s³.

    Returns:
        (B, D, D) F and (B, D, D) W.
    """
    half = spectral_density.shape[-1]
    eye = torch.eye(half, dtype=dt.dtype, device=dt.device)
    step = dt[:, None, None]
    zero, one = torch.zeros_like(step), torch.ones_like(step)
    steps = torch.cat([torch.cat([one, step], -1), torch.cat([zero, one], -1)], -2)  # (B, 2, 2)
    noise = torch.cat([torch.cat([step**3 / 3, step**2 / 2], -1), torch.cat([step**2 / 2, step], -1)], -2)
    return _kron(steps, eye), _kron(noise, torch.diag(spectral_density))


def limit_variance(cov: Tensor, limit: Tensor) -> Tensor:
    """Scale a covariance until no variance exceeds its limit, correlations kept.

    Args:
        cov: (..., D, D).
        limit: (D,) variances.

    Returns:
        (..., D, D).
    """
    scale = (limit / cov.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30)).clamp_max(1.0).sqrt()
    return cov * scale.unsqueeze(-1) * scale.unsqueeze(-2)


def symmetrise(matrix: Tensor) -> Tensor:
    """Return the symmetric part, (M + Mᵀ) / 2."""
    return 0.5 * (matrix + matrix.mT)


def _kron(blocks: Tensor, inner: Tensor) -> Tensor:
    """Compute (B, a, a) ⊗ (b, b) -> (B, ab, ab); B may be 0."""
    product: Tensor = torch.einsum("nij,kl->nikjl", blocks, inner)
    return product.reshape(
        blocks.shape[0], blocks.shape[1] * inner.shape[0], blocks.shape[2] * inner.shape[1]
    )
