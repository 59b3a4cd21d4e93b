"""Numbers from files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


def finite_numbers(name: str, values: Sequence[Any], count: int | None = None) -> list[float]:
    """Texts or numbers to floats, ``count`` of them if given.

    Raises:
        ValueError: another count, or one that is not a finite number; a truth value is none.
    """
    if count is not None and len(values) != count:
        raise ValueError(f"{name}: expected {count} number{'s'[: count != 1]}, got {len(values)}")
    try:
        numbers = [float(value) for value in values if not isinstance(value, bool)]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != len(values) or not all(map(math.isfinite, numbers)):
        shown = ", ".join(str(value) for value in values)[:60]
        raise ValueError(f"{name}: expected finite numbers, got {shown}")
    return numbers
