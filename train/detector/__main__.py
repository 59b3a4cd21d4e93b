"""The experiment: ``python -m train.detector --config configs/detector.yaml``.

Trains and tests a detector with the poses of each arm (:func:`train.detector.module.arm_poses`) and seed.
Arms that were tested are not trained again, and an interrupted training goes on from its last checkpoint.
The folder ``out`` has a JSON file of each result; ``python -m train.detector.table`` shows them.
"""

import json
import time
from dataclasses import asdict
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader

from lanebev.io.output.whole_file import whole_file
from train.commands import one_line_errors
from train.detector.arms import begun_checkpoint, checkpoint_step, test_poses
from train.detector.frames import DriveFrames, StepBatches
from train.detector.module import DetectorTraining
from train.detector.precision import Centres, score_range
from train.detector.predict import find_vehicles, offset_poses, pose_rmse, true_centres
from train.detector.settings import ARMS, Arm, Experiment, experiment_of, experiment_parser

RANGES = ((5.0, 53.0), (5.0, 20.0), (20.0, 35.0), (35.0, 53.0))
"""m ahead; the first is all of it."""


def train_arm(experiment: Experiment, arm: Arm, seed: int, frames: DriveFrames) -> DetectorTraining:
    """Train an arm, or go on with it from its last checkpoint; "tuned" continues "online"."""
    L.seed_everything(seed, verbose=False)
    module, steps = DetectorTraining(experiment, arm, seed), int(experiment.steps)
    last = begun_checkpoint(experiment, arm, seed)
    begin = 0 if last is None else checkpoint_step(last)
    batches = StepBatches(len(frames), experiment.batch_size, steps, seed, begin)
    keep = ModelCheckpoint(
        experiment.out / f"{arm}-{seed}",
        "{step}",
        every_n_train_steps=int(experiment.tuned_steps),
        save_top_k=-1,
        save_last=True,
    )
    trainer = L.Trainer(
        max_steps=steps,
        precision=experiment.precision,  # type: ignore[arg-type]  # Lightning checks it
        accelerator=experiment.accelerator,
        devices=1,
        logger=False,
        callbacks=[keep],
        use_distributed_sampler=False,
        gradient_clip_val=5.0,
        enable_model_summary=False,
        enable_progress_bar=False,
    )
    trainer.fit(
        module,
        DataLoader(frames, batch_sampler=batches, collate_fn=lambda frames: frames),
        ckpt_path=None if last is None else str(last),
        weights_only=None if last is None else False,
    )
    return module.eval().cpu()


def scores(found: Centres, truth: Centres) -> list[dict[str, Any]]:
    """Compute the scores by range."""
    return [{"range": span, **score_range(found, truth, *span)._asdict()} for span in RANGES]


def evaluate_arm(experiment: Experiment, module: DetectorTraining, frames: DriveFrames) -> dict[str, Any]:
    """Test an arm; "true" also with poses that are off by known angles."""
    poses = test_poses(experiment, module, frames)
    offsets = offset_poses(poses) if module.arm == "true" else {}
    truth = true_centres(frames.frames)
    exact, *off = find_vehicles(module.detector, frames.frames, [poses, *offsets.values()])
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
            module = train_arm(experiment, arm, seed, train)
            result = {"seed": seed, **evaluate_arm(experiment, module, test)}
            result |= {"train_frames": len(train), "seconds": round(time.perf_counter() - begun)}
            result["settings"] = {name: str(value) for name, value in asdict(experiment).items()}
            with whole_file(path) as whole:
                whole.write_text(json.dumps(result, indent=1))
            ap = result["scores"][0]["precision"]
            print(f"{arm} seed {seed}: AP {ap}, {result['seconds']} s", flush=True)


@one_line_errors()
def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    given = experiment_parser(str(__doc__), "python -m train.detector").parse_args(args)
    run(experiment_of(given))


if __name__ == "__main__":
    main()
