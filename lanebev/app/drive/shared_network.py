"""One network for several drives: frames that wait at the same time form one batch."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from operator import itemgetter
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.pipeline import LaneBEV
from lanebev.tensors import map_tensors


class _Request(NamedTuple):
    """A waiting image (1, 3, H, W), its vanishing point or None, and where its vertices go."""

    image: Tensor
    point: Tensor | None
    answer: Future[BoundaryVertices]

    def is_like(self, other: _Request) -> bool:
        """Return whether both may be in one batch."""
        return self.image.shape == other.image.shape and (self.point is None) == (other.point is None)


class SharedNetwork:
    """Runs the network on frames of several drives, each in its own thread.

    The first thread that finds the network free runs it on all waiting frames of one size, as one batch. No
    thread waits for frames that have not come, so a drive that ends or fails delays no other.

    Args:
        model: model with the segmenter and extractor to use.
        most: frames in a batch.

    Attributes:
        batches: how many there were.
        frames: how many frames in all.
    """

    def __init__(self, model: LaneBEV, most: int = 1) -> None:
        if most < 1:
            raise ValueError(f"batch: expected 1 frame or more, got {most}")
        self.model, self.most = model.eval(), most
        self.batches = self.frames = 0
        self._waiting: list[_Request] = []
        self._changing, self._looking = threading.Lock(), threading.Lock()

    def vertices(self, image: Tensor, vanishing_point: Tensor | None = None) -> BoundaryVertices:
        """Return the vertices of an image, of batch size 1, on its device.

        Args:
            image: (1, 3, H, W) in [0, 1].
            vanishing_point: (1, 2) px of a far view, see :meth:`lanebev.LaneBEV.boundary_vertices`.
        """
        own = _Request(image, vanishing_point, Future())
        with self._changing:
            self._waiting.append(own)
        with self._looking:
            if not own.answer.done():
                self._run(self._take_batch(own))
        return own.answer.result()

    def _take_batch(self, own: _Request) -> list[_Request]:
        """Remove this frame, and as many others like it as a batch holds, from the list."""
        with self._changing:
            alike = [each for each in self._waiting if each is not own and each.is_like(own)]
            taken = [own, *alike[: self.most - 1]]
            self._waiting = [each for each in self._waiting if all(each is not one for one in taken)]
        return taken

    @torch.inference_mode()
    def _run(self, requests: list[_Request]) -> None:
        """Run the network on frames in one batch; if that fails, on each alone: only bad ones fail."""
        try:
            points = [each.point for each in requests if each.point is not None]
            images = torch.cat([each.image for each in requests])
            _, found = self.model.boundary_vertices(images, *([torch.cat(points)] if points else []))
        except Exception as error:
            if len(requests) == 1:
                requests[0].answer.set_exception(error)
                return
            for each in requests:
                self._run([each])
            return
        self.batches, self.frames = self.batches + 1, self.frames + len(requests)
        for row, each in enumerate(requests):
            each.answer.set_result(map_tensors(itemgetter(slice(row, row + 1)), found))
