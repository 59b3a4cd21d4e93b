"""Doubts about polylines that are given frame by frame."""

import logging

from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.io.lanes.contrast import LaneContrast
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.remarks import boundary_numbers, left_out_words, repeats_remark, unequal_lanes_remark
from lanebev.io.lanes.size import size_doubt
from lanebev.observation.frames import image_bytes

_LOOKED_AT = 20  # frames that are judged together
_REMEDY = "give pixels of the camera's images, or a camera by Camera.scaled or Camera.cropped"

logger = logging.getLogger(__name__)


class LaneDoubts:
    """Notices polylines of other images, of unequal lanes, with a number left out, or given again.

    It is logged once, as long as it lasts.

    Attributes:
        doubt: the doubt about the last frames that were judged, or about the contrast in one of each
            _LOOKED_AT since the beginning, since those of a second look alike; empty if there is none.
    """

    def __init__(self, camera: Camera) -> None:
        self.doubt = ""
        self._camera = camera
        self._drawn: list[FrameLines] = []
        self._contrast, self._judged = LaneContrast(), 0
        self._numbers: set[int] = set()

    def add(self, lines: FrameLines, image: Tensor | None = None) -> None:
        """Take the polylines of one frame (3, H, W), and judge all since the last time if they are enough."""
        if not lines.lines:
            return
        if not self._drawn and image is not None:
            self._contrast.add(self._judged, image_bytes(image), (line.points for line in lines.lines))
        self._drawn.append(lines)
        if len(self._drawn) < _LOOKED_AT:
            return
        found = size_doubt(self._drawn, self._camera.image_size)
        of_images = found.words if found else self._contrast.remark()
        words = f"polylines: {of_images} {_REMEDY}" if of_images else ""
        self._numbers |= boundary_numbers(self._drawn)
        words = (
            words
            or unequal_lanes_remark(self._drawn, self._camera)
            or left_out_words(self._numbers)
            or repeats_remark(self._drawn)
        )
        if words and not self.doubt:
            logger.warning(words)
        self.doubt, self._drawn = words, []
        self._judged += 1
