"""MCAP with Foxglove's messages: boundaries over the image, where the camera is, its lens, all estimates."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lanebev.camera.files import camera_info
from lanebev.camera.model import Camera
from lanebev.io.calibration_file import quaternion_xyzw, vehicle_from_camera
from lanebev.io.formats.jsonl import frame_lines
from lanebev.io.formats.record import Lines, RunRecord, with_images
from lanebev.io.frames import Frame
from lanebev.io.results import ExtrinsicsRow
from lanebev.types import Extrinsics

ROAD, CAMERA = "road", "camera"
_QUALITY = 80  # of JPEG
_COLOURS = (  # by Okabe and Ito, told apart by the colour-blind
    (0.9, 0.6, 0.0), (0.3, 0.7, 0.9), (0.0, 0.7, 0.4), (0.9, 0.9, 0.2), (0.8, 0.4, 0.0), (0.8, 0.6, 0.7),
)  # fmt: skip
_MODELS = {"equidistant": "kannala_brandt"}  # Foxglove's name for ROS's

_TABLE_SCHEMA = {
    "type": "object",
    "properties": {name: {"type": "number"} for name in ExtrinsicsRow._fields[:10]}
    | {name: {"type": "string"} for name in ("status", "image")}
    | {
        "segments": {"type": "integer"},
        "reasons": {"type": "array", "items": {"type": "string"}},
        "covariance": {"type": "array", "items": {"type": "array", "items": {"type": "number"}}},
    },
}


def nanoseconds(start: float, time: float) -> int:
    """Return ``start + time`` s in ns: whole seconds apart, which a float of ns would round to 256 ns."""
    whole, part = divmod(start, 1.0)
    return int(whole) * 10**9 + round(1e9 * (part + time))


def camera_calibration(camera: Camera, time: int) -> Any:
    """Return the lens as a ``foxglove.CameraCalibration`` at a time in ns.

    ``kannala_brandt`` is "fisheye"; "omni" has no name there, and image panels take it for no lens.
    """
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

    fields = camera_info(camera.parameters())
    model = fields["distortion_model"]
    message = CameraCalibration(
        frame_id=CAMERA,
        width=fields["image_width"],
        height=fields["image_height"],
        distortion_model=_MODELS.get(model, model),
        D=fields["distortion_coefficients"]["data"],
        K=fields["camera_matrix"]["data"],
        R=fields["rectification_matrix"]["data"],
        P=fields["projection_matrix"]["data"],
    )
    message.timestamp.FromNanoseconds(time)
    return message


def frame_transform(pose: Extrinsics, time: int) -> Any:
    """Return where the camera is on the road as a ``foxglove.FrameTransforms`` at a time in ns.

    The child is the camera (x right, y down, z forward); the parent, ``road``, is x along the lanes, y left,
    z up, its origin on the road below the camera.

    Args:
        pose: each (1,).
        time: ns.
    """
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms

    matrix = vehicle_from_camera(pose)[0].double()
    message = FrameTransforms()
    transform = message.transforms.add(parent_frame_id=ROAD, child_frame_id=CAMERA)
    transform.timestamp.FromNanoseconds(time)
    place, turn = transform.translation, transform.rotation
    place.x, place.y, place.z = matrix[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = quaternion_xyzw(matrix)
    return message


def image_annotations(lines: Lines, row: ExtrinsicsRow, time: int) -> Any:
    """Return a frame's boundaries and status as a ``foxglove.ImageAnnotations`` at a time in ns.

    Foxglove's pixels have their origin at the outer corner of the first pixel, ours at its centre: half a
    pixel is added.
    """
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
    from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation

    message = ImageAnnotations()
    message.timestamp.FromNanoseconds(time)
    for boundary, points in lines.items():
        drawn = message.points.add(type=PointsAnnotation.LINE_STRIP, thickness=3.0)
        drawn.timestamp.FromNanoseconds(time)
        for x, y in (points + 0.5).tolist():
            drawn.points.add(x=x, y=y)
        red, green, blue = _COLOURS[boundary % len(_COLOURS)]
        drawn.outline_color.r, drawn.outline_color.g, drawn.outline_color.b = red, green, blue
        drawn.outline_color.a = 1.0
        drawn.metadata.add(key="boundary", value=str(boundary))
    text = message.texts.add(text=" ".join([row.status, row.reasons]).strip(), font_size=16.0)
    text.timestamp.FromNanoseconds(time)
    text.position.x, text.position.y = 8.0, 24.0
    text.text_color.r = text.text_color.g = text.text_color.b = text.text_color.a = 1.0
    return message


def compressed_image(image: NDArray[np.uint8], time: int) -> Any:
    """Return an (H, W, 3) RGB image as a ``foxglove.CompressedImage``, JPEG, at a time in ns."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    message = CompressedImage(frame_id=CAMERA, format="jpeg", data=data.tobytes())
    message.timestamp.FromNanoseconds(time)
    return message


def write(path: Path, record: RunRecord, images: Iterable[Frame] | None = None) -> None:
    """Write the run, with its images as JPEG if there are any.

    Topics: ``/camera/annotations``, ``/camera/calibration``, ``/camera/image``, ``/tf``, and ``/lanebev``, a
    JSON object per frame with the fields of :mod:`lanebev.io.formats.jsonl`.

    Source: mcap.dev; Foxglove's message schemas.
    """
    from mcap_protobuf.writer import Writer

    with open(path, "wb") as file, Writer(file) as writer:
        table = _json_channel(writer)
        frames = with_images(record, images)
        for number, ((frame, image), line) in enumerate(zip(frames, frame_lines(record), strict=True)):
            time = nanoseconds(record.start, frame.row.time_s)
            messages = {
                "/tf": frame_transform(frame.pose, time),
                "/camera/annotations": image_annotations(frame.lines, frame.row, time),
            }
            if record.camera is not None:
                messages["/camera/calibration"] = camera_calibration(record.camera, time)
            if image is not None:
                messages["/camera/image"] = compressed_image(image, time)
            for topic, message in messages.items():
                writer.write_message(topic, message, log_time=time, publish_time=time, sequence=number)
            writer._writer.add_message(table, time, line.encode(), time, number)


def _json_channel(writer: Any) -> int:
    """Register ``/lanebev``; the library's protobuf writer has no other messages, the one it holds does."""
    plain = writer._writer
    schema = plain.register_schema("lanebev.Frame", "jsonschema", json.dumps(_TABLE_SCHEMA).encode())
    channel: int = plain.register_channel("/lanebev", "json", schema)
    return channel
