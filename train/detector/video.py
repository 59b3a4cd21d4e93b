"""Video of all arms: ``python -m train.detector.video --config configs/detector.yaml --film FILM.mp4``.

Each frame of the test drives shows the image and, for each arm, its bird's-eye view by the pose that it takes
for true, with the boxes that it finds (red) over those that are there (white).
"""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import torch
from jsonargparse.typing import PositiveInt
from numpy.typing import NDArray
from torch import Tensor

from lanebev.io.video.writer import VideoWriter
from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid
from lanebev.view.warp import BEVWarp
from train.commands import one_line_errors
from train.detector.arms import test_poses, trained_arm
from train.detector.boxes import box_corners
from train.detector.frames import DriveFrames
from train.detector.module import DetectorTraining
from train.detector.settings import Experiment, experiment_of, experiment_parser
from train.detector.table import NAMES
from train.detector.targets import decode_boxes

SHOWN_SCORE = 0.3
CELL = 0.15  # m
TRUE, FOUND = (255, 255, 255), (255, 40, 40)
Picture = NDArray[np.uint8]


def draw_boxes(picture: Picture, boxes: Tensor, grid: BEVGrid, colour: tuple[int, int, int]) -> None:
    """Draw boxes (M, 5) into a bird's-eye view (U, V, 3) of a grid, with a line to the front."""
    corners = grid.bev_from_road_points(box_corners(boxes)).double().numpy()
    front = 0.5 * (corners[:, 0] + corners[:, 1])
    middle = corners.mean(1)
    for box, ahead, centre in zip(corners, front, middle, strict=True):
        cv2.polylines(picture, [box.round().astype(np.int32)], True, colour, 1, cv2.LINE_AA)
        ends = [tuple(int(value) for value in point.round()) for point in (centre, ahead)]
        cv2.line(picture, ends[0], ends[1], colour, 1, cv2.LINE_AA)


@torch.inference_mode()
def arm_panel(module: DetectorTraining, frames: DriveFrames, index: int, pose: Tensor) -> Picture:
    """Draw what an arm sees and finds in one frame, (U, V, 3)."""
    given = frames.frames
    grid = BEVGrid(module.grid.x, module.grid.z, CELL)
    image = given.image[index : index + 1].float() / 255
    intrinsics, extrinsics = given.intrinsics[index : index + 1], Extrinsics.unstack(pose[None])
    view, _ = BEVWarp(grid)(image, intrinsics, extrinsics)
    boxes, score = decode_boxes(module.detector(image, intrinsics, extrinsics), module.grid)
    picture: Picture = np.ascontiguousarray((view[0] * 255).byte().permute(1, 2, 0).numpy())
    draw_boxes(picture, given.boxes[index][given.seen[index]], grid, TRUE)
    draw_boxes(picture, boxes[0][score[0] > SHOWN_SCORE], grid, FOUND)
    label = NAMES[module.arm].split(",")[0]
    cv2.putText(picture, label, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 0), 1, cv2.LINE_AA)
    return picture


def side_by_side(image: Picture, panels: Sequence[Picture]) -> Picture:
    """Put an image (H, W, 3), at the panels' height, left of the panels."""
    height = panels[0].shape[0]
    size = (round(image.shape[1] * height / image.shape[0]), height)
    resized: Picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.concatenate([resized, *panels], axis=1)


def write_film(experiment: Experiment, seed: int, path: Path, frames: int) -> None:
    """Write the first frames of the test drives, as all arms of a seed see them."""
    test = DriveFrames(experiment.test, experiment.grid, experiment.drives)
    modules = [trained_arm(experiment, arm, seed) for arm in experiment.arms]
    poses = [test_poses(experiment, module, test) for module in modules]
    with VideoWriter(path, Fraction(experiment.fps).limit_denominator(1000)) as film:
        for index in range(min(frames, len(test))):
            image = np.ascontiguousarray(test.frames.image[index].permute(1, 2, 0).numpy())
            panels = [
                arm_panel(module, test, index, own[index]) for module, own in zip(modules, poses, strict=True)
            ]
            film.write(side_by_side(image, panels))


@one_line_errors()
def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    parser = experiment_parser(str(__doc__), "python -m train.detector.video")
    parser.add_argument("--film", type=Path, required=True, help="MP4 file")
    parser.add_argument("--film_seed", type=int, default=1, help="seed of the arms that are shown")
    parser.add_argument("--film_frames", type=PositiveInt, default=200)
    given = parser.parse_args(args)
    write_film(experiment_of(given), given.film_seed, given.film, given.film_frames)


if __name__ == "__main__":
    main()
