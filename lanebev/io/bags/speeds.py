"""Speeds of the vehicle from a topic of a bag."""

from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from lanebev.io.bags.messages import SPEED_TYPES, message_stamp, open_bag
from lanebev.io.speeds import Speeds


def bag_speeds(path: Path, images: str, topic: str) -> Speeds:
    """Return the speeds on a topic, with their times from the first image on.

    Args:
        path: the bag.
        images: topic of the images.
        topic: topic of the speeds.

    Raises:
        ValueError: the bag cannot be read, or has no speeds on this topic.
    """
    with open_bag(path) as bag:
        found = {each.name: each.kind for each in bag.topics if each.kind in SPEED_TYPES and each.size}
        if topic not in found:
            names = ", ".join(sorted(found)) or "none"
            raise ValueError(f"bag {path}: expected speeds on {topic}, got them on: {names}")
        speed = attrgetter(SPEED_TYPES[found[topic]])
        first = next(bag.messages(images))
        rows = sorted((_seconds_after(first, each), float(speed(each[1]))) for each in bag.messages(topic))
    times, speeds = np.array(rows).T
    return Speeds(speeds, times)


def _seconds_after(first: tuple[int, Any], later: tuple[int, Any]) -> float:
    """Return the time between two messages, s, by their own times or else by those of their recording."""
    start, end = message_stamp(first[1]), message_stamp(later[1])
    return 1e-9 * (later[0] - first[0]) if start is None or end is None else end - start
