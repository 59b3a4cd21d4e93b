"""Small pictures of some frames of a drive, of limited total size."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import cv2

from lanebev.report.lettering import Picture

MOST_BYTES = 4_300_000  # size of all pictures together; 5.7 MB in base64
_EVERY = 1  # frames between two pictures at first
_QUALITY = 72  # of JPEG
_LONGEST = 800  # px, side of a picture

Jpegs = Mapping[str, bytes]


@dataclass
class PictureSampler:
    """Keeps pictures of evenly spaced frames, and of the frame with the highest score of each kind.

    When all together are larger than allowed, every second of the evenly spaced ones is dropped, so that the
    whole drive stays covered.

    Attributes:
        most_bytes: largest size in bytes of all pictures together.
        every: frames between two evenly spaced ones now.
    """

    most_bytes: int = MOST_BYTES
    every: int = _EVERY
    _kept: dict[int, Jpegs] = field(default_factory=dict)
    _best: dict[str, tuple[float, int]] = field(default_factory=dict)

    def add(self, number: int, pictures: Mapping[str, Picture], scores: Mapping[str, float]) -> None:
        """Encode and keep a frame's pictures, by name, if its scores or its number select it."""
        for kind, score in scores.items():
            if kind not in self._best or score > self._best[kind][0]:
                self._best[kind] = (score, number)
        if number in self._wanted([number]):
            self._kept[number] = {name: jpeg(picture) for name, picture in pictures.items()}
            self._thin()

    @property
    def pictures(self) -> dict[int, Jpegs]:
        """The kept pictures by number of the frame, in order."""
        return {number: self._kept[number] for number in sorted(self._kept)}

    def _wanted(self, numbers: Iterable[int]) -> set[int]:
        best = {number for _, number in self._best.values()}
        return {number for number in numbers if number % self.every == 0 or number in best}

    def _thin(self) -> None:
        self._kept = {number: self._kept[number] for number in self._wanted(self._kept)}
        while self._size() > self.most_bytes and any(
            number % self.every == 0 for number in self._kept if number
        ):
            self.every *= 2
            self._kept = {number: self._kept[number] for number in self._wanted(self._kept)}

    def _size(self) -> int:
        return sum(len(data) for pictures in self._kept.values() for data in pictures.values())


def jpeg(picture: Picture) -> bytes:
    """Return a picture as JPEG, scaled down to 800 px if it is larger."""
    scale = min(1.0, _LONGEST / max(picture.shape[:2]))
    if scale < 1.0:
        size = [max(1, round(side * scale)) for side in picture.shape[1::-1]]
        method = cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR  # which is several times as fast
        picture = cv2.resize(picture, size, interpolation=method)
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes()
