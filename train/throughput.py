"""Print and store how a training uses its time."""

import csv
import time
from pathlib import Path
from typing import Any

import lightning as L
import torch

from train.budget import used_share
from train.data import Batch
from train.live import LiveRoads
from train.stopwatch import Stopwatch


class Throughput(L.Callback):
    """Prints views, views per second, and the shares of rendering, labelling and training.

    They are rows of ``throughput.csv`` in the run's folder too.

    Args:
        every: seconds between rows; the only times at which the run waits for its device.
    """

    def __init__(self, every: float = 20.0) -> None:
        self.every = every
        self.views = 0
        self._last = (0.0, 0)  # time and views of the last row
        self._watch: Stopwatch | None = None
        self._open: Any = None

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Begin to count."""
        self._watch = Stopwatch(module.device)
        self._last = (time.perf_counter(), self.views)

    def on_train_batch_start(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Begin to time the step."""
        if self._watch is not None:
            self._open = self._watch.time("training")
            self._open.__enter__()

    def on_train_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        """End timing, and write a row where it is time."""
        if self._open is not None:
            self._open.__exit__(None, None, None)
        self.views += len(batch.image)
        if time.perf_counter() - self._last[0] >= self.every:
            self._write(trainer, module, batch)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Write the last row."""
        if self.views > self._last[1]:
            self._write(trainer, module)

    def state_dict(self) -> dict[str, Any]:
        """Return the number of views, which the exported weights state."""
        return {"views": self.views}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue the counts."""
        self.views = state_dict["views"]

    def _write(self, trainer: L.Trainer, module: L.LightningModule, batch: Batch | None = None) -> None:
        seconds = {} if self._watch is None else self._watch.read()
        batches = trainer.datamodule.batches if isinstance(trainer.datamodule, LiveRoads) else None  # type: ignore[attr-defined]
        if batches is not None:
            seconds |= batches.watch.read()
        now = time.perf_counter()
        row: dict[str, float | int | str] = {
            "step": trainer.global_step,
            "used": round(used_share(trainer), 4),
            "views": self.views,
            "views_per_s": round((self.views - self._last[1]) / (now - self._last[0]), 1),
            "rate": float(trainer.optimizers[0].param_groups[0]["lr"]),
            **{name: round(seconds.get(name, 0.0) / (now - self._last[0]), 3) for name in _PARTS},
            "loss": round(float(trainer.callback_metrics.get("loss/pixels", torch.tensor(0.0))), 5),
            "size": "" if batch is None else "{}x{}x{}".format(len(batch.image), *batch.image.shape[-2:]),
            "memory_gib": round(_peak_memory(module.device), 1),
        }
        self._last = (now, self.views)
        print(" ".join(f"{name} {value}" for name, value in row.items()), flush=True)
        path = Path(trainer.log_dir or trainer.default_root_dir) / "throughput.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if new:
                writer.writeheader()
            writer.writerow(row)


_PARTS = ("rendering", "labelling", "training")


def _peak_memory(device: torch.device) -> float:
    """Return the peak memory, GiB."""
    return torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else 0.0
