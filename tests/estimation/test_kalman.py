"""The filter against the paper's gain form, a NumPy filter and its own invariants."""

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from lanebev.estimation import kalman


def information_form(mean, cov, innovation, jacobian, measurement_noise):
    """The update as the package does it."""
    return kalman.update(mean, cov, *kalman.information(innovation, jacobian, measurement_noise))


def problem(rows):
    """A random update with four states, scaled like pitch, yaw and their rates."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(4, 4, generator=generator, dtype=torch.float64) * 0.03
    jacobian = torch.randn(rows, 4, generator=generator, dtype=torch.float64) * 0.2
    jacobian[:, 2:] = 0
    noise = torch.rand(rows, generator=generator, dtype=torch.float64) * 1e-6 + 1e-7
    innovation = torch.randn(rows, generator=generator, dtype=torch.float64) * 1e-3
    cov = root @ root.T + 1e-4 * torch.eye(4, dtype=torch.float64)
    return torch.zeros(4, dtype=torch.float64), cov, innovation, jacobian, noise


@pytest.mark.parametrize("rows", [1, 30, 408])
def test_information_form_equals_the_papers_gain_form(rows):
    inputs = problem(rows)
    for ours, paper in zip(information_form(*inputs), kalman.update_gain_form(*inputs), strict=True):
        assert (ours - paper).abs().max() < 1e-9


class LargestTensor(TorchDispatchMode):
    """Largest number of elements that an operation returned."""

    elements = 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        result = operation(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor):
            self.elements = max(self.elements, result.numel())
        return result


def test_information_form_makes_no_matrix_of_rows_by_rows():
    # That is why it is faster.
    largest = {}
    for form in (kalman.update_gain_form, information_form):
        with LargestTensor() as made:
            form(*problem(408))
        largest[form] = made.elements
    assert largest[kalman.update_gain_form] == 408 * 408
    assert largest[information_form] == 408 * 4


def test_one_step_equals_ten_lines_of_numpy():
    rng = np.random.default_rng(0)
    x, root = rng.normal(size=4), rng.normal(size=(4, 4))
    p, f, w = root @ root.T, np.eye(4) + 0.1 * np.eye(4, k=2), 0.01 * np.eye(4)
    h, q, z = rng.normal(size=(3, 4)), np.array([0.1, 0.2, 0.3]), rng.normal(size=3)
    x1, p1 = f @ x, f @ p @ f.T + w
    g = p1 @ h.T @ np.linalg.inv(h @ p1 @ h.T + np.diag(q))
    x2, p2 = x1 + g @ (z - h @ x1), (np.eye(4) - g @ h) @ p1
    mean, cov = kalman.predict(*map(torch.as_tensor, (x, p, f, w)))
    info = kalman.information(torch.as_tensor(z) - torch.as_tensor(h) @ mean, *map(torch.as_tensor, (h, q)))
    mean, cov = kalman.update(mean, cov, *info)
    np.testing.assert_allclose(mean, x2, atol=1e-12)
    np.testing.assert_allclose(cov, p2, atol=1e-12)


def test_zero_weight_is_not_there_whatever_it_holds():
    mean, cov, innovation, jacobian, noise = problem(6)
    weight = torch.tensor([1.0, 1, 1, 1, 0, 0], dtype=torch.float64)
    innovation[4], jacobian[5], noise[4] = torch.nan, torch.inf, 0.0
    padded = kalman.update(mean, cov, *kalman.information(innovation, jacobian, noise, weight))
    alone = kalman.update(mean, cov, *kalman.information(innovation[:4], jacobian[:4], noise[:4]))
    for a, b in zip(padded, alone, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    nothing = kalman.update(mean, cov, *kalman.information(innovation, jacobian, noise, weight * 0))
    torch.testing.assert_close(nothing[1], cov)
    assert torch.equal(nothing[0], mean)


def test_padded_rows_carry_no_gradient():
    mean, cov, innovation, jacobian, noise = problem(3)
    innovation[2] = torch.nan
    jacobian.requires_grad_()
    weight = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    x, p = kalman.update(mean, cov, *kalman.information(innovation, jacobian, noise, weight))
    (x.sum() + p.sum()).backward()
    assert jacobian.grad.isfinite().all()
    assert (jacobian.grad[2] == 0).all()


def test_gradcheck_of_predict_and_update():
    mean, cov, innovation, jacobian, noise = problem(5)
    cov = cov * 100
    noise = noise * 1e6
    args = [a.detach().clone().requires_grad_() for a in (mean, cov, innovation, jacobian, noise)]

    def step(m, p, y, h, q):
        m, p = kalman.predict(m, 0.5 * (p + p.T), torch.eye(4).double() * 1.1, torch.eye(4).double() * 0.01)
        return kalman.update(m, p, *kalman.information(y, h, q))

    assert torch.autograd.gradcheck(step, args)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_thousand_steps_keep_the_covariance_symmetric_and_positive(dtype):
    generator = torch.Generator().manual_seed(0)
    mean, cov = torch.zeros(3, 4, dtype=dtype), torch.eye(4, dtype=dtype).repeat(3, 1, 1)
    f, w = kalman.constant_velocity(
        torch.full((3,), 1 / 30, dtype=dtype), torch.tensor([0.25, 0.25], dtype=dtype)
    )
    for _ in range(1000):
        mean, cov = kalman.predict(mean, cov, f, w)
        jacobian = torch.randn(3, 50, 4, generator=generator, dtype=dtype)
        jacobian[..., 2:] = 0
        noise = torch.full((3, 50), 1e-8, dtype=dtype)
        innovation = torch.randn(3, 50, generator=generator, dtype=dtype) * 1e-4
        mean, cov = kalman.update(mean, cov, *kalman.information(innovation, jacobian, noise))
    assert torch.equal(cov, cov.mT)
    assert torch.linalg.eigvalsh(cov.double()).min() > 0


def test_constant_velocity_agrees_over_any_spacing():
    density = torch.tensor([0.3, 2.0], dtype=torch.float64)
    half, whole = (
        kalman.constant_velocity(torch.tensor([dt], dtype=torch.float64), density) for dt in (0.05, 0.1)
    )
    mean, cov = torch.ones(1, 4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[None]
    twice = kalman.predict(*kalman.predict(mean, cov, *half), *half)
    once = kalman.predict(mean, cov, *whole)
    for a, b in zip(twice, once, strict=True):
        torch.testing.assert_close(a, b)
    assert once[0].tolist() == [[1.1, 1.1, 1.0, 1.0]]


def test_gate_is_in_standard_deviations():
    cov = torch.eye(1, dtype=torch.float64) * 9.0
    jacobian, noise = torch.ones(2, 1, dtype=torch.float64), torch.full((2,), 16.0, dtype=torch.float64)
    innovation = torch.tensor([14.9, -15.1], dtype=torch.float64)  # sigma is 5
    assert kalman.gate(innovation, jacobian, noise, cov, 3.0).tolist() == [True, False]


def test_variances_are_limited_and_correlations_kept():
    cov = torch.tensor([[4.0, 1.0], [1.0, 9.0]], dtype=torch.float64)
    limited = kalman.limit_variance(cov, torch.tensor([16.0, 1.0], dtype=torch.float64))
    expected = torch.tensor([[4.0, 1.0 / 3], [1.0 / 3, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(limited, expected)
