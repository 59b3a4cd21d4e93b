"""Progress of a long job."""

from collections.abc import Iterator
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Wraps the items of a job and shows how many are done."""

    def __call__(self, items: Iterator[Item], total: int) -> Iterator[Item]:
        """Yield the items unchanged and show how many are done."""
        ...


def no_progress(items: Iterator[Item], total: int) -> Iterator[Item]:
    """Return the items, and show nothing."""
    return items
