"""Notice that the files of a source changed during a run."""

from pathlib import Path

from lanebev.app.continued.recovery import size_and_time
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import ALL
from lanebev.io.images.files import images_of

Files = dict[str, tuple[int, int]]
"""Size and time of change of files, by path."""


def files_of(source: FrameSource) -> Files:
    """Return the files that are there now of a source; none of a stream."""
    if source.is_live:
        return {}
    path = Path(source.source)
    if path.is_dir() and source.is_video:  # a bag, in which the output folder may be
        paths = [str(each) for each in path.iterdir() if each.name[0] != "." and each.is_file()]
    else:
        paths = images_of(source.source) or [source.source]
    found = {each: size_and_time(Path(each)) for each in paths}
    return {each: facts for each, facts in found.items() if any(facts)}  # others are not there


def changes_remark(source: FrameSource, before: Files) -> str:
    """Return how many files of a source came, went or changed since ``before``; nothing if none did."""
    now = files_of(source)
    counts = {
        "new": len(now.keys() - before.keys()),
        "deleted": len(before.keys() - now.keys()),
        "written again": sum(before[path] != now[path] for path in before.keys() & now.keys()),
    }
    words = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    if not words:
        return ""
    return f"{source.source}: files changed during the run: {words}; run again when it is complete"


def count_remark(source: FrameSource, got: int) -> str:
    """Return a remark if another number of frames came than a video's packets say; else nothing.

    Which frames of a video with unknown times are taken is an estimate, and nothing is said of it.
    """
    unknown = source.is_video and source.has_times and not source.times and source.selection != ALL
    expected = got if source.is_live or unknown else source.taken_count
    if got == min(expected, source.most or expected):
        return ""
    return f"{source.source}: expected {expected} frames by its packets, got {got}; is it damaged?"
