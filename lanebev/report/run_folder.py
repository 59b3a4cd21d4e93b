"""Read the outputs of a run back: rows, settings, lens and pictures."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lanebev.io.frames import Selection
from lanebev.io.results import ExtrinsicsRow, read_extrinsics

FIRST_NUMBER = "first frame, in the source"
"""Label of the setting that says the number of a run's first frame in the whole source."""
_PICTURE = re.compile(r"data:image/jpeg;base64,[A-Za-z0-9+/=]*")


@dataclass(frozen=True)
class RunFolder:
    """A finished run.

    Attributes:
        name: name of its folder.
        rows: rows of ``extrinsics.csv``.
        settings: label to value, empty if there is no report.
        lens: likewise.
        pictures: of some frames, by number of the frame: name of the view to an address that holds it.
    """

    name: str
    rows: Sequence[ExtrinsicsRow]
    settings: Mapping[str, str] = field(default_factory=dict)
    lens: Mapping[str, str] = field(default_factory=dict)
    pictures: Mapping[int, Mapping[str, str]] = field(default_factory=dict)

    def selection(self) -> Selection:
        """Return which frames of its source the run took, by its settings; all where there are none."""
        return Selection(
            _number(self.settings.get("--start", ""), 0.0),
            _number(self.settings.get("--end", ""), math.inf),
            _whole(self.settings.get("--every", ""), 1),
        )

    @property
    def fps(self) -> float | None:
        """The frame rate that the run was given, Hz; None if it was given none."""
        value = _number(self.settings.get("--fps", ""), math.nan)
        return value if value > 0 else None

    @property
    def topic(self) -> str | None:
        """The topic of the images that the run was given; None if it was given none."""
        topic = self.settings.get("--topic", "not given")
        return None if topic == "not given" else topic

    def source_numbers(self) -> list[int]:
        """Return the frames' numbers in the whole source, by the settings that say which were taken."""
        first, every = _whole(self.settings.get(FIRST_NUMBER, ""), 0), self.selection().every
        return [first + every * row.frame for row in self.rows]


def read_run(folder: str | Path) -> RunFolder:
    """Read a run's folder; ``report.html`` in it may be missing or another program's."""
    folder = Path(folder)
    rows = read_extrinsics(folder / "extrinsics.csv")
    if not rows:
        raise ValueError(f"{folder / 'extrinsics.csv'}: expected a row per frame, got none")
    try:
        page = (folder / "report.html").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return RunFolder(folder.resolve().name, rows)
    run, data = _json(page, "run"), _json(page, "data")
    return RunFolder(
        folder.resolve().name, rows, _texts(run.get("settings")), _texts(run.get("lens")), _pictures(data)
    )


def _whole(text: str, default: int) -> int:
    return int(text) if text.isdecimal() else default


def _number(text: str, default: float) -> float:
    try:
        return float(text)
    except ValueError:
        return default


def _json(page: str, name: str) -> dict[str, Any]:
    """Return the data that a page gives its script by this name; nothing where there are none."""
    found = re.search(rf'<script type="application/json" id="{name}">([^<]*)</script>', page)
    try:
        value = json.loads(found[1]) if found else {}
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def _texts(value: object) -> dict[str, str]:
    return {str(key): str(text) for key, text in value.items()} if isinstance(value, dict) else {}


def _pictures(data: Mapping[str, Any]) -> dict[int, dict[str, str]]:
    """Return the pictures by number of the frame, those only that are JPEG."""
    try:
        frames = dict(zip(data["place"], data["frame"], strict=True))
        return {
            int(frames[int(place)]): {
                str(name): uri for name, uri in views.items() if _PICTURE.fullmatch(uri)
            }
            for place, views in data["pictures"].items()
        }
    except (KeyError, TypeError, ValueError, AttributeError):
        return {}
