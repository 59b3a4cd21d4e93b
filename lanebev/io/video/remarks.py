"""Remarks on a whole video: its streams, the layout of its frames, its times, and a video appended to it."""

import struct
import sys
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import accumulate, groupby, pairwise
from mmap import ACCESS_READ, mmap
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from lanebev.io.rising_clock import REORDERED
from lanebev.io.side_by_side import halves_remark
from lanebev.io.video.decoding import moving_pictures

LONGEST_STEP = 60  # s between two frames of a drive
_MOST_MISSING = 0.2  # of the frames; with more of them, times are those of a camera that varies
_HEAD = 8  # first bytes, by which the kind of a file is recognised
_HEAD_AGAIN = ("mpegts", "mxf", "mpjpeg")  # formats in which these bytes come again in one file
_SPHERICAL = range(4)  # AVSphericalProjection: equirectangular, cube maps, half of one
_OF_TWO_CAMERAS = range(1, 8)  # AVStereo3DType: side by side, one above the other, in turn, ...


def stream_remarks(
    container: av.container.InputContainer, frame: av.VideoFrame, image: NDArray[np.uint8]
) -> list[str]:
    """Return remarks on a video by its streams and its first frame.

    Args:
        container: the video.
        frame: its first whole frame.
        image: the frame as shown, (H, W, 3).
    """
    remarks, size = [], image.shape[:2]
    if others := len(moving_pictures(container)) - 1:
        remarks.append(f"it has {others} more video streams; that of {size[1]} x {size[0]} px is used")
    if frame.interlaced_frame:
        remarks.append(
            "its frames are interlaced, each of two moments; deinterlace it, as by ffmpeg -vf bwdif"
        )
    # the first field of the side data's C structures is the kind
    kinds = {data.type.name: int.from_bytes(bytes(data)[:4], sys.byteorder) for data in frame.side_data}
    if kinds.get("SPHERICAL") in _SPHERICAL:
        remarks.append("its header says 360 degrees; cut out a pinhole view, as by ffmpeg -vf v360")
    if kinds.get("STEREO3D") in _OF_TWO_CAMERAS:
        remarks.append("its header says that frames have the images of two cameras; crop them to one")
    return [*remarks, halves_remark(image)]


def appended_remark(container: av.container.InputContainer, end: int) -> str:
    """Return a remark if another file of the same kind follows what is read of a video; else nothing.

    Args:
        container: the video.
        end: place in the file after its last packet.
    """
    path, kind = Path(container.name), container.format.name
    if kind in _HEAD_AGAIN or not (_has_appended(path) if "mp4" in kind else _begins_again(path, end)):
        return ""
    return "another video is appended to it, of which nothing is read; join them by ffmpeg -f concat"


def restart_remark(keys: Sequence[tuple[int, float]], early: int) -> str:
    """Return a remark on times that fall or begin again in the file; else nothing.

    Equal times of frames one after another are no such case: very fast videos round them to the same tick.

    Args:
        keys: time of each key frame, and the latest one of all frames before it in the file, both in ticks.
        early: most frames one after another in the file that are all earlier than one before them.
    """
    begins_again = any(time <= before and time < latest for (before, _), (time, latest) in pairwise(keys))
    if not begins_again and early <= REORDERED:
        return ""
    return "its times begin again, as of files joined byte by byte; is it one drive?"


def gap_remark(times: Sequence[int], tick: Fraction) -> str:
    """Return a remark on times (ticks) of frames between which a minute or more is missing; else nothing."""
    longest = max((after - before for before, after in pairwise(sorted(times))), default=0) * tick
    return f"its times jump by {float(longest):.0f} s; is it one drive?" if longest > LONGEST_STEP else ""


def missing_remark(kind: str, times: Sequence[int]) -> str:
    """Return how many frames a transport stream lost, by evenly spaced times with gaps; else nothing.

    Args:
        kind: format of the container; others drop frames that the camera was too slow for.
        times: ticks, of its frames in the order of their packets. Of a recording that was cut off, the last
            B-frames may not have come; their places are no gaps.
    """
    early = [time < latest for time, latest in zip(times, accumulate(times, max), strict=True)]
    reordered = max((len(list(run)) for is_early, run in groupby(early) if is_early), default=0)
    steps = np.diff(sorted(times))
    if kind != "mpegts" or not len(steps) or (usual := float(np.median(steps))) <= 0:
        return ""
    missing = int(np.maximum(np.rint(steps[: len(steps) - reordered] / usual) - 1, 0).sum())
    if not 0 < missing <= _MOST_MISSING * len(times):
        return ""
    return (
        f"its times leave out {missing} frame{'s'[: missing != 1]}; if they were lost, images after such a "
        "gap may be damaged up to the next key frame"
    )


def _begins_again(path: Path, end: int) -> bool:
    """Return whether the first bytes of a file come again after a place."""
    if not end < path.stat().st_size:
        return False
    with open(path, "rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        return data.find(data[:_HEAD], end) >= 0


def _has_appended(path: Path) -> bool:
    """Return whether another MP4 file was appended to one; players show nothing of it."""
    kinds = list(_boxes(path))
    return kinds.count(b"moov") > 1 and b"moof" not in kinds


def _boxes(path: Path) -> Iterator[bytes]:
    """Yield the kinds of an MP4 file's boxes.

    Source: ISO/IEC 14496-12, 4.2. A size of 0 is up to the end of the file; of 1, 8 bytes have it.
    """
    place, end = 0, path.stat().st_size
    with open(path, "rb") as file:
        while place + 16 <= end:
            file.seek(place)
            size, kind, long = struct.unpack(">I4sQ", file.read(16))
            yield kind
            place += max(long if size == 1 else size or end, 8)
