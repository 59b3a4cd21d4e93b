"""Lane files of other detectors and data sets, and which frame each entry belongs to.

Everything here is in pixels of the image as taken. A cut or malformed file is a ``ValueError`` of one line
that names file and line.
"""

import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.io.images.names import IMAGE_SUFFIXES, in_natural_order
from lanebev.io.lanes.annotators import ANNOTATORS, read_annotations, read_cvat, via
from lanebev.io.lanes.bdd100k import read_bdd100k
from lanebev.io.lanes.culane import read_culane
from lanebev.io.lanes.curvelanes import read_curvelanes
from lanebev.io.lanes.lanes3d import read_apollo, read_once
from lanebev.io.lanes.llamas import read_llamas
from lanebev.io.lanes.openlane import read_openlane
from lanebev.io.lanes.parsing import FORMATS, FrameLines, json_values, lane_text
from lanebev.io.lanes.tusimple import read_tusimple
from lanebev.numbers import shown

_READERS: dict[str, Callable[[Path], list[FrameLines]]] = {  # by a key that no other kind before it has
    **{key: partial(read_annotations, pictures=pictures) for key, pictures in ANNOTATORS.items()},
    "Lines": lambda path: [read_curvelanes(path)],
    "image_name": lambda path: [read_llamas(path)],
    "labels": read_bdd100k,
    "frames": read_bdd100k,
}
_OF_TUSIMPLE = {"lanes", "h_samples", "raw_file"}
_BEGIN = 1_000  # characters
_FIRST = 100  # objects whose keys decide the format
_MOST_ENDINGS = 5  # in a message
_OF_LLAMAS = re.compile(r"_(color|gray)_rect$")  # ends the names of LLAMAS' images, not of its labels


def read_lanes(path: str | Path, intrinsics: NDArray[np.float64] | None = None) -> list[FrameLines]:
    """Read a lane file, whose format is recognised by its keys, or a folder of such files.

    Args:
        path: path of the file or folder.
        intrinsics: (3, 3) px of the camera, for 3D points in a file without them.

    Raises:
        ValueError: there is no such file, or it is cut, malformed or of no known format.
    """
    path = Path(path)
    if path.is_dir():
        frames = [frame for file in lane_files(path) for frame in read_lanes(file, intrinsics)]
        if not frames:
            endings = sorted({file.suffix for file in path.rglob("*") if file.is_file()})[:_MOST_ENDINGS]
            raise ValueError(
                f"lane folder {path}: expected .lines.txt or .json files, got {' '.join(endings) or 'none'}; "
                "give an .xml file by its name, and lines instead of masks"
            )
        return frames
    text = lane_text(path)
    if path.name.endswith(".txt") and not text.lstrip("[ \r\n").startswith("{"):
        return [read_culane(path)]
    if "<annotations>" in text[:_BEGIN]:
        return read_cvat(path)
    if '"shape_attributes"' in text:
        return read_annotations(path, via)
    return _read_json(path, _first_keys(path, text), intrinsics)


def _read_json(path: Path, keys: set[str], intrinsics: NDArray[np.float64] | None) -> list[FrameLines]:
    """Read a JSON file by the keys of its first object; one without keys is no JSON, as its reader says."""
    if {"lanes", "raw_file"} <= keys:  # whatever else a detector adds
        return read_tusimple(path)
    if "lane_lines" in keys:
        return [read_openlane(path, intrinsics)]
    if "laneLines" in keys:
        return read_apollo(path, intrinsics)
    if "calibration" in keys or keys == {"lanes"}:
        return [read_once(path, intrinsics)]
    read = next((read for key, read in _READERS.items() if key in keys), read_tusimple)
    if read is read_tusimple and keys and _OF_TUSIMPLE.isdisjoint(keys):
        got = ", ".join(sorted(key for key in keys if key.rpartition(".")[0] not in keys))
        raise ValueError(f"lane file {path}: expected keys of a known format, got {shown(got)}; {FORMATS}")
    return read(path)


def lane_files(path: str | Path) -> list[Path]:
    """Return the files that :func:`read_lanes` reads: the file itself, or a folder's in natural order."""
    path = Path(path)
    if not path.is_dir():
        return [path]
    found = [*path.rglob("*.lines.txt"), *path.rglob("*.json")]
    seen = (file for file in found if not any(part[0] == "." for part in file.relative_to(path).parts))
    return [Path(file) for file in in_natural_order(map(str, seen))]  # macOS leaves ._ files


class _Match(NamedTuple):
    """The entry of an image, and how many parts of the paths they have in common."""

    entry: int
    length: int


def match_frames(names: Sequence[str], frames: Sequence[FrameLines]) -> list[int | None]:
    """Find the lane entry of each image: the one whose path has the longest common end with its path.

    An entry with exactly the image's name is its own. Else whole path components are compared from the end,
    the last without an image's suffix. An entry goes to the image that shares most with it, so an image
    without an entry of its own gets None rather than another image's.

    Args:
        names: paths of the images.
        frames: entries of the lane file.

    Returns:
        for each image an index into ``frames``, or None.

    Raises:
        ValueError: no image matches, or two entries (or two images) match equally well.
    """
    result: list[int | None] = [None] * len(names)
    images_of: dict[int, dict[int, int]] = defaultdict(dict)  # by entry: the lengths by image
    for image, match in enumerate(_best_entries(names, frames)):
        if match is not None:
            images_of[match.entry][image] = match.length
    for entry, lengths in images_of.items():
        best = [image for image, length in lengths.items() if length == max(lengths.values())]
        if len(best) > 1:
            raise ValueError(
                f"lane entry {frames[entry].name!r}: expected one image, got {names[best[0]]} and "
                f"{names[best[1]]}, which fit equally well; give entries a longer path"
            )
        result[best[0]] = entry
    if names and all(entry is None for entry in result):
        raise ValueError(
            f"lanes: expected an entry for at least one image, got none that ends like {names[0]}; "
            + (f"the file's first is {frames[0].name!r}" if frames else "the file has none")
        )
    return result


def _best_entries(names: Sequence[str], frames: Sequence[FrameLines]) -> list[_Match | None]:
    """Return for each image the entry that shares the longest end of the path with it."""
    by_tail: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for entry, frame in enumerate(frames):
        parts = _parts(frame.name)
        for start in range(len(parts)):
            by_tail[parts[start:]].append(entry)
    exact = {frame.name: entry for entry, frame in enumerate(frames)}
    exact = exact if len(exact) == len(frames) else {}  # names are not unique
    matches: list[_Match | None] = []
    for name in names:
        parts = _parts(name)
        if name in exact:
            matches.append(_Match(exact[name], len(parts) + 1))
            continue
        tail = next((parts[k:] for k in range(len(parts)) if parts[k:] in by_tail), None)
        matches.append(None if tail is None else _Match(by_tail[tail][0], len(tail)))
        if tail is not None and len(by_tail[tail]) > 1:
            first, second = (frames[entry].name for entry in by_tail[tail][:2])
            raise ValueError(
                f"image {name}: expected one lane entry, got {first!r} and {second!r}, which fit equally "
                "well; give images by a path that tells them apart"
            )
    return matches


def _parts(name: str) -> tuple[str, ...]:
    path = PurePath(unicodedata.normalize("NFC", name).replace("\\", "/"))  # macOS takes letters apart
    if path.suffix.lower() in IMAGE_SUFFIXES:  # what follows the last dot may be part of the name
        path = path.with_suffix("")
    parts = [part for part in path.parts if part not in ("/", ".")]
    return (*parts[:-1], *(_OF_LLAMAS.sub("", part) for part in parts[-1:]))


def _first_keys(path: Path, text: str) -> set[str]:
    """Return the keys of a JSON text's first objects, those of objects in them as a.b; none of another text.

    An image without lanes may lack a key. Of a first object that breaks off they are the words of its line.
    """
    objects: list[dict[str, Any]] = []
    try:
        found = islice((value for _, value in json_values(path, text)), _FIRST)
        objects.extend(value for value in found if isinstance(value, dict))
    except ValueError:
        if not objects:
            return set(re.findall(r'"(\w+)"', text.lstrip().split("\n", 1)[0]))
    pairs = [pair for each in objects for pair in each.items()]
    below = (f"{key}.{each}" for key, value in pairs if isinstance(value, dict) for each in value)
    return {*(key for key, _ in pairs), *below}
