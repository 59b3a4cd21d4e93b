"""Gradient of the loss on the pose: ``python -m train.detector.gradient --config configs/detector.yaml``.

Prints how the gradient of the loss on pitch, yaw, roll and height of arm "online" agrees with their errors on
the test drives: only a gradient that has the sign of the error can lower it.
"""

import numpy as np
import torch
from scipy.stats import spearmanr
from torch import Tensor

from lanebev.types import AXES, Extrinsics
from train.commands import one_line_errors
from train.detector.arms import trained_arm
from train.detector.frames import DriveFrames
from train.detector.module import DetectorTraining
from train.detector.predict import TOGETHER
from train.detector.settings import experiment_of, experiment_parser
from train.detector.targets import detection_loss


def pose_gradients(module: DetectorTraining, frames: DriveFrames) -> Tensor:
    """Compute the gradient (N, 4) of the loss on the poses of the online calibration."""
    gradients: list[Tensor] = []
    for rows in torch.arange(len(frames)).split(TOGETHER):
        batch = frames.__getitems__(rows.tolist())
        poses = batch.online.clone().requires_grad_()
        maps = module.detector(batch.image.float() / 255, batch.intrinsics, Extrinsics.unstack(poses))
        loss = detection_loss(maps, batch.boxes, batch.seen, module.grid)
        gradients += torch.autograd.grad(loss, poses)
    return torch.cat(gradients)


def rank_correlation(first: Tensor, second: Tensor) -> list[float]:
    """Compute Spearman's rank correlation of the columns of two (N, K)."""
    columns = zip(first.T.numpy(), second.T.numpy(), strict=True)
    return [float(spearmanr(one, other).statistic) for one, other in columns]


def sign_agreement(gradient: Tensor, error: Tensor) -> list[float]:
    """Compute the fraction of equal signs in each column of (N, K), of the half with the larger errors."""
    large = error.abs() >= error.abs().median(0).values
    same = (gradient * error > 0) & large
    return [float(value) for value in same.sum(0) / large.sum(0)]


@one_line_errors()
def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    parser = experiment_parser(str(__doc__), "python -m train.detector.gradient")
    experiment = experiment_of(parser.parse_args(args))
    frames = DriveFrames(experiment.test, experiment.grid, experiment.drives)
    with_boxes = frames.frames.seen.any(1)
    error = (frames.frames.online - frames.frames.extrinsics)[with_boxes]
    rows = []
    for seed in experiment.seeds:
        gradient = pose_gradients(trained_arm(experiment, "online", seed), frames)[with_boxes]
        rows.append([rank_correlation(gradient, error), sign_agreement(gradient, error)])
    print("| | " + " | ".join(AXES) + " |")
    print("|---" * (1 + len(AXES)) + "|")
    for name, values in zip(("rank correlation", "same sign"), np.mean(rows, axis=0), strict=True):
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in values) + " |")


if __name__ == "__main__":
    main()
