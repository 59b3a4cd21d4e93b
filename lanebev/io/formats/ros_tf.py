"""ROS 2: a launch file that publishes where the camera is."""

from pathlib import Path
from typing import Any

import yaml

from lanebev.io.calibration_file import quaternion_xyzw, vehicle_from_camera
from lanebev.io.formats.record import RunRecord

PARENT, CHILD = "base_footprint", "camera_optical_frame"


def static_transform(record: RunRecord) -> dict[str, Any]:
    """Return the fields of a ``geometry_msgs/TransformStamped`` for ``/tf_static``.

    Source: REP 103 (base frames: x forward, y left, z up; optical frames: x right, y down, z forward), REP
    105 and 120 (``base_footprint`` lies on the ground). The transform takes points of the child, the camera,
    to the parent, which is below the camera here. The quaternion is x, y, z, w.
    """
    matrix = vehicle_from_camera(record.standing_pose().extrinsics)[0].double()
    translation, rotation = matrix[:3, 3].tolist(), quaternion_xyzw(matrix)
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": PARENT},
        "child_frame_id": CHILD,
        "transform": {
            "translation": dict(zip("xyz", translation, strict=True)),
            "rotation": dict(zip("xyzw", rotation, strict=True)),
        },
    }


def launch_file(record: RunRecord) -> str:
    """Return a file for ``ros2 launch``: ``static_transform_publisher`` of ``tf2_ros`` with the transform."""
    fields = static_transform(record)
    place, turn = fields["transform"]["translation"], fields["transform"]["rotation"]
    numbers = {**place, **{f"q{axis}": value for axis, value in turn.items()}}
    arguments = [f"--{name} {value:.12g}" for name, value in numbers.items()]
    arguments += [f"--frame-id {PARENT}", f"--child-frame-id {CHILD}"]
    node = {"pkg": "tf2_ros", "exec": "static_transform_publisher", "args": " ".join(arguments)}
    launch: str = yaml.safe_dump({"launch": [{"node": node}]}, sort_keys=False, width=1000)
    return f"# The camera's pose is {record.standing_pose().source}.\n{launch}"


def write(path: Path, record: RunRecord) -> None:
    """Write the run."""
    path.write_text(launch_file(record), encoding="utf-8")
