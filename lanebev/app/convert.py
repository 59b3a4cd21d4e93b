"""``lanebev convert``: write the results of a finished run in another program's format."""

import importlib
from collections.abc import Callable, Iterable
from pathlib import Path

from lanebev.app.drive.sources import source_of_run
from lanebev.camera.choice import camera_file
from lanebev.io.formats.folder import read_record
from lanebev.io.formats.names import FORMATS, check_installed
from lanebev.io.formats.record import RunRecord
from lanebev.io.frames import Frame
from lanebev.io.output.folder import check_result
from lanebev.io.output.whole_file import whole_file
from lanebev.report.run_folder import read_run


def writer(name: str) -> Callable[[Path, RunRecord, Iterable[Frame] | None], None]:
    """Return the writer of a format, one of FORMATS, with images if the format contains them."""
    check_installed([name])
    write = importlib.import_module(f"lanebev.io.formats.{FORMATS[name].module}").write
    return lambda path, record, images: write(path, record, *([images] if FORMATS[name].has_images else []))


def convert(
    run: str, to: str, out: str | None = None, camera: str | None = None, images: str | None = None
) -> str:
    """Write a run's results in another format; the file is there whole or not at all.

    Args:
        run: output folder of ``lanebev run``.
        to: name of the format.
        out: the file; None is the format's own name in the run's folder.
        camera: camera file, where the folder has no ``calibration.yaml``.
        images: the run's source, for a format that shows images.

    Returns:
        what to print.

    Raises:
        ValueError: the folder is no run's, something that the format needs is not in it, the images are not
            the run's, a library is not installed, or the file is one of those that are read.
    """
    write, record = writer(to), read_record(run, camera)
    source = None
    if images is not None:
        source = source_of_run(images, read_run(run))
    path = Path(run) / FORMATS[to].file if out is None else Path(out)
    shown = [] if source is None else source.paths or [source.source]
    check_result(path, [run], [*shown, *([camera_file(camera)] if camera else [])])
    with whole_file(path) as whole:
        write(whole, record, source)
    return f"{path}: {len(record.rows)} frame{'s'[: len(record.rows) != 1]}"
