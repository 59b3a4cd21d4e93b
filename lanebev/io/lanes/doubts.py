"""Doubts about polylines that are given frame by frame."""

import logging

from lanebev.camera.model import Camera
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.remarks import unequal_lanes_remark
from lanebev.io.lanes.size import size_doubt

_LOOKED_AT = 20  # frames that are judged together
_REMEDY = "give pixels of the camera's images, or a camera by Camera.scaled or Camera.cropped"

logger = logging.getLogger(__name__)


class LaneDoubts:
    """Notices polylines in pixels of other images, or of unequal lanes; logs it once, as long as it lasts.

    Attributes:
        doubt: the doubt about the last frames that were judged, in words; empty if there is none.
    """

    def __init__(self, camera: Camera) -> None:
        self.doubt = ""
        self._camera = camera
        self._drawn: list[FrameLines] = []

    def add(self, lines: FrameLines) -> None:
        """Take the polylines of one frame, and judge all since the last time if they are enough."""
        self._drawn += [lines] if lines.lines else []
        if len(self._drawn) < _LOOKED_AT:
            return
        found = size_doubt(self._drawn, self._camera.image_size)
        words = f"polylines: {found.words} {_REMEDY}" if found else ""
        words = words or unequal_lanes_remark(self._drawn, self._camera)
        if words and not self.doubt:
            logger.warning(words)
        self.doubt, self._drawn = words, []
