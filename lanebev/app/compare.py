"""``lanebev compare``: two runs side by side on one page."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from lanebev.report.comparison import comparison_summary, render_comparison
from lanebev.report.run_folder import read_run


def compare(first: str, second: str, out: str) -> str:
    """Write a page that compares two output folders of runs; nothing of it if something is amiss.

    Args:
        first: folder of a run.
        second: of another run on the same frames.
        out: the page's file.

    Returns:
        what to print.

    Raises:
        ValueError: a folder without a run's ``extrinsics.csv``, no frame in common, or a page that cannot be
            written.
    """
    runs = read_run(first), read_run(second)
    page, path = render_comparison(*runs), Path(os.path.realpath(out))
    try:
        if path.is_dir():
            raise IsADirectoryError(0, "a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.partial-", dir=path.parent) as partial:
            whole = Path(partial) / path.name
            whole.write_text(page, encoding="utf-8", errors="replace")
            whole.replace(path)
    except OSError as error:
        raise ValueError(
            f"out {out}: expected a file that can be written, got: {error.strerror}; give another with --out"
        ) from error
    return f"{comparison_summary(*runs)}\n{out}"
