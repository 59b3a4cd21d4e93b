"""The experiment: ``python -m train.detector --config configs/detector.yaml``.

Trains and tests a detector with the poses of each arm (:func:`train.detector.module.arm_poses`) and seed.
What was tested is not trained again, and an interrupted training goes on from its last checkpoint. Results
are one JSON file each in the folder ``out``; ``python -m train.detector.table`` shows them.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader

from train.commands import one_line_errors
from train.detector.experiment import (
    Experiment,
    checkpoint_weights,
    experiment_of,
    experiment_parser,
    new_module,
    test_poses,
)
from train.detector.frames import DriveFrames
from train.detector.module import ARMS, Arm, DetectorTraining
from train.detector.precision import Centres, score_range
from train.detector.predict import find, offset_poses, pose_rmse, true_centres

RANGES = ((5.0, 53.0), (5.0, 20.0), (20.0, 35.0), (35.0, 53.0))
"""m ahead; the first is all of it."""


def trained(experiment: Experiment, arm: Arm, seed: int, frames: DriveFrames) -> DetectorTraining:
    """Train an arm, or go on with it from its last checkpoint.

    Raises:
        ValueError: "tuned" before "online".
    """
    L.seed_everything(seed, verbose=False)
    module, folder = new_module(experiment, arm), experiment.out / f"{arm}-{seed}"
    steps, batch = int(experiment.steps), experiment.batch_size
    if arm == "tuned":
        steps, batch = int(experiment.tuned_steps), experiment.tuned_batch_size
        begin = experiment.out / f"online-{seed}" / f"step={experiment.steps - steps}.ckpt"
        if not begin.exists():
            raise ValueError(f"arms: expected 'online' before 'tuned', got no {begin}")
        module.load_state_dict(checkpoint_weights(begin), strict=False)
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


def scores(found: Centres, truth: Centres) -> list[dict[str, Any]]:
    """Compute the scores by range."""
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
    """Run the command line."""
    given = experiment_parser(str(__doc__), "python -m train.detector").parse_args(args)
    run(experiment_of(given))


if __name__ == "__main__":
    main()
