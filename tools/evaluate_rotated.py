"""Rotate every frame of a video by known angles, and compare the change of the estimated pose with them.

    python -m tools.evaluate_rotated VIDEO --camera FILE [--lane-width 3.7] [--every 5] [--weights FILE]

It needs no truth, so it works on any video: if a camera is turned by 3°, its estimated roll must change by
3°. Each version of the video is calibrated by itself, and its pose is compared with that of the original,
turned by the same angles. Errors that all versions share, such as that of the focal length or of a road
whose lanes have another width, do not appear. Prints the root mean square of the difference in pitch, yaw,
roll (°) and height (cm), without the first half second, and the largest difference in standard deviations
of the version's pose.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jsonargparse.typing import PositiveFloat, PositiveInt
from torch import Tensor

from lanebev import Camera, CanonicalView, Extrinsics, LaneBEV, Status
from lanebev.geometry.rotation import pitch_yaw_roll, road_from_cam
from lanebev.io.frames import Selection
from lanebev.io.opening import open_source
from lanebev.observation.frames import check_frame, network_image
from tools.network_options import make_model, network_parser
from train.commands import one_line_errors

ROTATIONS = (
    (3.0, 0.0, 0.0),
    (-3.0, 0.0, 0.0),
    (0.0, 5.0, 0.0),
    (0.0, -5.0, 0.0),
    (0.0, 0.0, 3.0),
    (0.0, 0.0, -3.0),
    (2.0, 3.0, -2.0),
    (-2.0, -3.0, 2.0),
)
"""Pitch, yaw and roll, °, by which the camera is turned."""

WARM_UP = 0.5  # s, not evaluated


class Poses(NamedTuple):
    """Estimates of T frames of the video and of R rotated ones, the original first.

    Attributes:
        pose: (T, 1 + R, 4), pitch, yaw, roll (rad) and height (m).
        std: likewise.
        status: (T, 1 + R) int64.
        times: (T,) s since the first frame.
    """

    pose: Tensor
    std: Tensor
    status: Tensor
    times: Tensor


@one_line_errors()
def main() -> None:
    parser = network_parser(__doc__)
    parser.add_argument("video", help="as of lanebev run: a video or a folder of images")
    parser.add_argument("--camera", required=True, help="camera file")
    parser.add_argument("--lane-width", type=PositiveFloat, default=3.7, help="m (default: 3.7)")
    parser.add_argument("--every", type=PositiveInt, default=1, help="process only every N-th frame")
    options = parser.parse_args()
    camera = Camera.from_file(options.camera)
    found = follow(make_model(options), options.video, camera, options.lane_width, options.every)
    for line in table(found):
        print(line)


def rotations(degrees: tuple[tuple[float, float, float], ...]) -> Tensor:
    """Return the rotations (R, 3, 3) from the turned cameras to the camera as it was."""
    pitch, yaw, roll = torch.tensor(degrees, dtype=torch.float64).deg2rad().unbind(-1)
    return road_from_cam(pitch, yaw, roll)


def turned_pose(pose: Tensor, by: Tensor) -> Tensor:
    """Compute the pose (..., 4) of a camera that was turned.

    Args:
        pose: (..., 4) rad and m, of the camera as it was.
        by: (..., 3, 3), from the turned camera to the camera as it was.
    """
    angles = pitch_yaw_roll(road_from_cam(*pose[..., :3].unbind(-1)) @ by)
    return torch.cat([angles, pose[..., 3:].expand_as(angles[..., :1])], dim=-1)


def views(camera: Camera) -> list[CanonicalView]:
    """Make the views of the camera as it was and of the turned ones, all without its lens distortion."""
    made = []
    for pitch, yaw, roll in ((0.0, 0.0, 0.0), *ROTATIONS):
        pose = Extrinsics.from_values(math.radians(pitch), math.radians(yaw), math.radians(roll), 1.0)
        made.append(CanonicalView(camera.intrinsics, camera.image_size, pose, keep_height=True))
    return made


def follow(model: LaneBEV, source: str, camera: Camera, lane_width: float, every: int) -> Poses:
    """Calibrate a video and its rotated versions, as the rows of one batch.

    Raises:
        ValueError: a source without usable frames, or frames of another size than the camera's.
    """
    turned = views(camera)
    rows = len(turned)
    intrinsics = camera.intrinsics.float().expand(rows, 3, 3)
    state = model.initial_state(rows, torch.float64)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    times: list[float] = []
    for image, time in _frames(source, camera, every):
        dt = time - times[-1] if times else 1 / 30
        with torch.inference_mode():
            batch = torch.cat([_turned(view, image, camera) for view in turned])
            out, state = model(batch, intrinsics, state, dt, lane_width, bev=False)
        calibration = out.calibration
        std = calibration.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        found.append((calibration.extrinsics.stack(), std, calibration.status))
        times.append(time)
    if not found:
        raise ValueError(f"{source}: expected a frame that decodes, got none")
    pose, std, status = (torch.stack(part) for part in zip(*found, strict=True))
    return Poses(pose, std, status, torch.tensor(times, dtype=torch.float64))


def _frames(source: str, camera: Camera, every: int) -> Iterator[tuple[Tensor, float]]:
    """Yield every N-th frame (1, 3, H, W) in [0, 1] that decodes, and its time, s."""
    for frame in replace(open_source(source), selection=Selection(every=every)):
        if frame.image is not None:
            image = network_image(check_frame(frame.image, camera.image_size), torch.device("cpu"))
            yield image, frame.time


def _turned(view: CanonicalView, image: Tensor, camera: Camera) -> Tensor:
    distortion = None if camera.distortion is None else camera.distortion[None].to(image)
    level = Extrinsics.from_values(0.0, 0.0, 0.0, 1.0)
    intrinsics = camera.intrinsics[None].to(image)
    turned: Tensor = view(image, intrinsics, level, distortion, camera.model)[0]
    return turned


def table(found: Poses) -> list[str]:
    """Return the lines of a table with the differences of each rotated version."""
    lines = [
        "| turned by pitch, yaw, roll | TRACKING | RMS: pitch, yaw, roll, height | largest, in σ |",
        "|---|---|---|---|",
    ]
    used = found.times >= found.times[0] + WARM_UP
    for row, (angles, by) in enumerate(zip(ROTATIONS, rotations(ROTATIONS), strict=True), start=1):
        both = used & (found.status[:, [0, row]] == Status.TRACKING).all(-1)
        share = float((found.status[used, row] == Status.TRACKING).double().mean())
        apart = (found.pose[:, row] - turned_pose(found.pose[:, 0], by))[both]
        rms = apart.square().mean(0).sqrt()
        largest = (apart / found.std[both, row]).abs().amax(0) if len(apart) else rms
        figures = " ".join(f"{value:.3f}°" for value in rms[:3].rad2deg().tolist())
        sigmas = " ".join(f"{value:.1f}" for value in largest.tolist())
        name = " ".join(f"{angle:+.0f}°" if angle else "0" for angle in angles)
        lines.append(f"| {name} | {100 * share:.0f} % | {figures} {100 * float(rms[3]):.1f} cm | {sigmas} |")
    return lines


if __name__ == "__main__":
    main()
