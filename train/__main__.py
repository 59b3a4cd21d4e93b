"""``python -m train fit --config configs/default.yaml``; also ``validate``, ``test`` and ``predict``."""

from __future__ import annotations

import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.utilities import rank_zero_warn

import train.datasets
import train.end_to_end
import train.module
import train.poses  # noqa: F401  for the class paths of the configs


class CommandLine(LightningCLI):
    """Lightning's, with a word before hours are lost."""

    def before_fit(self) -> None:
        """bfloat16 that a CPU only emulates takes ten times as long as float32."""
        on_cpu = isinstance(self.trainer.accelerator, CPUAccelerator)
        native = torch.ops.mkldnn._is_mkldnn_bf16_supported()
        if on_cpu and self.trainer.precision.startswith("bf16") and not native:
            rank_zero_warn(
                f"precision: expected one that this CPU has, got {self.trainer.precision}, which it emulates "
                "some ten times slower than float32; add --trainer.precision 32-true"
            )


def main(args: list[str] | None = None) -> None:
    """Command line."""
    torch.set_float32_matmul_precision("high")
    CommandLine(seed_everything_default=0, args=args, save_config_kwargs={"overwrite": True})


if __name__ == "__main__":
    main()
