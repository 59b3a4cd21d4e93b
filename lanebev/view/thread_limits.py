"""Sizes of operations that one thread computes: divided, short operations take longer than undivided ones."""

import numpy as np
from numpy.typing import NDArray

ONE_THREAD = 1 << 15  # numbers up to which PyTorch computes with one thread
_PRODUCT = 1 << 18  # multiplications up to which NumPy's BLAS does


def small_products(
    left: NDArray[np.float32], right: NDArray[np.float32], out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Multiply (rows, n) with (..., n, V), in products so small that NumPy computes each with one thread.

    Threads that start for each product would take longer than the product, and wait for those of PyTorch.

    Args:
        left: matrix.
        right: matrices.
        out: (..., rows, V) to write to.
    """
    if out is None:
        out = np.empty((*right.shape[:-2], len(left), right.shape[-1]), np.float32)
    step = max(1, _PRODUCT // max(1, right.shape[-2] * right.shape[-1]))
    for first in range(0, len(left), step):
        rows = slice(first, first + step)
        np.matmul(left[rows], right, out=out[..., rows, :])
    return out
