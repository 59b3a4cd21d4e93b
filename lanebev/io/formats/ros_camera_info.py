"""ROS's ``camera_info`` YAML, as ``camera_info_manager`` reads it."""

from collections.abc import Iterable
from pathlib import Path

from lanebev.io.formats.record import RunRecord
from lanebev.io.frames import Frame


def write(path: Path, record: RunRecord, images: Iterable[Frame] | None = None) -> None:
    """Write the camera, see :func:`lanebev.camera.files.camera_info`; ``images`` are not used.

    Raises:
        ValueError: the run has no camera.
    """
    record.lens().to_file(path)
