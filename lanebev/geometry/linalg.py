"""Solves with small symmetric positive definite matrices, batched.

A matrix that is not positive definite spoils its own row of a batch only: nothing raises.
"""

import torch
from torch import Tensor


def cholesky(matrix: Tensor) -> Tensor:
    """Compute the lower Cholesky factor.

    Args:
        matrix: (..., D, D), symmetric positive definite.

    Returns:
        (..., D, D) lower L with L Lᵀ = matrix.
    """
    factor: Tensor = torch.linalg.cholesky_ex(matrix).L
    return factor


def solve_lower(lower: Tensor, right: Tensor) -> Tensor:
    """Solve L X = B by forward substitution.

    Args:
        lower: (..., D, D) lower triangular.
        right: (..., D, K).

    Returns:
        (..., D, K).
    """
    solution: Tensor = torch.linalg.solve_triangular(lower, right, upper=False)
    return solution


def times_vector(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply matrices (B, K, M) with vectors (B, M), to (B, K).

    The vector is a column with the strides of a row: with others, ``bmm`` takes up to seven times as long.
    """
    return torch.bmm(matrix, vector.unsqueeze(1).mT).squeeze(-1)


def solve_spd(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve A X = B for symmetric positive definite A.

    A is first scaled to a unit diagonal: its entries may have units 1e5 apart, as curvatures and metres have.

    Args:
        matrix: (..., D, D).
        right: (..., D, K).

    Returns:
        (..., D, K).
    """
    size, factor = _scaled_factor(matrix)
    right = size.unsqueeze(-1) * right
    solution = torch.cholesky_solve(right, factor)
    return size.unsqueeze(-1) * solution


def inverse_spd(matrix: Tensor) -> Tensor:
    """Compute the inverse of a symmetric positive definite matrix, scaled as in :func:`solve_spd`.

    Args:
        matrix: (..., D, D).

    Returns:
        (..., D, D), symmetric.
    """
    size, factor = _scaled_factor(matrix)
    inverse = torch.cholesky_inverse(factor)
    return size.unsqueeze(-1) * inverse * size.unsqueeze(-2)


def reduced_information(matrix: Tensor, vector: Tensor, precision: Tensor) -> Tensor:
    """Compute the information on the last parameters of a fit, whatever the first ones are.

    Source: the Schur complement of the first parameters' information, to which their prior is added.

    Args:
        matrix: (B, P + K, P + K), information matrix.
        vector: (B, P + K), information vector.
        precision: (B, P) or (P,), of independent priors of the first P parameters.

    Returns:
        (B, K, K + 1), matrix and vector side by side.
    """
    first = precision.shape[-1]
    both = torch.cat([matrix[..., first:], vector.unsqueeze(-1)], dim=-1)
    factor = cholesky(matrix[:, :first, :first] + precision.diag_embed())
    known = solve_lower(factor, both[:, :first])
    return both[:, first:] - known[..., :-1].mT @ known


def _scaled_factor(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return the scale (..., D) to a unit diagonal and the Cholesky factor of the scaled matrix."""
    size = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
    return size, cholesky(size.unsqueeze(-1) * matrix * size.unsqueeze(-2))
