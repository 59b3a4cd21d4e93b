"""Operators that ONNX Runtime lacks, one file with all of them: against PyTorch, in double precision."""

import onnxruntime
import pytest
import torch
from torch import nn
from torch.export import Dim

from lanebev.export.operators import translations

DOUBLE = torch.float64
RIGHT = torch.randn(4, 6, 2, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)


def _spd(*shape):
    root = torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    return root @ root.mT + 0.1 * torch.eye(shape[-1], dtype=DOUBLE)


class Operators(nn.Module):
    names = (
        "atan", "atan in single precision", "atan2", "tan", "softplus", "cholesky", "solve_lower",
        "cholesky_solve", "cholesky_inverse",
        "cholesky of four dimensions",
        "where"
    )  # fmt: skip

    def forward(self, x, y, small, matrix, right):
        lower = torch.linalg.cholesky_ex(matrix).L
        return (
            x.atan(),
            x.float().atan(),
            torch.atan2(x, y),
            small.tan(),
            nn.functional.softplus(100 * small),
            lower,
            torch.linalg.solve_triangular(lower, right, upper=False),
            torch.cholesky_solve(right, lower),
            torch.cholesky_inverse(lower),
            torch.linalg.cholesky_ex(matrix.unsqueeze(1)).L,
            torch.where(x > 0, y > 1, y < -1),
        )


@pytest.fixture(scope="module")
def arguments():
    wide = torch.logspace(-12, 12, 50, dtype=DOUBLE)
    x = torch.cat([wide, -wide, torch.tensor([0.0, torch.inf, -torch.inf], dtype=DOUBLE)])
    small = torch.linspace(-1.5, 1.5, 61, dtype=DOUBLE)
    return x, x.roll(20), small, _spd(4, 6, 6), RIGHT


@pytest.fixture(scope="module")
def session(arguments, tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "operators.onnx"
    rows, batch = {0: Dim("rows")}, {0: Dim("batch", min=1)}
    with torch.no_grad():
        torch.onnx.export(
            Operators().eval(), arguments, path, dynamo=True, verbose=False,
            dynamic_shapes=(rows, rows, {0: Dim("angles")}, batch, batch),
            custom_translation_table=translations(),
        )  # fmt: skip
    return onnxruntime.InferenceSession(path)


def _run(session, arguments):
    feeds = {each.name: arg.numpy() for each, arg in zip(session.get_inputs(), arguments, strict=True)}
    found = map(torch.from_numpy, session.run(None, feeds))
    return dict(zip(Operators.names, found, strict=True))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", Operators.names)
def test_equals_pytorch(session, arguments, name):
    found = _run(session, arguments)[name]
    expected = dict(zip(Operators.names, Operators()(*arguments), strict=True))[name]
    assert found.dtype == expected.dtype
    if found.dtype == torch.bool:
        assert torch.equal(found, expected)
        return
    single = expected.dtype == torch.float32
    absolute = {"softplus": 1e-15}.get(name, 1e-12 if expected.ndim > 1 else 1e-300)
    torch.testing.assert_close(found, expected, rtol=3e-7 if single else 1e-13, atol=absolute)


class Numbers(torch.nn.Module):
    """Operators that take a number which single precision cannot hold."""

    def forward(self, x):
        return (
            torch.full((2,), 0.1, dtype=x.dtype),
            torch.full_like(x, 0.1),
            x.new_full((2,), 0.1),
            torch.full((2,), 7),
            torch.full((2,), True),
            torch.where(x > 0, x, 0.1),
            x.masked_fill(x > 0, 0.1),
            x.clamp(-0.1, 0.1),
            torch.where(x > 0.1, 1.0, torch.inf) + x,
            torch.linspace(0, 1, 11, dtype=x.dtype),
            torch.linspace(-0.3, 0.3, 7, dtype=x.dtype),
        )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_numbers_are_not_rounded(tmp_path, dtype):
    x = torch.tensor([-0.7, 0.1, 0.3], dtype=dtype)
    program = torch.export.export(Numbers(), (x,), dynamic_shapes=({0: Dim("rows")},))
    path = tmp_path / "numbers.onnx"
    torch.onnx.export(
        program, dynamo=True, verbose=False, optimize=False, custom_translation_table=translations()
    ).save(path)
    session = onnxruntime.InferenceSession(path)
    found = session.run(None, {session.get_inputs()[0].name: x.numpy()})
    for one, other in zip(found, Numbers()(x), strict=True):
        torch.testing.assert_close(torch.from_numpy(one), other, rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_matrix_that_is_not_positive_leaves_other_rows_alone(session, arguments):
    spoilt = arguments[3].clone()
    spoilt[1] = -spoilt[1]
    found = _run(session, (*arguments[:3], spoilt, arguments[4]))
    expected = _run(session, arguments)
    for name in Operators.names[5:-1]:
        assert torch.equal(found[name][[0, 2, 3]], expected[name][[0, 2, 3]])
        assert not found[name][1].isfinite().all()
