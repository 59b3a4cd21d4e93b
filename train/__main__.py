"""``python -m train fit --config configs/default.yaml``; also ``validate``, ``test`` and ``predict``."""

from __future__ import annotations

import torch
from lightning.pytorch.cli import LightningCLI

import train.datasets
import train.end_to_end
import train.module
import train.poses  # noqa: F401  for the class paths of the configs


def main(args: list[str] | None = None) -> None:
    """Command line."""
    torch.set_float32_matmul_precision("high")
    LightningCLI(seed_everything_default=0, args=args, save_config_kwargs={"overwrite": True})


if __name__ == "__main__":
    main()
