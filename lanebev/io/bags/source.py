"""Frames and lens of an MCAP file or a ROS bag."""

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lanebev.io.bags.images import TopicImages, is_video
from lanebev.io.bags.messages import IMAGE_TYPES, LENS_TYPES, VIDEO_TYPES, Bag, Topic, message_stamp, open_bag
from lanebev.io.frame_source import DEFAULT_FPS, FrameSource
from lanebev.io.frames import ALL, Frame
from lanebev.io.images.pixels import dark_remark
from lanebev.io.rising_clock import RisingClock
from lanebev.io.side_by_side import halves_remark
from lanebev.numbers import shown

_LOOKED_AT = 50  # frames for their rate, and messages for the lens
_LONGEST_GROUP = 600  # frames, which a video in a bag may begin before its first key frame
_LENS_FIELDS = ("width", "height", "distortion_model", "D", "K", "R", "P", "binning_x", "binning_y")
_REGION = ("x_offset", "y_offset", "height", "width")


@dataclass(frozen=True)
class BagSource(FrameSource):
    """Images of one topic of a bag.

    Attributes:
        topic: topic of the images.
        lens: fields of a ``camera_info`` beside them, None if there is none.
        lens_remark: a remark on it; else empty.
    """

    topic: str = ""
    lens: Mapping[str, Any] | None = field(default=None, compare=False)
    lens_remark: str = field(default="", compare=False)

    @cached_property  # once: the times are in all messages
    def taken_numbers(self) -> list[int]:
        """Numbers of the frames that are taken, by their times if not all are."""
        if self.selection == ALL:
            return list(range(self.count))
        times = self.frame_times()
        return [number for number, time in enumerate(times) if self.selection.takes(number, time)]

    def frame_times(self, clock: RisingClock[float] | None = None) -> Iterator[float]:
        """Yield the times of the frames, s since the first, up to where the bag cannot be read."""
        first, clock = None, clock or RisingClock(float(1 / self.fps))
        with contextlib.suppress(ValueError), open_bag(Path(self.source)) as bag:
            for logged, message in bag.messages(self.topic):
                time, _ = clock.time(message_stamp(message), 1e-9 * logged)
                first = time if first is None else first
                yield time - first

    def _video_frames(self) -> Iterator[Frame]:
        first = before = None
        images = TopicImages()
        number, interval = 0, float(1 / self.fps)
        clock = RisingClock(interval)
        try:
            with open_bag(Path(self.source)) as bag:
                for number, (logged, message) in enumerate(bag.messages(self.topic)):
                    time, problem = clock.time(message_stamp(message), 1e-9 * logged)
                    first = time if first is None else first
                    dt = interval if before is None else time - before
                    image, fault = None, ""
                    if self.selection.takes(number, time - first) or is_video(message):
                        image, fault = self._decoded(images, message)
                    problem = fault or problem
                    yield Frame(number, time - first, dt, "", image, problem)
                    before = time
        except ValueError as error:  # from here on the bag cannot be read
            if first is None or before is None:
                raise
            yield Frame(number + 1, before - first + interval, interval, "", None, str(error))


def open_bag_source(source: str, topic: str | None = None, fps: Fraction | None = None) -> BagSource:
    """Open a bag and check that an image of it decodes.

    Args:
        source: an MCAP file, a ROS bag, or the folder of a ROS 2 bag.
        topic: topic of the images; None for the only one with images.
        fps: nominal frame rate, None for that of the images' times.

    Raises:
        ValueError: the bag cannot be read, has no such topic or more than one, or its image does not decode.
    """
    with open_bag(Path(source)) as bag:
        chosen = _image_topic(source, bag.topics, topic)
        image = _first_image(bag, chosen.name)
        if image is None:
            raise ValueError(f"bag {source}: expected images on {chosen.name}, got none")
        lenses = _lenses(bag, chosen.name)
    rate, size = fps or DEFAULT_FPS, image.shape[:2]
    lens, doubt = (lenses[0] if lenses else None), _lenses_remark(lenses)
    found = BagSource(source, (), rate, chosen.size, size, topic=chosen.name, lens=lens, lens_remark=doubt)
    clock = RisingClock(float(1 / found.fps))
    steps = [after - before for before, after in pairwise(islice(found.frame_times(clock), _LOOKED_AT))]
    rate = fps or (Fraction(1 / median(steps)).limit_denominator(1000) if steps else rate)
    said = "; ".join(filter(None, (_unstamped_remark(clock), dark_remark(image), halves_remark(image))))
    return replace(found, fps=rate, problem=f"bag {source}: {said}" if said else "")


def _unstamped_remark(clock: RisingClock[float]) -> str:
    """Return a remark on images without stamps; else nothing. Times from zero on have one stamp of zero."""
    words = f"{clock.unstamped} of its first images have no stamps; they follow as recorded"
    return words if clock.unstamped > 1 else ""


def _first_image(bag: Bag, topic: str) -> NDArray[np.uint8] | None:
    """Return a topic's first image, of a video the first one from a key frame on; None without images."""
    images = TopicImages()
    for number, (_, message) in enumerate(bag.messages(topic)):
        try:
            return images(message)
        except ValueError:
            if not is_video(message) or number > _LONGEST_GROUP:
                raise
    return None


def lens_fields(message: Any) -> dict[str, Any]:
    """Return a message of a lens as the fields of a ROS ``camera_info``.

    Raises:
        ValueError: K is zero, which says that the camera is not calibrated.
    """
    fields: dict[str, Any] = {}
    for name in _LENS_FIELDS:
        value = getattr(message, name, None)
        value = getattr(message, name.lower(), None) if value is None else value
        if value is not None:
            fields[name] = value if isinstance(value, str) else np.asarray(value).tolist()
    if not any(fields.get("K") or ()):
        raise ValueError("K is zero: the camera was not calibrated")
    region = getattr(message, "roi", None)
    if region is not None:
        fields["roi"] = {name: int(getattr(region, name)) for name in _REGION}
    return fields


def _lenses_remark(lenses: Sequence[Mapping[str, Any]]) -> str:
    """Return a remark if the messages of a lens differ, as those of a focus that moves; else nothing."""
    other = next((each for each in lenses if each != lenses[0]), None)
    if other is None:
        return ""
    return (
        f"CameraInfo changes, {_first_difference(lenses[0], other)}; the first is taken for all images: "
        "fix focus and resolution, or give --camera FILE"
    )


def _first_difference(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return the first field of two lenses that differs, of a list its first such number, and both values."""
    name = next(each for each in {**before, **after} if before.get(each) != after.get(each))
    old, new = before.get(name), after.get(name)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        place = next(i for i, (a, b) in enumerate(zip(old, new, strict=True)) if a != b)
        name, old, new = f"{name}[{place}]", old[place], new[place]
    return f"{name} from {shown(old)} to {shown(new)}"


def _lenses(bag: Bag, images: str) -> list[dict[str, Any]]:
    """Return the first lenses of the topic nearest to the images, or of a bag's only camera.

    Messages of a camera that is not calibrated are left out: drivers send them until they are set up.

    Of several as near, such as ``camera_info`` and ``camera_info_raw``, it is that with the most words of the
    images' topic and the fewest others.
    """
    cameras = sum(each.kind in IMAGE_TYPES and each.size > 0 for each in bag.topics)
    topics = [each.name for each in bag.topics if each.kind in LENS_TYPES and each.size]
    folders = {name: name.rpartition("/")[0] + "/" for name in topics}
    beside = [name for name in topics if images.startswith(folders[name])]
    words = {name: set(re.split("[/_]", name)) for name in (*beside, images)}

    def fit(name: str) -> tuple[int, int, int]:
        return len(folders[name]), len(words[name] & words[images]), -len(words[name] - words[images])

    nearest = sorted(beside, key=fit)[-1:]
    found = []
    for name in nearest or (topics if len(topics) == cameras == 1 else []):
        for _, message in islice(bag.messages(name), _LOOKED_AT):
            with contextlib.suppress(ValueError):
                found.append(lens_fields(message))
    return found


def _image_topic(source: str, topics: Sequence[Topic], wanted: str | None) -> Topic:
    found = {each.name: each for each in topics if each.kind in IMAGE_TYPES and each.size}
    names = ", ".join(sorted(found)) or "none"
    if wanted is not None and wanted not in found:
        raise ValueError(f"bag {source}: expected images on {wanted}, got them on: {names}")
    if wanted is None and len(found) != 1:
        videos = ", ".join(each.name for each in topics if each.kind in VIDEO_TYPES and each.size)
        packets = f"; make a video file of {videos}, whose packets are not read" if videos else ""
        remedy = "; choose one with --topic" if found else packets
        raise ValueError(f"bag {source}: expected one topic of images, got: {names}{remedy}")
    return next(iter(found.values())) if wanted is None else found[wanted]
