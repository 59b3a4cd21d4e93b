"""Settings of the experiment, and a trained arm."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from jsonargparse import ArgumentParser, Namespace
from jsonargparse.typing import PositiveFloat, PositiveInt
from torch import Tensor

from lanebev.view.grid import BEVGrid
from train.detector.drives import GRID, WARM_UP, calibrate_online
from train.detector.frames import DriveFrames
from train.detector.module import ARMS, Arm, DetectorTraining, arm_poses


@dataclass(frozen=True)
class Experiment:
    """Settings.

    Attributes:
        train: folder of drives to train on.
        test: folder of drives to test on.
        out: folder of checkpoints and results.
        arms: names of :data:`ARMS`; "tuned" continues "online" as it was ``tuned_steps`` before its end.
        seeds: seeds of each arm.
        steps: number of steps of each training.
        tuned_steps: the last steps of "tuned", through the lane network.
        batch_size: frames a step.
        learning_rate: the detector's largest.
        lane_rate: the lane network's largest.
        width: channels of the image features.
        bev_width: channels of the bird's-eye features.
        top: px of the image above which nothing is used.
        grid: grid of the bird's-eye view.
        network_width: px of the lane network's input, as the drives were rendered with.
        fps: frames a second of the drives.
        precision: precision of Lightning's trainer.
        accelerator: likewise.
        drives: the first so many of each folder; None: all.
    """

    train: Path
    test: Path
    out: Path
    arms: tuple[Arm, ...] = ARMS
    seeds: tuple[int, ...] = (1, 2, 3)
    steps: PositiveInt = 6000
    tuned_steps: PositiveInt = 600
    batch_size: PositiveInt = 8
    learning_rate: PositiveFloat = 3e-3
    lane_rate: PositiveFloat = 1e-4
    width: PositiveInt = 32
    bev_width: PositiveInt = 48
    top: int = 96
    grid: BEVGrid = field(default_factory=lambda: GRID)
    network_width: PositiveInt | None = None
    fps: PositiveFloat = 10.0
    precision: str = "32-true"
    accelerator: str = "auto"
    drives: PositiveInt | None = None

    def __post_init__(self) -> None:
        if self.tuned_steps >= self.steps or self.steps % self.tuned_steps:
            raise ValueError(
                f"tuned_steps: expected a divisor of steps {self.steps} that is smaller, got "
                f"{self.tuned_steps}"
            )


def new_module(experiment: Experiment, arm: Arm, seed: int) -> DetectorTraining:
    """Build what an arm trains."""
    return DetectorTraining(
        arm,
        experiment.grid,
        experiment.width,
        experiment.bev_width,
        experiment.top,
        experiment.learning_rate,
        experiment.lane_rate,
        experiment.steps,
        experiment.tuned_steps,
        experiment.network_width,
        experiment.fps,
        seed,
    )


def checkpoint_weights(path: Path) -> dict[str, Any]:
    """Return the weights of a checkpoint."""
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
    return state


def checkpoint_step(path: Path) -> int:
    """Return the number of steps that a checkpoint has done."""
    return int(torch.load(path, map_location="cpu", weights_only=True)["global_step"])


def begun_checkpoint(experiment: Experiment, arm: Arm, seed: int) -> Path | None:
    """Return the checkpoint that the training of an arm continues: its last, or that of "online"; or None.

    Raises:
        ValueError: "tuned" before "online".
    """
    last = experiment.out / f"{arm}-{seed}" / "last.ckpt"
    if last.exists() or arm != "tuned":
        return last if last.exists() else None
    path = experiment.out / f"online-{seed}" / f"step={experiment.steps - experiment.tuned_steps}.ckpt"
    if not path.exists():
        raise ValueError(f"arms: expected 'online' before 'tuned', got no {path}")
    return path


def trained_arm(experiment: Experiment, arm: Arm, seed: int) -> DetectorTraining:
    """Load an arm as it was at the end of its training.

    Raises:
        ValueError: it was not trained.
    """
    last = experiment.out / f"{arm}-{seed}" / "last.ckpt"
    if not last.exists():
        raise ValueError(f"{arm}-{seed}: expected a trained arm, got no {last}; run python -m train.detector")
    module = new_module(experiment, arm, seed)
    module.load_state_dict(checkpoint_weights(last))
    return module.eval()


def test_poses(experiment: Experiment, module: DetectorTraining, frames: DriveFrames) -> Tensor:
    """Return the poses (N, 4) that an arm tests with; a trained lane network estimates its own, online."""
    if module.lanes is None:
        return arm_poses(module.arm, frames.frames)
    followed = [calibrate_online(record, module.lanes, experiment.fps)[0] for record in frames.records]
    return torch.cat([poses[WARM_UP:] for poses in followed]).to(frames.frames.extrinsics.dtype)


def experiment_parser(description: str, program: str) -> ArgumentParser:
    """Build a command line with all settings."""
    parser = ArgumentParser(description=description, prog=program)
    parser.add_argument("--config", action="config", help="settings as YAML")
    parser.add_class_arguments(Experiment, None)
    return parser


def experiment_of(given: Namespace) -> Experiment:
    """Return the settings that :func:`experiment_parser` parsed."""
    values = experiment_parser("", "").instantiate(given).as_dict()
    return Experiment(**{each.name: values[each.name] for each in fields(Experiment)})
