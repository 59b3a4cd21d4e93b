"""Settings of the experiment, as a class and as a command line."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal, get_args

from jsonargparse import ArgumentParser, Namespace
from jsonargparse.typing import PositiveFloat, PositiveInt

from lanebev.view.grid import BEVGrid
from train.detector.drives import GRID

Arm = Literal["nominal", "noisy", "online", "tuned", "true"]
ARMS: tuple[Arm, ...] = get_args(Arm)


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
        learning_rate: the detector's largest, see :func:`train.detector.module.one_cycle`.
        lane_rate: the lane network's largest, of a cycle of its own over the ``tuned_steps``.
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
