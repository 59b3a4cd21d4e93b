"""Solves with small symmetric positive definite matrices, batched; they trace into ONNX, which has none.

A matrix that is not positive definite spoils its own row of a batch only: nothing raises.
"""

from __future__ import annotations

import torch
from torch import Tensor


def cholesky(matrix: Tensor) -> Tensor:
    """Compute the lower Cholesky factor.

    Args:
        matrix: (..., D, D), symmetric positive definite.

    Returns:
        (..., D, D) lower L with L Lᵀ = matrix.
    """
    if torch.compiler.is_exporting():
        return _cholesky_by_columns(matrix)
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
    if torch.compiler.is_exporting():
        return _forward_substitution(lower, right)
    solution: Tensor = torch.linalg.solve_triangular(lower, right, upper=False)
    return solution


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
    if torch.compiler.is_exporting():
        half = _forward_substitution(factor, right)
        solution = _forward_substitution(factor.mT.flip(-1, -2), half.flip(-2)).flip(-2)
    else:
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
    if torch.compiler.is_exporting():
        eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        half = _forward_substitution(factor, eye.expand_as(matrix))
        inverse = half.mT @ half
    else:
        inverse = torch.cholesky_inverse(factor)
    return size.unsqueeze(-1) * inverse * size.unsqueeze(-2)


def _scaled_factor(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Scale (..., D) to a unit diagonal, and the Cholesky factor of the scaled matrix."""
    size = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
    return size, cholesky(size.unsqueeze(-1) * matrix * size.unsqueeze(-2))


def _cholesky_by_columns(matrix: Tensor) -> Tensor:
    """Compute the Cholesky factor a column at a time, left-looking (Golub and Van Loan 2013, Sec. 4.2.5)."""
    columns: list[Tensor] = []
    for j in range(matrix.shape[-1]):
        column = matrix[..., j]  # (..., D)
        if columns:
            before = torch.stack(columns, dim=-1)  # (..., D, j)
            column = column - (before @ before[..., j, :].unsqueeze(-1)).squeeze(-1)
        column = column * column[..., j : j + 1].rsqrt()
        columns.append(torch.cat([torch.zeros_like(column[..., :j]), column[..., j:]], dim=-1))
    return torch.stack(columns, dim=-1)


def _forward_substitution(lower: Tensor, right: Tensor) -> Tensor:
    """Solve L X = B a row at a time."""
    rows: list[Tensor] = []
    for i in range(lower.shape[-1]):
        row = right[..., i, :]  # (..., K)
        if rows:
            before = torch.stack(rows, dim=-2)  # (..., i, K)
            row = row - (lower[..., i, :i].unsqueeze(-2) @ before).squeeze(-2)
        rows.append(row / lower[..., i, i].unsqueeze(-1))
    return torch.stack(rows, dim=-2)
