"""``lanebev compare``: compare two runs on one page."""

from lanebev.io.output.folder import check_result
from lanebev.io.output.whole_file import whole_file
from lanebev.report.comparison import comparison_summary, render_comparison
from lanebev.report.run_folder import read_run


def compare(first: str, second: str, out: str) -> str:
    """Write a page that compares two output folders of runs, completely or not at all.

    Args:
        first: folder of a run.
        second: output folder of another run on the same frames.
        out: the page's file.

    Returns:
        what to print.

    Raises:
        ValueError: a folder without a run's ``extrinsics.csv``, no frame in common, or a page that cannot be
            written or would replace an output of these runs.
    """
    runs = read_run(first), read_run(second)
    check_result(out, (first, second))
    page = render_comparison(*runs)
    with whole_file(out) as whole:
        whole.write_text(page, encoding="utf-8", errors="replace")
    return f"{comparison_summary(*runs)}\n{out}"
