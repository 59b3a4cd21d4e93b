"""Formats by name: the file, the module that writes it, and what must be installed. Imports nothing heavy."""

from collections.abc import Iterable
from importlib.util import find_spec
from typing import NamedTuple


class FormatName(NamedTuple):
    """Name, module and requirements of a format.

    Attributes:
        file: its name in a run's folder.
        module: module of this package with a function ``write``.
        needs: modules that must be installed.
        extra: extra of lanebev that installs them.
        has_images: whether ``write`` takes the images of the frames too.
    """

    file: str
    module: str
    needs: tuple[str, ...] = ()
    extra: str = ""
    has_images: bool = False


FORMATS = {
    "parquet": FormatName("frames.parquet", "parquet", ("pyarrow",), "formats"),
    "jsonl": FormatName("frames.jsonl", "jsonl"),
    "kitti": FormatName("kitti_calib.txt", "kitti"),
    "nuscenes": FormatName("nuscenes_calibrated_sensor.json", "nuscenes"),
    "ros-tf": FormatName("ros_static_transform.launch.yaml", "ros_tf"),
    "ros-camera-info": FormatName("ros_camera_info.yaml", "ros_camera_info"),
    "openpilot": FormatName("openpilot_calibration.json", "openpilot"),
    "opencv": FormatName("opencv_poses.yaml", "opencv"),
    "mcap": FormatName(
        "run.mcap", "mcap", ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf"), "formats", has_images=True
    ),
    "rerun": FormatName("run.rrd", "rerun", ("rerun",), "rerun", has_images=True),
}


def parse_formats(text: str) -> tuple[str, ...]:
    """Return the names of formats in a text such as ``parquet,mcap``, each once."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise ValueError(f"formats: expected some of {', '.join(FORMATS)}, separated by commas, got {text!r}")
    check_formats(names)
    return names


def check_formats(names: Iterable[str]) -> None:
    """Raise unless these are names of formats."""
    for name in names:
        if name not in FORMATS:
            raise ValueError(f"formats: expected some of {', '.join(FORMATS)}, got {name!r}")


def check_installed(names: Iterable[str]) -> None:
    """Raise unless all that these formats need is installed."""
    for name in names:
        known = FORMATS[name]
        for module in known.needs:
            if find_spec(module) is None:
                raise ValueError(
                    f"format {name}: expected the library {module}, got none; install it with "
                    f"pip install 'lanebev[{known.extra}]'"
                )
