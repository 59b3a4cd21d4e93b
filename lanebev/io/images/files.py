"""Images in folders and of globs, and what is beside them."""

import glob
import os
from collections.abc import Iterable
from pathlib import Path

from lanebev.io.images.names import IMAGE_SUFFIXES
from lanebev.io.images.pixels import is_image

HEIC = (".heic", ".heif")  # ffmpeg takes the tiles of such an image for videos

_LEFT_OUT = (
    *HEIC, ".avif", ".jxl", ".dng", ".cr2", ".nef", ".arw", ".tga", ".gif",
    ".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".ts", ".mts",
)  # fmt: skip
_OWN_VIDEOS = ("bev.mp4", "overlay.mp4")  # an earlier run may have written them beside its images


def images_of(source: str) -> list[str]:
    """Return the images in a folder, or that match a glob; none of other sources."""
    path = Path(source)
    if path.is_dir():
        return [str(p) for p in path.iterdir() if is_image(p) and p.name[0] != "."]  # macOS leaves ._ files
    if path.is_file() or not glob.has_magic(source):
        return []
    return list(filter(is_image, _each_once(glob.glob(glob_pattern(source), recursive=True))))


def _each_once(paths: Iterable[str]) -> list[str]:
    """Return each file once, by its shortest path: links of folders lead to it by others."""
    folders: dict[str, str] = {}
    found: dict[tuple[str, str], str] = {}
    for path in sorted(paths, key=len):
        folder, name = os.path.split(path)
        if folder not in folders:
            folders[folder] = os.path.realpath(folder)
        found.setdefault((folders[folder], name), path)
    return list(found.values())


def glob_pattern(source: str) -> str:
    """Return a source as a glob, with brackets in the names of existing folders taken literally."""
    folder = next((str(each) for each in Path(source).parents if each.is_dir()), ".")
    rest = source.removeprefix(folder)
    return glob.escape(folder) + rest if rest != source and glob.has_magic(rest) else source


def folder_remedy(folder: Path) -> str:
    """Return a hint on the source to give instead of a folder without images."""
    below = f"for images in folders below it give a quoted glob such as '{folder}/**/*.jpg'"
    return "; ".join(filter(None, [endings_remedy(folder.iterdir()), below]))


def endings_remedy(paths: Iterable[Path]) -> str:
    """Return a hint on the source to give instead of files that are no images; empty if there are none."""
    endings = sorted({each.suffix for each in paths if each.is_file() and each.name[0] != "."})
    known = " ".join(IMAGE_SUFFIXES)
    ends = f"end with {' '.join(filter(None, endings[:5]))}" if any(endings) else "have no endings"
    found = f"its files {ends}, images with {known}; give a video itself"
    return found if endings else ""


def left_out_remark(folder: Path) -> str:
    """Return a remark on images and videos in a folder that are not among the images read; else nothing."""
    names = (name for name in os.listdir(folder) if name[0] != "." and name not in _OWN_VIDEOS)
    found = sorted(name for name in names if name.lower().endswith(_LEFT_OUT))
    if not found:
        return ""
    return (
        f"{len(found)} pictures or videos beside the images are left out, such as {found[0]}; convert "
        "pictures to JPEG or PNG, or give a video itself"
    )
