"""Small positive definite solves: known answers, rows on their own, gradients."""

import pytest
import torch

from lanebev.geometry import linalg

DOUBLE = torch.float64


def spd(size: int, batch: int = 3, seed: int = 0) -> torch.Tensor:
    """Matrices whose entries have units up to 1e5 apart."""
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(batch, size, size, generator=generator, dtype=DOUBLE)
    units = torch.logspace(0, -5, size, dtype=DOUBLE)
    return units[:, None] * (root @ root.mT + 0.1 * torch.eye(size, dtype=DOUBLE)) * units


def test_known_answers():
    matrix = torch.tensor([[4.0, 2.0], [2.0, 5.0]], dtype=DOUBLE)
    assert linalg.cholesky(matrix).tolist() == [[2.0, 0.0], [1.0, 2.0]]
    assert linalg.solve_lower(linalg.cholesky(matrix), torch.tensor([[2.0], [5.0]]).double()).tolist() == [
        [1],
        [2],
    ]
    torch.testing.assert_close(
        linalg.solve_spd(matrix, torch.tensor([[8.0], [9.0]], dtype=DOUBLE)),
        torch.tensor([[1.375], [1.25]], dtype=DOUBLE),
    )
    expected = torch.tensor([[5.0, -2.0], [-2.0, 4.0]], dtype=DOUBLE) / 16
    torch.testing.assert_close(linalg.inverse_spd(matrix), expected)


@pytest.mark.parametrize("size", [1, 2, 7, 27])
def test_solves_equal_the_general_ones(size):
    matrix, right = spd(size), torch.randn(3, size, 2, dtype=DOUBLE)
    torch.testing.assert_close(matrix @ linalg.solve_spd(matrix, right), right, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(
        matrix @ linalg.inverse_spd(matrix), torch.eye(size).double().expand(3, -1, -1), rtol=0, atol=1e-7
    )
    factor = linalg.cholesky(matrix)
    torch.testing.assert_close(factor @ factor.mT, matrix, rtol=1e-12, atol=0)
    torch.testing.assert_close(factor @ linalg.solve_lower(factor, right), right, rtol=1e-9, atol=1e-9)


def test_a_matrix_that_is_not_positive_leaves_other_rows_alone():
    matrix = spd(3)
    matrix[1] = -matrix[1]
    alone = linalg.inverse_spd(matrix[[0, 2]])
    torch.testing.assert_close(linalg.inverse_spd(matrix)[[0, 2]], alone)


def test_gradcheck():
    root = torch.randn(2, 3, 3, dtype=DOUBLE).requires_grad_()
    right = torch.randn(2, 3, 1, dtype=DOUBLE).requires_grad_()
    eye = torch.eye(3, dtype=DOUBLE)
    assert torch.autograd.gradcheck(lambda r, b: linalg.solve_spd(r @ r.mT + eye, b), (root, right))
    assert torch.autograd.gradcheck(lambda r: linalg.inverse_spd(r @ r.mT + eye), (root,))


def test_reduced_information_is_that_of_the_other_parameters_by_least_squares():
    """Its inverse is their covariance in the fit of all parameters, and its solution their estimate."""
    generator = torch.Generator().manual_seed(5)
    design = torch.randn(2, 40, 5, generator=generator, dtype=DOUBLE)
    measured = torch.randn(2, 40, 1, generator=generator, dtype=DOUBLE)
    matrix, vector = design.mT @ design, (design.mT @ measured).squeeze(-1)
    precision = torch.tensor([0.0, 3.0, 1.0], dtype=DOUBLE)
    with_prior = matrix + torch.nn.functional.pad(precision, (0, 2)).diag()
    found = linalg.reduced_information(matrix, vector, precision)
    own = torch.linalg.inv(with_prior)[:, 3:, 3:]
    torch.testing.assert_close(torch.linalg.inv(found[..., :2]), own)
    all_of_them = torch.linalg.solve(with_prior, vector)
    torch.testing.assert_close(torch.linalg.solve(found[..., :2], found[..., 2]), all_of_them[:, 3:])


def test_matrices_times_vectors():
    matrix, vector = torch.arange(12, dtype=DOUBLE).view(2, 2, 3), torch.tensor([[1, 0, 2], [0, 1, -1]])
    assert linalg.times_vector(matrix, vector.to(DOUBLE)).tolist() == [[4, 13], [-1, -1]]
