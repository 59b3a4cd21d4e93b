"""``python -m train fit --config configs/default.yaml``; also ``validate``, ``test`` and ``predict``.

``predict`` writes each frame's classes as a PNG, 0 where there is no boundary, into the run's folder.
"""

import pickle
import sys
from pathlib import Path

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import BasePredictionWriter
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.utilities import rank_zero_warn
from PIL import Image
from torch import Tensor

import train.datasets
import train.end_to_end
import train.module
import train.poses  # noqa: F401  for the class paths of the configs
from lanebev.report.overlay import BOUNDARY_COLOURS
from train.export import checkpoint_weights


class ClassWriter(BasePredictionWriter):
    """Writes each frame's classes as an indexed PNG, numbered in the order of the data and by process."""

    def __init__(self) -> None:
        super().__init__(write_interval="batch")
        self.count = 0

    def write_on_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, prediction: Tensor, *_: object
    ) -> None:
        """Write (B, 1+L, h, w) probabilities."""
        folder = Path(trainer.log_dir or trainer.default_root_dir) / "predictions"
        folder.mkdir(parents=True, exist_ok=True)
        process = f"{trainer.global_rank}-" if trainer.world_size > 1 else ""
        for classes in prediction.argmax(1).byte().cpu().numpy():
            image = Image.fromarray(classes, "P")
            image.putpalette(sum(BOUNDARY_COLOURS, (0, 0, 0)))
            image.save(folder / f"{process}{self.count:06d}.png")
            self.count += 1


class CommandLine(LightningCLI):
    """Lightning's command line, which also finds the last checkpoint and warns of slow settings."""

    def before_instantiate_classes(self) -> None:
        """Let ``--ckpt_path last`` find the newest checkpoint in the run's folder, of any version."""
        config = self.config[str(self.subcommand)]
        if self.subcommand == "predict":
            config.return_predictions = False  # they are written
        if config.get("ckpt_path") not in (None, "last", "best", "hpc"):
            checkpoint_weights(Path(config.ckpt_path))  # says what is wrong with it
        logger = config.trainer.logger
        if config.get("ckpt_path") != "last" or not hasattr(logger, "init_args"):  # without one, Lightning's
            return
        folder = Path(logger.init_args.save_dir) / logger.init_args.name
        found = sorted(folder.glob("version_*/checkpoints/last.ckpt"), key=lambda path: path.stat().st_mtime)
        if not found:
            self.parser.error(
                f"ckpt_path: expected a last.ckpt of a run in {folder}/version_*/checkpoints, got none; "
                "give its path, or leave ckpt_path out to begin"
            )
        config.ckpt_path = str(found[-1])

    def before_fit(self) -> None:
        """Raise if training would never end; warn of bfloat16 on a CPU that only emulates it.

        That takes ten times as long as float32.
        """
        limits = self.config[str(self.subcommand)].trainer
        counted = isinstance(limits.limit_train_batches, int) or limits.overfit_batches or limits.fast_dev_run
        has_end = counted or limits.max_time is not None
        if not has_end and limits.max_steps == -1 and limits.max_epochs not in (-1, 0):  # -1: without end
            raise ValueError(
                "max_steps: expected a number of steps, since an epoch of random views never ends, got -1; "
                "give --trainer.max_steps, or --trainer.limit_train_batches, the steps of an epoch"
            )
        on_cpu = isinstance(self.trainer.accelerator, CPUAccelerator)
        half = on_cpu and self.trainer.precision.startswith("bf16")
        if half and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
            rank_zero_warn(
                f"precision: expected one that this CPU has, got {self.trainer.precision}, which it emulates "
                "some ten times slower than float32; add --trainer.precision 32-true"
            )


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    torch.set_float32_matmul_precision("high")
    try:
        CommandLine(
            seed_everything_default=0,
            args=args,
            save_config_kwargs={"overwrite": True},
            trainer_defaults={"callbacks": [ClassWriter()]},
        )
    except (
        ValueError,
        OSError,
        ImportError,
        MisconfigurationException,
    ) as error:  # the last two also of an accelerator, or its library, that is not there
        cause: BaseException = error
        while "\n" in str(cause) and cause.__cause__ is not None:  # the parser wraps what constructors raise
            cause = cause.__cause__
        said = str(cause)
        if "Original Traceback" in said:  # of a loader's worker: its last line says what
            said = said.rstrip().splitlines()[-1].partition(": ")[2]
        print(f"error: {said}", file=sys.stderr)
        sys.exit(2)
    except (pickle.UnpicklingError, EOFError):  # of Lightning's own look at ckpt_path
        print("error: ckpt_path: expected a checkpoint, got a file of another kind", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
