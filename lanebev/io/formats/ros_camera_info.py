"""ROS's ``camera_info`` YAML, as ``camera_info_manager`` reads it."""

from pathlib import Path

from lanebev.io.formats.record import RunRecord


def write(path: Path, record: RunRecord) -> None:
    """Write the camera, see :func:`lanebev.camera.files.camera_info`."""
    record.lens().to_file(path)
