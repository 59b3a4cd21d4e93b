"""Sources of a run's boundary vertices: a lane file, or the network."""

import re
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.camera.model import Camera
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.tracker import Tracker
from lanebev.estimation.two_stage.state import TwoStageState
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import Frame
from lanebev.io.images.names import in_natural_order
from lanebev.io.lanes import match_frames
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.remarks import (
    check_boundary_order,
    left_out_remark,
    other_camera_remark,
    repeats_remark,
    two_scales_remark,
    unequal_lanes_remark,
)
from lanebev.io.lanes.size import size_remark
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.frames import check_frame, network_image
from lanebev.observation.polylines import VERTICES_PER_LINE, distorted_line, vertices_from_lines
from lanebev.pipeline import LaneBEV
from lanebev.tensors import map_tensors

RunTracker = Tracker[JointState] | Tracker[TwoStageState]

_MOST_WORKERS = 4  # each holds a frame's feature maps in memory
_HIGHEST = 4  # largest height of an image over its width; with a larger one the network would need many GB
_WORKERS_SHARED = 2  # one frame of a drive is in the batch under way, another waits for the next


class Observation(NamedTuple):
    """Lane boundaries found in one frame.

    Attributes:
        vertices: vertices of batch size 1.
        pose_sigma_scale: factor on the standard deviations of the pose estimated from them.
    """

    vertices: BoundaryVertices
    pose_sigma_scale: float = 1.0


class Observer(Protocol):
    """Finds the lane boundaries in a frame; none in a frame that did not decode.

    Attributes:
        remark: what should be said of all frames together, else empty.
        workers: calls at a time that make the best use of the machine; 0 if each call needs the estimate of
            the frame before.
    """

    remark: str
    workers: int

    def __call__(self, frame: Frame) -> Observation:
        """Return the vertices in pixels of the image as taken."""
        ...


class LaneFileObserver:
    """Another detector's lanes, matched to the frames of a source.

    Args:
        entries: entries of the lane file.
        source: the frames; images are matched by the longest common tail of their path, a video by order: an
            entry for each frame of it, or for each that is taken.
        camera: the lens.
        stills: images are independent, not frames of a drive.

    Raises:
        ValueError: the entries do not fit the source.
    """

    workers = 1

    def __init__(
        self, entries: Sequence[FrameLines], source: FrameSource, camera: Camera, stills: bool = False
    ) -> None:
        self.entries = [_as_taken(entry, camera) for entry in entries]
        self.camera = camera
        self.remark = size_remark(entries, camera.image_size) or two_scales_remark(entries)
        if not any(entry.lines for entry in entries):
            self.remark = "lanes: none of the entries has a line"
        check_boundary_order(entries)
        self._of_taken = source.is_video and len(entries) == source.taken_count
        if source.is_video:
            if len(entries) != source.count and not self._of_taken:
                remedy = (
                    "is the lane file cut? write an entry without lanes for frames that were not looked at"
                )
                if len(entries) > source.count:
                    remedy = (
                        "were frames extracted at a fixed rate, as by ffmpeg? give the folder of those images"
                    )
                raise ValueError(
                    f"lanes: expected {source.count} entries, one per frame of {source.source}, got "
                    f"{len(entries)}; {remedy}"
                )
            _check_order([entry.name for entry in entries], source.source)
            self.matches: list[int | None] = list(range(len(entries)))
        else:
            self.matches = match_frames(source.paths, entries)
        in_order = [self.entries[match] for match in self.matches if match is not None]
        unmatched = "" if source.is_video else self._unmatched(source.taken_numbers)
        of_drive = [] if stills else [repeats_remark(in_order), unequal_lanes_remark(in_order, camera)]
        of_camera = other_camera_remark(entries, camera)
        remarks = (self.remark, of_camera, unmatched, left_out_remark(in_order), *of_drive)
        self.remark = "; ".join(filter(None, remarks))

    def _unmatched(self, taken: Sequence[int]) -> str:
        """Return how many of the images that are taken have no entry; empty if all have one."""
        without = [number for number in taken if self.matches[number] is None]
        if not without:
            return ""
        unused = len(self.entries) - sum(match is not None for match in self.matches)
        words = (
            f"lanes: {len(without)} of {len(taken)} images have no entry, the first is number {without[0]}"
        )
        return f"{words}; {unused} entries have no image" if unused else words

    def __call__(self, frame: Frame) -> Observation:
        """See :class:`Observer`."""
        number = frame.number
        if frame.source_number is not None and not self._of_taken:
            number = frame.source_number
        entry = self.matches[number] if number < len(self.matches) else None
        found = FrameLines(frame.name, []) if entry is None else self.entries[entry]
        lines = [] if frame.image is None else found.lines
        return Observation(vertices_from_lines(lines, self.camera), found.pose_sigma_scale)


def _as_taken(entry: FrameLines, camera: Camera) -> FrameLines:
    """Return an entry in pixels as taken: 3D points were projected without the lens's distortion."""
    if entry.principal_point is None:
        return entry
    return entry._replace(lines=[distorted_line(line, camera) for line in entry.lines])


def _check_order(names: Sequence[str], source: str) -> None:
    """Raise if the names of a video's entries differ by numbers only, and these do not rise.

    Names that were sorted as texts are such: 1, 10, 2.
    """
    alike = len({re.sub(r"\d+", "", name) for name in names}) == 1
    wrong = [name for name, expected in zip(names, in_natural_order(names), strict=True) if name != expected]
    if alike and wrong:
        raise ValueError(
            f"lanes: expected entries in the order of the frames of {source}, got {wrong[0]!r} out of order"
        )


class NetworkObserver:
    """Finds lanes in the images by LaneBEV's network and line extraction.

    Args:
        network: segmenter and extractor, of one drive or shared with others in batches.
        camera: the lens.

    Raises:
        ValueError: images that are much higher than wide, as of no camera.
    """

    remark = ""

    def __init__(self, network: LaneBEV | SharedNetwork, camera: Camera) -> None:
        height, width = camera.image_size
        if height > _HIGHEST * width:
            raise ValueError(
                f"source: expected images at most {_HIGHEST} times as high as wide, got {width} x {height} "
                "px; are they of a road?"
            )
        self._shared = network if isinstance(network, SharedNetwork) else None
        self.model = network.model if isinstance(network, SharedNetwork) else network.eval()
        self.camera = camera
        self.device = next(self.model.parameters(), torch.zeros(0)).device  # an ONNX file has no parameters
        self.workers = min(torch.get_num_threads(), _MOST_WORKERS) if self.device.type == "cpu" else 1
        if self._shared is not None and self._shared.most > 1:
            self.workers = _WORKERS_SHARED

    def __call__(self, frame: Frame) -> Observation:
        """See :class:`Observer`."""
        if frame.image is None:
            return Observation(vertices_from_lines([], self.camera), self.model.pose_sigma_scale)
        image = network_image(check_frame(frame.image, self.camera.image_size), self.device)
        with torch.inference_mode():
            vertices = self._vertices(image)
        return Observation(map_tensors(Tensor.cpu, vertices), self.model.pose_sigma_scale)

    def _vertices(self, image: Tensor) -> BoundaryVertices:
        """Return the vertices in an image (1, 3, H, W)."""
        return (
            self.model.boundary_vertices(image)[1] if self._shared is None else self._shared.vertices(image)
        )

    def restored(self, found: FrameLines) -> Observation:
        """Return what the network saw by lanes.json, in its own layout: sums are the same to the bit."""
        vertices = vertices_from_lines(found.lines, self.camera)
        cut = [part[:, :, : self._columns()].float() for part in vertices[:3]]
        return Observation(BoundaryVertices._make([*cut, vertices.boundary]), found.pose_sigma_scale)

    def _columns(self) -> int:
        """Return the number of vertices on a boundary, padding included."""
        return 2 * self.model.extractor.config.segments


class FarViewObserver(NetworkObserver):
    """Finds lanes in the whole images and in far views, which are about the horizon that a tracker expects.

    Args:
        network: segmenter and extractor, of one drive or shared with others in batches, but those of stills.
        tracker: the tracker that is given what this observer sees, frame by frame.
        stills: every image is on its own: the horizon is that of a first estimate from the whole image.
    """

    def __init__(
        self, network: LaneBEV | SharedNetwork, tracker: RunTracker, camera: Camera, stills: bool
    ) -> None:
        super().__init__(network, camera)
        self.tracker, self.stills = tracker, stills
        self.workers = self.workers if stills else 0

    def _vertices(self, image: Tensor) -> BoundaryVertices:
        if self.stills:
            _, whole = self.model.whole_vertices(image)
            point = self.tracker.vanishing_point_of_still(map_tensors(Tensor.cpu, whole))
            return self.model.add_far_view(image, whole, point)
        point = self.tracker.vanishing_point()
        if self._shared is not None:
            return self._shared.vertices(image, point)
        return self.model.boundary_vertices(image, point)[1]

    def _columns(self) -> int:
        return VERTICES_PER_LINE
