"""Run the network on a part of a drive, for the later run on the whole drive."""

from collections.abc import Sequence
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import cast

import numpy as np

from lanebev.app.config import RunConfig
from lanebev.app.continued.recovery import RecoveredObserver
from lanebev.app.drive.build import make_observer, match_image_size
from lanebev.app.drive.observers import NetworkObserver, Observer
from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.app.drive.sources import camera_of, make_source, observed_frames
from lanebev.io.frames import Frame
from lanebev.io.lanes.tusimple import tusimple_line, whole_tusimple_lines
from lanebev.io.output.whole_file import whole_file

_NO_ROWS, _NO_LANES = np.zeros(0), np.zeros((0, 0))


def observe_part(config: RunConfig, path: Path, network: SharedNetwork | None = None) -> int:
    """Write the vertices of each frame that the settings take, with its number in the whole source.

    Args:
        config: the settings; those of the estimation have no effect.
        path: output file, with the vertices in full precision.
        network: a network that is already loaded.

    Returns:
        the number of frames.
    """
    source = make_source(config, may_take_none=True)
    camera = camera_of(config, source)
    source = match_image_size(camera, source)
    frames = observed_frames(source, make_observer(config, source, camera, network))
    count = 0
    with whole_file(path) as whole, closing(frames), open(whole, "w", encoding="utf-8") as file:
        for frame, seen in frames:
            file.write(tusimple_line(number_in_source(frame), _NO_ROWS, _NO_LANES, *seen) + "\n")
            count += 1
    return count


def number_in_source(frame: Frame) -> str:
    """Return the number of a frame in the whole source, as a name."""
    return f"{frame.number if frame.source_number is None else frame.source_number:06d}"


def observer_of_parts(paths: Sequence[Path], observer: Observer) -> Observer:
    """Return an observer that reads the files of :func:`observe_part` for the parts of a source.

    Args:
        paths: paths of the files, in the order of the parts.
        observer: observer of frames that are in none of them.
    """
    entries = chain.from_iterable(map(whole_tusimple_lines, paths))
    return RecoveredObserver(entries, cast(NetworkObserver, observer), number_in_source, is_reported=False)
