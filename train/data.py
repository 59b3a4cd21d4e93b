"""Batches of views: from a pool on disk, or rendered during training."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import lightning as L
import numpy as np
import torch
from jsonargparse.typing import PositiveInt
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from lanebev.render import render_views
from train.labels import LabelledImage, LabelledView, ViewConfig, full_view, random_view
from train.pool import Pose, camera_poses, labelled_images, read_shard, shard_size


class Batch(NamedTuple):
    """Images and their labels.

    Attributes:
        image: (B, 3, H, W) uint8 RGB.
        target: (B, L, h, w) uint8, 0..255.
        weight: (B, h, w) uint8, 0 or 1.
    """

    image: Tensor
    target: Tensor
    weight: Tensor

    @classmethod
    def stack(cls, views: list[LabelledView]) -> Batch:
        """Stack views of one size."""
        return cls(*(torch.from_numpy(np.stack(field)) for field in zip(*views, strict=True)))


Seed = tuple[int, ...]
"""Of a stream: the run's seed, the process's rank and the worker's number."""

Posed = tuple[LabelledImage, Pose]


class Frames(Protocol):
    """A source of labelled images."""

    def __call__(self, seed: Seed, first: int = 0) -> Iterator[LabelledImage]:
        """Yield frames without end, in an order that the seed decides, from the ``first``-th on."""
        ...


class PoolFrames:
    """Frames of a pool in random order, a few shards at a time. Added shards come with the next round."""

    def __init__(self, folder: str | Path, resident: int = 12) -> None:
        self.folder, self.resident = Path(folder), resident

    def paths(self) -> list[Path]:
        """Return the shards present now."""
        paths = sorted(self.folder.glob("*.npz"))
        if not paths:
            raise ValueError(
                f"{self.folder}: expected pool shards *.npz, found none; "
                f"render some with: python -m train.pool {self.folder}"
            )
        return paths

    def posed(self, seed: Seed, first: int = 0) -> Iterator[Posed]:
        """Yield without end a shuffled mix over ``resident`` shards, each seen once, then the next ones."""
        rng = np.random.default_rng(seed)
        while True:
            paths = rng.permutation(np.array(self.paths()))
            for start in range(0, len(paths), self.resident):
                some = paths[start : start + self.resident]
                order = [(s, i) for s, path in enumerate(some) for i in range(shard_size(path))]
                rng.shuffle(order)
                if first < len(order):
                    shards = [read_shard(path) for path in some]
                    yield from ((shards[s].frame(i), shards[s].pose(i)) for s, i in order[first:])
                first = max(0, first - len(order))

    def __call__(self, seed: Seed, first: int = 0) -> Iterator[LabelledImage]:
        """Yield the images alone."""
        return (image for image, _ in self.posed(seed, first))


class LiveFrames:
    """Frames rendered on demand, ``batch`` at once."""

    def __init__(self, size: tuple[int, int] = (360, 640), batch: int = 4) -> None:
        self.size, self.batch = size, batch

    def posed(self, seed: Seed, first: int = 0) -> Iterator[Posed]:
        """Yield frames without end; the same seed gives the same frames."""
        for block in itertools.count(first // self.batch):
            number = int(np.random.default_rng((*seed, block)).integers(2**62))
            rendered = render_views(self.batch, self.size, torch.Generator().manual_seed(number))
            poses = camera_poses([rendered])
            for i, image in enumerate(labelled_images(rendered)):
                if block * self.batch + i >= first:
                    yield image, Pose(*(field[i] for field in poses))

    def __call__(self, seed: Seed, first: int = 0) -> Iterator[LabelledImage]:
        """Yield the images alone."""
        return (image for image, _ in self.posed(seed, first))


@dataclass(eq=False)
class ViewBatches(IterableDataset[Batch]):
    """Endless batches of random views, each batch of one size.

    Args:
        frames: frames of which views are drawn; each is used once.
        batch_size: views per batch.
        sizes: (height, width) of the views; one is drawn for each batch.
        view: how views are drawn.
        seed: together with the worker's number, decides everything.
        first: batches that an interrupted run had; this one has those that would have followed.
    """

    frames: Frames
    batch_size: int
    sizes: list[tuple[int, int]]
    view: ViewConfig
    seed: Seed
    first: int = 0

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches."""
        worker = get_worker_info()
        if worker is not None:
            torch.set_num_threads(1)
        count, number = (1, self.first) if worker is None else (worker.num_workers, self.first + worker.id)
        seed, done = (*self.seed, number % count), number // count  # batches come from the workers in turn
        frames = self.frames(seed, done * self.batch_size)
        for batch in itertools.count(done):
            rng = np.random.default_rng((*seed, batch))
            height, width = self.sizes[rng.integers(len(self.sizes))]
            yield Batch.stack(
                [random_view(next(frames), (height, width), self.view, rng) for _ in range(self.batch_size)]
            )


@dataclass(eq=False)
class FullBatches(IterableDataset[Batch]):
    """A fixed number of whole frames, the same every time."""

    frames: Frames
    batch_size: int
    size: tuple[int, int]
    view: ViewConfig
    seed: int
    batches: int

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches."""
        frames = self.frames((self.seed,))
        for _ in range(self.batches):
            yield Batch.stack([full_view(next(frames), self.size, self.view) for _ in range(self.batch_size)])


def run_position(module: L.LightningDataModule) -> tuple[int, int]:
    """Rank of this process, and batches that the run had before it was interrupted."""
    trainer = module.trainer
    if trainer is None:
        return 0, 0
    return trainer.global_rank, trainer.global_step * trainer.accumulate_grad_batches


class RenderedRoads(L.LightningDataModule):
    """Rendered roads, from a pool where one is given, else rendered in the workers.

    Args:
        pool: folder of shards for training (``python -m train.pool``), or None to render live.
        val_pool: folder of held-out shards, or None to render live with another seed.
        batch_size: views per batch.
        sizes: (height, width) choices of training views; repeat one to have it more often.
        val_size: (height, width) of whole frames in validation.
        val_batches: number of validation batches of ``batch_size`` frames.
        render_size: (height, width) of live renders.
        view: how views are drawn.
        seed: seed of the views; validation uses another stream.
        workers: processes that draw, and render where there is no pool.
    """

    def __init__(
        self,
        pool: str | None = None,
        val_pool: str | None = None,
        batch_size: PositiveInt = 16,
        sizes: list[tuple[PositiveInt, PositiveInt]] | None = None,
        val_size: tuple[PositiveInt, PositiveInt] = (192, 320),
        val_batches: PositiveInt = 8,
        render_size: tuple[PositiveInt, PositiveInt] = (360, 640),
        view: ViewConfig | None = None,
        seed: int = 0,
        workers: int = 1,
    ) -> None:
        super().__init__()
        self.pool, self.val_pool, self.batch_size = pool, val_pool, batch_size
        self.sizes = sizes or [(128, 320), (128, 320), (128, 320), (160, 288), (192, 320)]
        self.val_size, self.val_batches, self.render_size = val_size, val_batches, render_size
        self.view, self.seed, self.workers = view or ViewConfig(), seed, workers

    def _frames(self, pool: str | None) -> PoolFrames | LiveFrames:
        return LiveFrames(self.render_size) if pool is None else PoolFrames(pool)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return endless training batches."""
        rank, first = run_position(self)
        frames, seed = self._frames(self.pool), (self.seed, rank)
        data = ViewBatches(frames, self.batch_size, self.sizes, self.view, seed, first)
        return DataLoader(
            data, batch_size=None, num_workers=self.workers, prefetch_factor=4 if self.workers else None
        )

    def val_dataloader(self) -> DataLoader[Batch]:
        """Return held-out frames."""
        frames = self._frames(self.val_pool)
        data = FullBatches(
            frames, self.batch_size, self.val_size, self.view, self.seed + 7_919, self.val_batches
        )
        return DataLoader(data, batch_size=None)

    test_dataloader = val_dataloader
    predict_dataloader = val_dataloader
