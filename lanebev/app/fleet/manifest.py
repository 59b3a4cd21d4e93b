"""The manifest: a list of drives and their settings, as YAML or CSV."""

import csv
import io
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path

import yaml

from lanebev.app.config import RunConfig
from lanebev.app.config.file import load_plain_yaml, parsed_settings
from lanebev.camera.choice import split_name
from lanebev.io.source_names import is_bag, is_live, without_login
from lanebev.numbers import read_text, shown

UNKNOWN_DAY = "unknown"
# settings that are paths
PATHS = ("source", "camera", "lanes", "weights", "mount", "speed", "resume", "exported")
_OWN = ("name", "camera_id", "day", "time")
_REFUSED = ("out", "source")
_OF_BAGS = ("topic", "speed_topic")
_MOST_NAME = 150  # characters, of which names of files and folders are made


Row = dict[str, object]
"""Settings of a drive by name, as the manifest has them."""


@dataclass(frozen=True)
class Drive:
    """A drive to run on.

    Attributes:
        name: unique name of the drive and of its folder.
        camera_id: identifier of the camera, shared by all its drives.
        day: date such as 2026-03-01, or UNKNOWN_DAY.
        time: when it began, as in ISO 8601; the day if no more is known; empty if nothing is.
        config: what to run, without the output folder.
    """

    name: str
    camera_id: str
    day: str
    time: str
    config: RunConfig


def read_manifest(path: str | Path, root: str | Path | None = None) -> list[Drive]:
    """Read a table of drives with their settings.

    Columns (or keys) are ``video``, ``camera``, and, where wanted, ``name``, ``camera_id``, ``day``, ``time``
    and any setting of ``lanebev run``. YAML is a list of mappings, or a mapping with ``drives``, the list,
    and ``defaults``, settings of all drives (``topic`` and ``speed_topic``: of the bags). Relative paths
    begin at the manifest's folder.

    Args:
        path: path of the file; .csv is CSV, anything else YAML.
        root: folder that no path may leave, links resolved; None is the manifest's folder.

    Raises:
        ValueError: the file cannot be read, a row is wrong, a path leaves the folder, or two drives have the
            same name.
    """
    path = Path(path)
    rows = _rows(path)
    if not rows:
        raise ValueError(f"manifest {path}: expected at least one drive, got none")
    base = Path(os.path.abspath(path)).parent
    inside = Path(os.path.realpath(base if root is None else root))
    drives = []
    for number, row in enumerate(rows, start=1):
        try:
            drives.append(_drive(row, base, inside))
        except ValueError as error:
            raise ValueError(f"manifest {path}, drive {number}: {error}") from error
    _check_names(path, drives)
    return drives


def path_inside(text: str, base: Path, inside: Path) -> str:
    """Return a path as an absolute one.

    Args:
        text: relative to ``base``, or absolute.
        base: folder of the manifest.
        inside: folder that it must not leave, links resolved.
    """
    whole = os.path.normpath(base / text)
    try:
        real = Path(os.path.realpath(whole))
    except (OSError, ValueError) as error:  # a NUL byte
        raise ValueError(f"expected a path, got {shown(text)}") from error
    if not real.is_relative_to(inside):
        raise ValueError(
            f"expected a path inside of {inside}, got {shown(text)}, which leaves it; move the file, or "
            "allow a wider folder with --root"
        )
    return whole


def _rows(path: Path) -> list[Row]:
    try:
        text = read_text(path)
        if path.suffix.lower() == ".csv":
            return _csv_rows(text)
        given = load_plain_yaml(text)
    except (ValueError, yaml.YAMLError, csv.Error) as error:
        reason = "not YAML" if isinstance(error, yaml.YAMLError) else error
        raise ValueError(f"manifest {path}: expected YAML or CSV, got: {reason}") from error
    defaults: Row = {}
    if isinstance(given, dict):
        if unknown := [key for key in given if key not in ("drives", "defaults")]:
            raise ValueError(f"manifest {path}: expected drives and defaults, got {shown(unknown[0])}")
        defaults, given = given.get("defaults") or {}, given.get("drives")
    drives: list[Row] = given if isinstance(given, list) else []
    if drives is not given or not all(isinstance(row, dict) for row in (*drives, defaults)):
        raise ValueError(f"manifest {path}: expected a list of drives, each with video and camera")
    return [_with_defaults(row, defaults, path.parent) for row in drives]


def _with_defaults(row: Row, defaults: Row, folder: Path) -> Row:
    """Return the settings of a drive with the defaults, of which some are for bags only."""
    is_of_bag = is_bag(str(folder / str(row.get("video"))))
    kept = {key: value for key, value in defaults.items() if is_of_bag or key not in _OF_BAGS}
    return {str(key): value for key, value in {**kept, **row}.items()}


def _csv_rows(text: str) -> list[Row]:
    rows: list[Row] = []
    flags = {each.name for each in fields(RunConfig) if isinstance(each.default, bool)}
    truth: dict[str, object] = {"true": True, "false": False}
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    titles, *table = [[cell.strip() for cell in line] for line in lines] or [[]]
    columns = Counter(titles)
    if len(columns) == 1 and (other := next((sign for sign in ";\t|" if sign in "".join(columns)), "")):
        raise ValueError(f"columns separated by {other!r}; write commas, and points in numbers")
    if twice := [name for name, count in columns.items() if name and count > 1]:  # spreadsheets add empty
        raise ValueError(f"the column {twice[0]!r} twice")
    for cells in table:
        if not any(cells):  # as a spreadsheet adds them
            continue
        if len(cells) != len(titles):
            raise ValueError(f"a row with another number of columns: {shown(cells)}")
        filled = {key: cell for key, cell in zip(titles, cells, strict=True) if cell}
        if "" in filled:
            raise ValueError(
                f"a column without a title, with {shown(filled[''])}; give it a title, or leave it out, in "
                "pandas by to_csv(index=False)"
            )
        read = {key: truth.get(value.lower(), value) for key, value in filled.items() if key in flags}
        rows.append({**filled, **read})
    return rows


def _drive(given: Row, base: Path, inside: Path) -> Drive:
    row = {key.replace("-", "_"): value for key, value in given.items() if value is not None}
    for name in _REFUSED:
        if name in row:
            raise ValueError(f"expected video, camera, {', '.join(_OWN)} or settings of a run, got {name}")
    video = _video(row)
    settings = {("source" if key == "video" else key): value for key, value in row.items() if key not in _OWN}
    values = parsed_settings(settings)
    for key in PATHS:
        if values.get(key) is not None:
            try:
                values[key] = path_inside(str(values[key]), base, inside)
            except ValueError as error:
                raise ValueError(f"{'video' if key == 'source' else key}: {error}") from error
    config = RunConfig(**values)  # type: ignore[arg-type]  # each parsed as its field
    time, day = _time_and_day(row)
    name = str(row.get("name") or _default_name(video))
    lens = str(row.get("camera_id") or _default_camera(config))
    for key, text in (("name", name), ("camera_id", lens)):
        if not _is_name(text):
            raise ValueError(
                f"{key}: expected a name of up to {_MOST_NAME} characters, without a slash and not beginning "
                f"with a dot, got {shown(text)}"
            )
    return Drive(name, lens, day, time, config)


def _video(row: Row) -> str:
    """Return the drive's path, which is that of no stream."""
    if "video" not in row:
        raise ValueError(f"expected video, the drive's path, got only {', '.join(row)}")
    video = row["video"]
    if not (isinstance(video, str) and video):
        raise ValueError(f"video: expected a path, got {shown(video)}")
    if is_live(video):
        stream = without_login(video)
        raise ValueError(f"video: expected a file or a folder, got the stream {stream}; use lanebev run")
    return video


def _is_name(text: str) -> bool:
    good = 0 < len(text) <= _MOST_NAME and text.isprintable() and not text.startswith(".")
    return good and not set("/\\") & set(text)


def _default_name(video: str) -> str:
    """Return a name of the path from the manifest, such as ``tuesday-front`` of tuesday/front.mp4."""
    parts = [part for part in Path(video).with_suffix("").parts if part not in ("/", "..", ".")]
    return re.sub(r"[*?\[\]]", "_", "-".join(parts))[-_MOST_NAME:]


def _default_camera(config: RunConfig) -> str:
    if not config.camera:
        return f"fov-{config.fov:g}"
    file, name = split_name(config.camera)
    return "-".join(filter(None, [file.stem, name]))


def _time_and_day(row: Row) -> tuple[str, str]:
    """Return time and day in ISO 8601; what is not known is empty, or UNKNOWN_DAY."""
    texts = {}
    for key in ("time", "day"):
        try:
            found = None if key not in row else datetime.fromisoformat(str(row[key]))
        except ValueError as error:
            raise ValueError(
                f"{key}: expected ISO 8601 as 2026-03-01T08:30, got {shown(row[key])}"
            ) from error
        texts[key] = found
    time, day = texts["time"], texts["day"]
    if day is None and time is None:
        return "", UNKNOWN_DAY
    date = (day or time).date().isoformat()  # type: ignore[union-attr]  # one is there
    return (date if time is None else time.isoformat()), date


def _check_names(path: Path, drives: Sequence[Drive]) -> None:
    names = Counter(drive.name.casefold() for drive in drives)
    if twice := [drive.name for drive in drives if names[drive.name.casefold()] > 1]:
        raise ValueError(
            f"manifest {path}: expected names that tell the drives apart, got {shown(twice[0])} twice; "
            "give name"
        )
    runs: dict[str, str] = {}
    for drive in drives:
        run = repr(replace(drive.config, source=os.path.realpath(drive.config.source)))
        if (first := runs.setdefault(run, drive.name)) != drive.name:
            raise ValueError(
                f"manifest {path}: expected each drive once, since it would count twice in the mounts, got "
                f"{shown(first)} and {shown(drive.name)} of the same video and settings; leave one out"
            )
    files: dict[str, str] = {}
    for drive in drives:
        lens = drive.config.camera
        if files.setdefault(drive.camera_id, lens) != lens:
            raise ValueError(
                f"manifest {path}: expected one camera file a camera, got {files[drive.camera_id]} and "
                f"{lens} for {drive.camera_id}; give camera_id"
            )
