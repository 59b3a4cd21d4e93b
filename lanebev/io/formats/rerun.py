"""Rerun: a recording, or what is sent to a viewer while a run goes on."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.io.calibration_file import vehicle_from_camera
from lanebev.io.formats.names import check_installed
from lanebev.io.formats.record import RecordedFrame, RunRecord, with_images
from lanebev.io.frames import Frame
from lanebev.io.results import ExtrinsicsRow

APPLICATION, VIEWER = "lanebev", "viewer"
_QUALITY = 80  # of JPEG
_FRAMES_HELD = 100  # frames in memory, at most
_NUMBERS = ExtrinsicsRow._fields[2:10]


class RerunLog:
    """Frames into a ``rerun.RecordingStream``.

    Entities: ``road`` (x along the lanes, y left, z up, its origin below the camera), ``road/camera`` with
    the camera's pose as child-to-parent transform and its pinhole, ``road/camera/image`` and
    ``road/camera/boundaries``; ``pose/NAME`` for the numbers of ``extrinsics.csv``, and ``status``.
    Timelines: ``frame``, and ``time`` since the first frame.

    Source: Rerun's ``Transform3D``, ``Pinhole``, ``LineStrips2D``. Rerun's pixels have their origin at the
    outer corner of the first pixel: half a pixel is added.
    """

    def __init__(self, stream: Any, camera: Camera | None) -> None:
        import rerun

        self._rerun, self._stream = rerun, stream
        stream.log("road", rerun.ViewCoordinates.FLU, static=True)
        if camera is not None:
            matrix = camera.intrinsics.double().numpy().copy()
            matrix[:2, 2] += 0.5
            height, width = camera.image_size
            pinhole = rerun.Pinhole(
                image_from_camera=matrix, width=width, height=height, camera_xyz=rerun.ViewCoordinates.RDF
            )
            stream.log("road/camera", pinhole, static=True)

    def add(self, frame: RecordedFrame, image: NDArray[np.uint8] | None = None) -> None:
        """Take in a frame; ``image`` is (H, W, 3) RGB or None."""
        rerun, stream, (row, pose, lines) = self._rerun, self._stream, frame
        stream.set_time("frame", sequence=row.frame)
        stream.set_time("time", duration=row.time_s)
        matrix = vehicle_from_camera(pose)[0].double().numpy()
        stream.log("road/camera", rerun.Transform3D(translation=matrix[:3, 3], mat3x3=matrix[:3, :3]))
        strips = [points + 0.5 for points in lines.values()]
        labels = [f"boundary {number}" for number in lines]
        stream.log("road/camera/boundaries", rerun.LineStrips2D(strips, labels=labels, show_labels=False))
        for name in _NUMBERS:
            stream.log(f"pose/{name}", rerun.Scalars(getattr(row, name)))
        stream.log("status", rerun.TextLog(" ".join([row.status, row.reasons]).strip()))
        if image is not None:
            _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            encoded = rerun.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")
            stream.log("road/camera/image", encoded)


def write(path: Path, record: RunRecord, images: Iterable[Frame] | None = None) -> None:
    """Write the run as a recording (``.rrd``), with its images if there are any.

    Rerun's own file writer waits forever where the disk is full, so the bytes are written here.
    """
    import rerun

    with rerun.RecordingStream(APPLICATION) as stream, open(path, "wb") as file:
        encoded = stream.binary_stream()
        log = RerunLog(stream, record.camera)
        for number, (frame, image) in enumerate(with_images(record, images), start=1):
            log.add(frame, image)
            if number % _FRAMES_HELD == 0:
                file.write(encoded.read() or b"")
        file.write(encoded.read() or b"")


def open_viewer(where: str, camera: Camera) -> RerunLog:
    """Return a log whose frames a viewer shows as they come.

    Args:
        where: "viewer" for one that is opened, else the address of one that is there, as
            ``rerun+http://127.0.0.1:9876/proxy``.
        camera: the lens.
    """
    check_installed(["rerun"])
    import rerun

    stream = rerun.RecordingStream(APPLICATION)
    try:
        if where == VIEWER:
            stream.spawn()
        else:
            stream.connect_grpc(where)
    except (RuntimeError, ValueError, OSError) as error:
        reason = " ".join(str(error).split())[:160]
        raise ValueError(f"rerun {where}: expected {VIEWER}, or the address of one, got: {reason}") from error
    return RerunLog(stream, camera)
