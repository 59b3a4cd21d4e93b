"""The experiment: ``python -m train.detector --config configs/detector.yaml``.

Trains and tests a detector with the poses of each arm (:func:`train.detector.module.arm_poses`) and seed.
What was tested is not trained again, and an interrupted training goes on from its last checkpoint. Results
are one JSON file each in the folder ``out``; ``python -m train.detector.table`` shows them.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import lightning as L
import torch
from jsonargparse import ArgumentParser
from jsonargparse.typing import PositiveFloat, PositiveInt
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor
from torch.utils.data import DataLoader

from lanebev.view.grid import BEVGrid
from train.commands import one_line_errors
from train.detector.drives import GRID, WARM_UP, calibrate_online
from train.detector.frames import DriveFrames
from train.detector.module import ARMS, Arm, DetectorTraining, arm_poses
from train.detector.precision import Centres, score_range
from train.detector.predict import find, offset_poses, pose_rmse, true_centres

RANGES = ((5.0, 53.0), (5.0, 20.0), (20.0, 35.0), (35.0, 53.0))
"""m ahead; the first is all of it."""


@dataclass(frozen=True)
class Experiment:
    """Settings.

    Attributes:
        train: folder of drives to train on.
        test: folder of drives to test on.
        out: folder of checkpoints and results.
        arms: of :data:`ARMS`; "tuned" begins with what "online" was ``tuned_steps`` before its end.
        seeds: of each arm.
        steps: of each training.
        tuned_steps: the last steps of "tuned", through the lane network.
        batch_size: frames a step.
        tuned_batch_size: likewise through the lane network.
        learning_rate: largest.
        tuned_rate: largest of the last steps of "tuned".
        lane_rate: the lane network's, as a share of it.
        width: channels of the image features.
        bev_width: channels of the bird's-eye features.
        top: px of the image above which nothing is looked at.
        grid: of the bird's-eye view.
        network_width: px of the lane network's input, as the drives were rendered with.
        fps: frames a second of the drives.
        precision: of Lightning's trainer.
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
    tuned_batch_size: PositiveInt = 4
    learning_rate: PositiveFloat = 3e-3
    tuned_rate: PositiveFloat = 1e-3
    lane_rate: PositiveFloat = 0.01
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
        if self.tuned_steps >= self.steps:
            raise ValueError(f"tuned_steps: expected fewer than steps {self.steps}, got {self.tuned_steps}")


def new_module(experiment: Experiment, arm: Arm) -> DetectorTraining:
    """Build what an arm trains."""
    tuned = arm == "tuned"
    return DetectorTraining(
        arm,
        experiment.grid,
        experiment.width,
        experiment.bev_width,
        experiment.top,
        experiment.tuned_rate if tuned else experiment.learning_rate,
        experiment.lane_rate,
        experiment.network_width,
        experiment.fps,
    )


def trained(experiment: Experiment, arm: Arm, seed: int, frames: DriveFrames) -> DetectorTraining:
    """Train an arm, or go on with it from its last checkpoint.

    Raises:
        ValueError: "tuned" before "online".
    """
    L.seed_everything(seed, verbose=False)
    module, folder = new_module(experiment, arm), experiment.out / f"{arm}-{seed}"
    steps, batch = experiment.steps, experiment.batch_size
    if arm == "tuned":
        steps, batch = experiment.tuned_steps, experiment.tuned_batch_size
        begin = experiment.out / f"online-{seed}" / f"step={experiment.steps - steps}.ckpt"
        if not begin.exists():
            raise ValueError(f"arms: expected 'online' before 'tuned', got no {begin}")
        module.load_state_dict(_weights(begin), strict=False)
    every = max(1, min(experiment.tuned_steps, steps))
    keep = ModelCheckpoint(folder, "{step}", every_n_train_steps=every, save_top_k=-1, save_last=True)
    trainer = L.Trainer(
        max_steps=steps,
        precision=experiment.precision,  # type: ignore[arg-type]  # Lightning checks it
        accelerator=experiment.accelerator,
        devices=1,
        logger=False,
        callbacks=[keep],
        gradient_clip_val=5.0,
        enable_model_summary=False,
        enable_progress_bar=False,
    )
    order = torch.Generator().manual_seed(seed)
    loader = DataLoader(
        frames, batch, shuffle=True, drop_last=True, generator=order, collate_fn=lambda frames: frames
    )
    last = folder / "last.ckpt"
    trainer.fit(
        module,
        loader,
        ckpt_path=str(last) if last.exists() else None,
        weights_only=False if last.exists() else None,
    )
    return module.eval().cpu()


def _weights(path: Path) -> dict[str, Any]:
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=False)["state_dict"]
    return state


def test_poses(experiment: Experiment, module: DetectorTraining, frames: DriveFrames) -> Tensor:
    """Poses (N, 4) that an arm tests with; those of a trained lane network are found anew, online."""
    if module.lanes is None:
        return arm_poses(module.arm, frames.frames)
    followed = [calibrate_online(record, module.lanes, experiment.fps)[0] for record in frames.records]
    return torch.cat([poses[WARM_UP:] for poses in followed]).to(frames.frames.extrinsics.dtype)


def scores(found: Centres, truth: Centres) -> list[dict[str, Any]]:
    """Score by range."""
    return [{"range": span, **score_range(found, truth, *span)._asdict()} for span in RANGES]


def tested(experiment: Experiment, module: DetectorTraining, frames: DriveFrames) -> dict[str, Any]:
    """Test an arm; "true" also with poses that are off by known angles."""
    poses = test_poses(experiment, module, frames)
    offsets = offset_poses(poses) if module.arm == "true" else {}
    truth = true_centres(frames.frames)
    exact, *off = find(module.detector, frames.frames, [poses, *offsets.values()])
    result: dict[str, Any] = {
        "arm": module.arm,
        "frames": len(frames),
        "pose_rmse": pose_rmse(poses, frames.frames.extrinsics),
        "scores": scores(exact, truth),
        "off": [
            {"axis": axis, "degrees": degrees, "scores": scores(each, truth)}
            for (axis, degrees), each in zip(offsets, off, strict=True)
        ],
    }
    return result


def run(experiment: Experiment) -> None:
    """Train and test what is not there yet."""
    experiment.out.mkdir(parents=True, exist_ok=True)
    train = DriveFrames(experiment.train, experiment.grid, experiment.drives)
    test = DriveFrames(experiment.test, experiment.grid, experiment.drives)
    for seed in experiment.seeds:
        for arm in sorted(experiment.arms, key=ARMS.index):
            path = experiment.out / f"{arm}-{seed}.json"
            if path.exists():
                continue
            begun = time.perf_counter()
            module = trained(experiment, arm, seed, train)
            result = {"seed": seed, **tested(experiment, module, test)}
            result |= {"train_frames": len(train), "seconds": round(time.perf_counter() - begun)}
            result["settings"] = {name: str(value) for name, value in asdict(experiment).items()}
            partial = path.with_suffix(".part")
            partial.write_text(json.dumps(result, indent=1))
            os.replace(partial, path)
            ap = result["scores"][0]["precision"]
            print(f"{arm} seed {seed}: AP {ap}, {result['seconds']} s", flush=True)


@one_line_errors()
def main(args: list[str] | None = None) -> None:
    """Command line."""
    parser = ArgumentParser(description=__doc__, prog="python -m train.detector")
    parser.add_argument("--config", action="config", help="settings as YAML")
    parser.add_class_arguments(Experiment, None)
    given = parser.instantiate(parser.parse_args(args)).as_dict()
    given.pop("config")
    run(Experiment(**given))


if __name__ == "__main__":
    main()
