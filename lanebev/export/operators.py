# mypy: ignore-errors
"""Operators of PyTorch in ONNX that its exporter or ONNX Runtime lacks.

ONNX Runtime has Atan, Tan and Softplus in single precision only and no Where of truth values; ONNX has no
Cholesky factor and no solve with triangular matrices. They are written here in operators that both have.
PyTorch's exporter rounds numbers, such as those of ``full``, ``clamp`` and ``where``, to single precision;
here they keep theirs.
``torch.onnx.export`` takes :func:`translations` as its ``custom_translation_table``.
"""

from collections.abc import Callable
from typing import Any

import torch
from onnxscript import DOUBLE, ir, script
from onnxscript import opset18 as op
from onnxscript.values import Opset

_OWN = Opset("lanebev", 1)
_HUGE = 1e300  # stands for infinity where that would make inf / inf


@script(_OWN, default_opset=op)
def Cholesky(matrix: DOUBLE) -> DOUBLE:  # noqa: N802 - an operator's name
    """Compute the lower Cholesky factor of (..., D, D), a column at a time (Golub and Van Loan 2013)."""
    count = op.Squeeze(op.Shape(matrix, start=-1))
    places = op.Range(0, count, 1)
    zero = op.CastLike(0.0, matrix)
    rest = op.Identity(matrix)
    factor = op.Expand(zero, op.Shape(matrix))
    for j in range(count):
        whole = op.Gather(rest, op.Unsqueeze(j, [0]), axis=-1)  # (..., D, 1)
        pivot = op.Gather(whole, op.Unsqueeze(j, [0]), axis=-2)  # (..., 1, 1)
        below = op.Unsqueeze(places >= j, [-1])
        column = op.Where(below, whole / op.Sqrt(pivot), zero)
        across = op.Gather(rest, op.Unsqueeze(j, [0]), axis=-2)  # (..., 1, D)
        row = op.Where(places >= j, across / op.Sqrt(pivot), zero)
        rest = rest - column * row
        factor = op.Where(places == j, column, factor)
    return factor


@script(_OWN, default_opset=op)
def SolveLower(lower: DOUBLE, right: DOUBLE) -> DOUBLE:  # noqa: N802
    """Solve L X = B for lower triangular L (..., D, D) and B (..., D, K), a row at a time."""
    count = op.Squeeze(op.Shape(lower, start=-1))
    places = op.Unsqueeze(op.Range(0, count, 1), [-1])
    rest = op.Identity(right)
    for i in range(count):
        column = op.Gather(lower, op.Unsqueeze(i, [0]), axis=-1)  # (..., D, 1)
        pivot = op.Gather(column, op.Unsqueeze(i, [0]), axis=-2)  # (..., 1, 1)
        solved = op.Gather(rest, op.Unsqueeze(i, [0]), axis=-2) / pivot  # (..., 1, K)
        rest = op.Where(places > i, rest - column * solved, op.Where(places == i, solved, rest))
    return rest


@script(_OWN, default_opset=op)
def SolveLowerTransposed(lower: DOUBLE, right: DOUBLE) -> DOUBLE:  # noqa: N802
    """Solve Lᵀ X = B for lower triangular L (..., D, D) and B (..., D, K), from the last row up."""
    count = op.Squeeze(op.Shape(lower, start=-1))
    places = op.Unsqueeze(op.Range(0, count, 1), [-1])
    rest = op.Identity(right)
    for n in range(count):
        i = count - 1 - n
        row = op.Gather(lower, op.Unsqueeze(i, [0]), axis=-2)  # (..., 1, D)
        pivot = op.Gather(row, op.Unsqueeze(i, [0]), axis=-1)  # (..., 1, 1)
        # the column of Lᵀ is the row of L
        solved = op.Gather(rest, op.Unsqueeze(i, [0]), axis=-2) / pivot  # (..., 1, K)
        length = op.Concat(op.Shape(row, end=-2), op.Shape(row, start=-1), [1], axis=0)
        column = op.Reshape(row, length)  # (..., D, 1)
        rest = op.Where(places < i, rest - column * solved, op.Where(places == i, solved, rest))
    return rest


def translations() -> dict[Callable[..., Any], Callable[..., Any]]:
    """Return the functions that stand for operators of PyTorch, for ``custom_translation_table``."""
    aten = torch.ops.aten
    return {
        aten.atan.default: arctangent,
        aten.atan2.default: arctangent_of_quotient,
        aten.tan.default: tangent,
        aten.softplus.default: softplus,
        aten.where.self: where,
        aten.full.default: full,
        aten.full_like.default: full_like,
        aten.new_full.default: new_full,
        aten.scalar_tensor.default: scalar_tensor,
        aten.masked_fill.Scalar: masked_fill,
        aten.linspace.default: linspace,
        aten.linalg_cholesky_ex.default: cholesky_ex,
        aten.linalg_solve_triangular.default: solve_triangular,
        aten.cholesky_solve.default: cholesky_solve,
        aten.cholesky_inverse.default: cholesky_inverse,
    }


def arctangent(x: Any) -> Any:
    """Compute atan(x): in double precision from y, the single-precision value.

    atan(x) - y = atan((x cos y - sin y) / (cos y + x sin y)), where the argument is below 1e-6 and its own
    arctangent.
    """
    if x.dtype != ir.DataType.DOUBLE:
        return op.Atan(x)
    finite = op.Where(op.IsInf(x), op.Sign(x) * _double(_HUGE), x)
    y = op.Cast(op.Atan(op.Cast(finite, to=ir.DataType.FLOAT)), to=ir.DataType.DOUBLE)
    sine, cosine = op.Sin(y), op.Cos(y)
    return y + (finite * cosine - sine) / (cosine + finite * sine)


def arctangent_of_quotient(y: Any, x: Any) -> Any:
    """Compute atan2(y, x) in (-pi, pi], 0 at the origin."""
    zero, turn = op.CastLike(0.0, x), op.CastLike(_double(torch.pi), x)
    angle = arctangent(_typed(y / x, x))
    behind = op.Where(op.GreaterOrEqual(y, zero), angle + turn, angle - turn)
    angle = op.Where(op.Less(x, zero), behind, angle)
    return op.Where(op.IsNaN(angle), zero, angle)


def tangent(x: Any) -> Any:
    """Compute tan(x)."""
    return op.Sin(x) / op.Cos(x)


def softplus(x: Any, beta: float = 1.0, threshold: float = 20.0) -> Any:
    """Compute log(1 + exp(beta x)) / beta, without overflow."""
    scaled = x * op.CastLike(_double(beta), x)
    zero, one = op.CastLike(0.0, x), op.CastLike(1.0, x)
    soft = (op.Max(scaled, zero) + op.Log(one + op.Exp(-op.Abs(scaled)))) / op.CastLike(_double(beta), x)
    return op.Where(op.Greater(scaled, op.CastLike(threshold, x)), x, soft)


def where(condition: Any, yes: Any, no: Any) -> Any:
    """Choose element by element; ONNX Runtime chooses numbers only, no truth values."""
    if yes.dtype == ir.DataType.BOOL:
        return op.Or(op.And(condition, yes), op.And(op.Not(condition), no))
    return op.Where(condition, yes, no)


def full(size: Any, fill_value: Any, dtype: int = -1, **_: Any) -> Any:
    """Return a tensor of one number, in the precision of ``dtype``."""
    return op.Expand(_number(fill_value, dtype), op.Cast(size, to=ir.DataType.INT64))


def full_like(like: Any, fill_value: Any, dtype: int = -1, **_: Any) -> Any:
    """Return a tensor of one number, as large as another one, in its precision or that of ``dtype``."""
    return op.Expand(_number(fill_value, like.dtype if dtype == -1 else dtype), op.Shape(like))


def new_full(like: Any, size: Any, fill_value: Any, dtype: int = -1, **_: Any) -> Any:
    """Return a tensor of one number, in the precision of another one or that of ``dtype``."""
    return full(size, fill_value, like.dtype if dtype == -1 else dtype)


def linspace(start: float, end: float, steps: int, dtype: int = -1, **_: Any) -> Any:
    """Return ``steps`` numbers from ``start`` to ``end``."""
    single = dtype in (-1, ir.DataType.FLOAT)
    numbers = torch.linspace(start, end, steps, dtype=torch.float32 if single else torch.float64)
    return op.Constant(value=ir.tensor(numbers.numpy()))


def masked_fill(values: Any, mask: Any, number: Any) -> Any:
    """Replace values by a number where a mask holds."""
    return op.Where(mask, _number(number, values.dtype), values)


def scalar_tensor(value: Any, dtype: int = -1, **_: Any) -> Any:
    """Return a number in the precision of ``dtype``."""
    return _number(value, dtype)


def cholesky_ex(matrix: Any, upper: bool = False, check_errors: bool = False) -> Any:
    """Compute the lower Cholesky factor; the second result, unused, says of no error."""
    assert not upper
    return Cholesky(matrix), op.Constant(value_int=0)


def solve_triangular(
    matrix: Any, right: Any, upper: bool, left: bool = True, unitriangular: bool = False
) -> Any:
    """Solve L X = B."""
    assert left
    assert not upper
    assert not unitriangular
    return SolveLower(matrix, right)


def cholesky_solve(right: Any, factor: Any, upper: bool = False) -> Any:
    """Solve L Lᵀ X = B."""
    assert not upper
    return SolveLowerTransposed(factor, SolveLower(factor, right))


def cholesky_inverse(factor: Any, upper: bool = False) -> Any:
    """Compute (L Lᵀ)⁻¹."""
    assert not upper
    count = op.Shape(factor, start=-1)
    eye = op.CastLike(op.EyeLike(op.ConstantOfShape(op.Concat(count, count, axis=0))), factor)
    return SolveLowerTransposed(factor, SolveLower(factor, op.Expand(eye, op.Shape(factor))))


def _double(value: float) -> Any:
    """Return a constant in double precision."""
    return op.Constant(value=ir.tensor(value, dtype=ir.DataType.DOUBLE))


def _number(value: Any, dtype: Any) -> Any:
    """Return a constant of a Python number, or a cast tensor; -1 is PyTorch's default for the number."""
    default = {bool: ir.DataType.BOOL, int: ir.DataType.INT64}.get(type(value), ir.DataType.FLOAT)
    kind = default if dtype == -1 else ir.DataType(dtype)
    if isinstance(value, bool | int | float):
        return op.Constant(value=ir.tensor(value, dtype=kind))
    return op.Cast(value, to=kind)


def _typed(value: Any, like: Any) -> Any:
    """Return a value with the type of another, unless it has one."""
    if value.dtype is None:
        value.dtype = like.dtype
    return value
