"""Frames of another view than the ones before: mirrored or turned images, cuts, and two cameras in turn."""

from collections import Counter, deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_STRIDE = 8  # px, of the pixels that are compared
_MOVING = 1.0  # grey levels of 255 on average, of a change that counts
_MORE_ALIKE, _LARGER = 0.6, 1.5  # fraction of the change of the unturned image; multiple of nearby changes
_NEAR = 2  # frames before and after a cut
_CUT, _LEAST_CUT = 2.5, 12.0  # times the changes near by, and grey levels on average
_SAME_VIEW = 0.75  # least correlation of two images of one view, also when the exposure changes
_LONGER = 1.5  # times the time step before, of frames between which others are missing
_IN_TURN = 0.8  # cameras take turns if frames change less from the last but one, relative to the last
_MOST = 0.8  # ... in so large a fraction of the frames
_FEWEST = 10  # frames
_REVERSED, _KEPT = slice(None, None, -1), slice(None)
_TURNED = {
    "mirrored": (_KEPT, _REVERSED),
    "upside down": (_REVERSED, _KEPT),
    "turned by 180 degrees": (_REVERSED, _REVERSED),
}


class _Change(NamedTuple):
    """Mean differences of a frame from those before it, grey levels, without the difference of brightness.

    Attributes:
        number: number of the frame.
        is_next: whether no time is missing between the two.
        size: change from the frame before.
        turned: how it is turned against the frame before, in words; empty if it is not.
        is_same_view: whether it correlates with the frame before, or changes too little for a cut.
    """

    number: int
    is_next: bool
    size: float
    turned: str
    is_same_view: bool


class ViewChanges:
    """Notices frames of another view in the frames of a drive, which change little from one to the next."""

    def __init__(self) -> None:
        self._before: deque[NDArray[np.float32]] = deque(maxlen=2)
        self._changes: deque[_Change] = deque(maxlen=2 * _NEAR + 1)
        self._counts: Counter[str] = Counter()  # by kind of change
        self._first: dict[str, int] = {}
        self._compared = self._in_turn = 0
        self._dt = np.inf

    def add(self, number: int, image: NDArray[np.uint8] | None, dt: float) -> None:
        """Take the next frame.

        Args:
            number: its number.
            image: (H, W, 3); None if it was lost.
            dt: s since the frame before.
        """
        is_next, self._dt = dt < _LONGER * self._dt, dt
        if image is None:
            self._dt = 0.0  # frames are missing before the next one
            return
        seen = image[::_STRIDE, ::_STRIDE].astype(np.float32)
        if self._before:
            size = _difference(seen, self._before[-1])
            if len(self._before) == 2 and size > _MOVING:
                self._compared += 1
                self._in_turn += _difference(seen, self._before[0]) < _IN_TURN * size
            turned = _turned(seen, self._before[-1], size)
            is_same_view = size <= _LEAST_CUT or _correlation(seen, self._before[-1]) > _SAME_VIEW
            self._changes.append(_Change(number, is_next, size, turned, is_same_view))
            self._classify()
        self._before.append(seen)

    def _classify(self) -> None:
        """Classify the middle one of the last changes, and count it if it is a cut or a turn."""
        if len(self._changes) <= 2 * _NEAR:
            return
        change = self._changes[_NEAR]
        others = max(each.size for each in self._changes if each is not change)
        is_cut = change.is_next and change.size > _CUT * others and not change.is_same_view
        kind = change.turned if change.size > _LARGER * others else ""
        kind = kind or ("cut" if is_cut else "")
        if kind:
            self._counts[kind] += 1
            self._first.setdefault(kind, change.number)

    def remark(self) -> str:
        """Return a remark on the drive; empty if its view stays."""
        if self._compared >= _FEWEST and self._in_turn > _MOST * self._compared:
            return (
                "images differ more from the one before than from the last but one: are they of two cameras "
                "in turn? give the images of one"
            )
        said = []
        for kind, first in sorted(self._first.items(), key=lambda each: each[1]):
            such = f", the first of {self._counts[kind]} such," if self._counts[kind] > 1 else ""
            words = f"is {kind} against the one before; give each part a run"
            if kind == "cut":
                words = (
                    "shows another view than the one before: are drives or cameras joined? give each a run"
                )
            said.append(f"frame {first}{such} {words}")
        return "; ".join(said)


def _difference(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Return the mean absolute difference of two images, grey levels, without that of their brightness."""
    if a.shape != b.shape:
        return 0.0
    difference = a - b
    return float(np.abs(difference - difference.mean()).mean())


def _correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Return the correlation of two images' grey levels, 1 where one of them is uniform.

    A change of brightness and contrast leaves it as it is.
    """
    if a.shape != b.shape:
        return 1.0
    greys = [image.mean(-1) for image in (a, b)]
    first, second = (grey - grey.mean() for grey in greys)
    scale = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float((first * second).sum()) / scale if scale > 0 else 1.0


def _turned(image: NDArray[np.float32], before: NDArray[np.float32], size: float) -> str:
    """Return how an image is turned against the one before, in words; empty if it is not.

    Args:
        image: (H, W, 3).
        before: likewise.
        size: their difference.
    """
    if size < _MOVING:
        return ""
    turned = {words: _difference(image[view], before) for words, view in _TURNED.items()}
    words = min(turned, key=lambda each: turned[each])
    return words if turned[words] < _MORE_ALIKE * size else ""
