"""An arm of the experiment: its checkpoints, the trained arm, and the poses that it tests with."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from train.detector.drives import WARM_UP, calibrate_online
from train.detector.frames import DriveFrames
from train.detector.module import DetectorTraining, arm_poses
from train.detector.settings import Arm, Experiment


def checkpoint_weights(path: Path) -> dict[str, Any]:
    """Return the weights of a checkpoint."""
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
    return state


def checkpoint_step(path: Path) -> int:
    """Return the number of steps that a checkpoint has done."""
    return int(torch.load(path, map_location="cpu", weights_only=True)["global_step"])


def begun_checkpoint(experiment: Experiment, arm: Arm, seed: int) -> Path | None:
    """Return the checkpoint that the training of an arm continues: its last, or that of "online"; or None."""
    last = experiment.out / f"{arm}-{seed}" / "last.ckpt"
    if last.exists() or arm != "tuned":
        return last if last.exists() else None
    path = experiment.out / f"online-{seed}" / f"step={experiment.steps - experiment.tuned_steps}.ckpt"
    if not path.exists():
        raise ValueError(f"arms: expected 'online' before 'tuned', got no {path}")
    return path


def trained_arm(experiment: Experiment, arm: Arm, seed: int) -> DetectorTraining:
    """Load an arm as it was at the end of its training."""
    last = experiment.out / f"{arm}-{seed}" / "last.ckpt"
    if not last.exists():
        raise ValueError(f"{arm}-{seed}: expected a trained arm, got no {last}; run python -m train.detector")
    module = DetectorTraining(experiment, arm, seed)
    module.load_state_dict(checkpoint_weights(last))
    return module.eval()


def test_poses(experiment: Experiment, module: DetectorTraining, frames: DriveFrames) -> Tensor:
    """Return the poses (N, 4) that an arm tests with; a trained lane network estimates its own, online."""
    if module.lanes is None:
        return arm_poses(module.arm, frames.frames)
    followed = [calibrate_online(record, module.lanes, experiment.fps)[0] for record in frames.records]
    return torch.cat([poses[WARM_UP:] for poses in followed]).to(frames.frames.extrinsics.dtype)
