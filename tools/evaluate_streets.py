"""Figures on single images of streets, by day and by night, from pixels.

    python -m tools.evaluate_streets [--data ../shared/data] [--weights FILE] [--json FILE] [--far-view]
        [--precision bfloat16]
    python -m tools.evaluate_streets --rendered 24 [--size 720 1280] [--width 576] [--far-view]

``kitti_road``: the road plane of the lidar is the truth of pitch and roll (0.1 to 0.2 degrees), yaw has none.
``kitti_road_with_prior``: the same with the median of these as a mount that is known.
``kitti_road_standing``: each image as a drive of a second in which the car stands: the same frame 30 times.
``culane``: frames at night whose camera is not published; a field of view of 60 degrees is assumed, and only
the number of calibrated frames counts. ``streets``: two images with a known pose. Nothing here is trained on.
``--rendered``: in place of these, rendered views of all kinds of road, of ``--size``.
"""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import torch
from jsonargparse.typing import PositiveFloat, PositiveInt
from torch import Tensor

import lanebev
from lanebev import Camera, JointCalibrator, LaneBEV
from lanebev.estimation.joint.frame_prior import FramePrior, prior_of_mount
from lanebev.estimation.tracker import Tracker
from lanebev.geometry.rotation import road_from_cam
from lanebev.io.images.pixels import read_image
from lanebev.observation.frames import check_frame, network_image
from lanebev.render import render_views
from tools.network_options import make_model, network_parser
from tools.single_images import as_answer, calibrate, calibrate_frame, plane_angles, summarise
from train.commands import one_line_errors

KITTI_LANE_WIDTH = 3.5  # m
ASSUMED_FOV = 60.0  # deg, of a camera that is not published
RENDERED_SEED, RENDERED_ROWS = 621, 8  # views at once
KITTI_SIZE = (375, 1242)  # px
STANDING_FRAMES = 30  # of a drive in which the car stands
MOUNT_STD = 0.001  # rad, of the median pose where it is given as a prior


def kitti_truth(path: Path) -> Tensor:
    """Read the road plane's pitch and roll (2,), rad, from a KITTI road calibration file."""
    lines = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    matrix = torch.tensor([float(value) for value in lines["Tr_cam_to_road"].split()]).double()
    return plane_angles(matrix.reshape(3, 4)[1, :3])


def kitti_road(model: LaneBEV, data: Path) -> dict[str, float]:
    """Evaluate German city streets against the lidar's road plane."""
    return _kitti_road(model, data, None)


def kitti_road_with_prior(model: LaneBEV, data: Path) -> dict[str, float]:
    """Evaluate the same with the median of the true pitch and roll as the pose that ``--mount`` gives."""
    calibs = sorted((data / "kitti_road" / "calib").glob("*.txt"))
    pitch, roll = torch.stack([kitti_truth(path) for path in calibs]).median(0).values.tolist()
    pose, std = (pitch, 0.0, roll, 0.0), (MOUNT_STD, torch.inf, MOUNT_STD, torch.inf)
    return _kitti_road(model, data, prior_of_mount(pose, std))


def kitti_road_standing(model: LaneBEV, data: Path) -> dict[str, float]:
    """Evaluate the last frame of drives in which the car stands, so that every frame is the same."""
    answers, truth = [], []
    for path, calib, camera in _kitti_images(data):
        with torch.inference_mode():
            image = network_image(check_frame(read_image(path), camera.image_size), torch.device("cpu"))
            tracker = Tracker(JointCalibrator(), camera, KITTI_LANE_WIDTH)
            for number in range(STANDING_FRAMES):
                if number == 0 or model.far_view is not None:  # else every frame is the same
                    point = None if model.far_view is None else tracker.vanishing_point()
                    _, vertices = model.boundary_vertices(image, point)
                estimate = tracker.drive_frame(vertices, 1 / STANDING_FRAMES, model.pose_sigma_scale)
        answers.append(as_answer(path.name, estimate.calibration))
        truth.append(kitti_truth(calib))
    return summarise(answers, torch.stack(truth))


def _kitti_images(data: Path) -> Iterator[tuple[Path, Path, Camera]]:
    """Yield every image, its calibration file and its camera."""
    for path in sorted((data / "kitti_road" / "image_2").glob("*.png")):
        calib = data / "kitti_road" / "calib" / f"{path.stem}.txt"
        height, width = read_image(path).shape[:2]
        yield path, calib, Camera.from_file(calib, image_size=(height, width))


def _kitti_road(model: LaneBEV, data: Path, prior: FramePrior | None) -> dict[str, float]:
    answers, truth = [], []
    for path, calib, camera in _kitti_images(data):
        answers.append(calibrate(model, path, camera, KITTI_LANE_WIDTH, prior))
        truth.append(kitti_truth(calib))
    return summarise(answers, torch.stack(truth))


def culane(model: LaneBEV, data: Path) -> dict[str, float]:
    """Evaluate night frames: how many are calibrated."""
    paths = sorted((data / "culane").rglob("*.jpg"))
    height, width = read_image(paths[0]).shape[:2]
    camera = Camera.from_fov(ASSUMED_FOV, width, height)
    tracking = sum(calibrate(model, path, camera, 3.7).tracking for path in paths)
    return {"images": len(paths), "tracking": tracking}


def streets(model: LaneBEV, data: Path) -> dict[str, float]:
    """Evaluate two images with a known pose, in sigmas."""
    lines = (data / "streets" / "truth.csv").read_text().splitlines()
    rows = {row["image"]: row for row in csv.DictReader(line for line in lines if not line.startswith("#"))}
    figures: dict[str, float] = {}
    for path in sorted(p for p in (data / "streets").iterdir() if p.name in rows):
        file = path.with_suffix(".yaml")
        height, width = read_image(path).shape[:2]
        camera = Camera.from_file(file) if file.exists() else Camera.from_fov(ASSUMED_FOV, width, height)
        answer, row = calibrate(model, path, camera, KITTI_LANE_WIDTH), rows[path.name]
        truth = torch.tensor([float(row["pitch_deg"]), float(row["roll_deg"])]).double()
        pitch, roll = ((answer.plane - truth).abs() / answer.sigma).tolist()
        tall = abs(answer.height - float(row["height_m"])) / answer.height_sigma
        for axis, value in (("pitch", pitch), ("roll", roll), ("height", tall)):
            figures[f"{path.stem}_{axis}_error_in_sigma"] = value
    return figures


def rendered(model: LaneBEV, views: int, size: tuple[int, int] = KITTI_SIZE) -> dict[str, float]:
    """Evaluate rendered views (height, width) of all kinds of road, each with the mean of its lane widths."""
    generator = torch.Generator().manual_seed(RENDERED_SEED)
    answers, truth = [], []
    with torch.inference_mode():
        for start in range(0, views, RENDERED_ROWS):
            frame = render_views(min(RENDERED_ROWS, views - start), size, generator)
            pitch, yaw, roll, _ = (part.double() for part in frame.extrinsics)
            truth.append(plane_angles(road_from_cam(pitch, yaw, roll)[:, 1]))
            for row, image in enumerate(frame.image):
                lens = (frame.intrinsics[row].double(), frame.distortion[row].double())
                camera = Camera(*lens, "pinhole", size)
                width = float(frame.lane_width[row].mean())
                calibration = calibrate_frame(model, image[None], camera, width)
                answers.append(as_answer(f"{start + row}", calibration))
    return summarise(answers, torch.cat(truth))


@one_line_errors()
def main() -> None:
    """Run the evaluation from the command line."""
    parser = network_parser(__doc__)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument(
        "--rendered", type=PositiveInt, metavar="N", help="evaluate on N rendered views instead"
    )
    parser.add_argument(
        "--size",
        type=PositiveInt,
        nargs=2,
        default=KITTI_SIZE,
        metavar=("HEIGHT", "WIDTH"),
        help="px of these (as KITTI's images)",
    )
    parser.add_argument(
        "--pose-sigma-scale", type=PositiveFloat, help="instead of the factor that the weights state"
    )
    options = parser.parse_args()
    model = make_model(options)
    model.pose_sigma_scale = options.pose_sigma_scale or model.pose_sigma_scale
    if options.rendered:
        report({"rendered": rendered(model, options.rendered, tuple(options.size))}, options.json)
        return
    for name in ("kitti_road", "culane", "streets"):
        if not (options.data / name).is_dir():
            raise ValueError(f"{options.data}: expected the folder {name}, got none; give --data")
    figures = {
        part.__name__: part(model, options.data)
        for part in (kitti_road, kitti_road_with_prior, kitti_road_standing, culane, streets)
    }
    report(figures, options.json)


def report(figures: dict[str, dict[str, float]], file: Path | None) -> None:
    """Print the figures of each part, and write them as JSON if a file is given."""
    print(json.dumps(figures, indent=1))
    if file is not None:
        file.write_text(json.dumps({"lanebev": lanebev.__version__, **figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
