"""Batches of views: from a pool on disk, or rendered as training goes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

import lightning as L
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from lanebev.render import render_views
from train.labels import LabelledImage, LabelledView, ViewConfig, full_view, random_view
from train.pool import Shard, labelled_images, read_shard


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
        """Views of one size."""
        return cls(*(torch.from_numpy(np.stack(field)) for field in zip(*views, strict=True)))


class Frames(Protocol):
    """A source of labelled images."""

    def __call__(self, rng: np.random.Generator) -> Iterator[LabelledImage]:
        """Endless, in an order that the generator decides."""
        ...


class PoolFrames:
    """Frames of a pool that may still be growing, in random order, a few shards at a time."""

    def __init__(self, folder: str | Path, pattern: str = "*.npz", resident: int = 12) -> None:
        self.folder, self.pattern, self.resident = Path(folder), pattern, resident

    def paths(self) -> list[Path]:
        """Shards present now.

        Raises:
            ValueError: there are none.
        """
        paths = sorted(self.folder.glob(self.pattern))
        if not paths:
            raise ValueError(
                f"{self.folder}: expected pool shards {self.pattern}, found none; "
                f"render some with: python -m train.pool {self.folder}"
            )
        return paths

    def __call__(self, rng: np.random.Generator) -> Iterator[LabelledImage]:
        """Endless: a shuffled mix over ``resident`` shards, each seen once, then the next ones."""
        while True:
            paths = [path for path in rng.permutation(np.array(self.paths()))][: self.resident]
            shards: list[Shard] = [read_shard(path) for path in paths]
            order = [(s, i) for s, shard in enumerate(shards) for i in range(len(shard))]
            rng.shuffle(order)
            for s, i in order:
                yield shards[s].frame(i)


class LiveFrames:
    """Frames rendered on demand."""

    def __init__(self, size: tuple[int, int] = (360, 640), batch: int = 4) -> None:
        self.size, self.batch = size, batch

    def __call__(self, rng: np.random.Generator) -> Iterator[LabelledImage]:
        """Endless; the same generator gives the same frames."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        while True:
            yield from labelled_images(render_views(self.batch, self.size, generator))


class ViewBatches(IterableDataset[Batch]):
    """Endless batches of random views, each batch of one size.

    Args:
        frames: of which views are drawn; each is used once.
        batch_size: views per batch.
        sizes: (height, width) of the views; one is drawn for each batch.
        view: how views are drawn.
        seed: with the worker's number, decides everything.
    """

    def __init__(
        self,
        frames: Frames,
        batch_size: int,
        sizes: list[tuple[int, int]],
        view: ViewConfig,
        seed: int,
    ) -> None:
        super().__init__()
        self.frames, self.batch_size, self.sizes, self.view, self.seed = frames, batch_size, sizes, view, seed

    def __iter__(self) -> Iterator[Batch]:
        """Draw."""
        torch.set_num_threads(1)
        worker = get_worker_info()
        rng = np.random.default_rng((self.seed, 0 if worker is None else worker.id))
        frames = self.frames(rng)
        while True:
            size = tuple(self.sizes[rng.integers(len(self.sizes))])
            yield Batch.stack(
                [random_view(next(frames), size, self.view, rng) for _ in range(self.batch_size)]
            )


class FullBatches(IterableDataset[Batch]):
    """A fixed number of whole frames, the same every time."""

    def __init__(
        self,
        frames: Frames,
        batch_size: int,
        size: tuple[int, int],
        view: ViewConfig,
        seed: int,
        batches: int,
    ) -> None:
        super().__init__()
        self.frames, self.batch_size, self.size = frames, batch_size, size
        self.view, self.seed, self.batches = view, seed, batches

    def __iter__(self) -> Iterator[Batch]:
        """Draw."""
        frames = self.frames(np.random.default_rng(self.seed))
        for _ in range(self.batches):
            yield Batch.stack([full_view(next(frames), self.size, self.view) for _ in range(self.batch_size)])


class RenderedRoads(L.LightningDataModule):
    """Rendered roads, from a pool where one is given, else rendered in the workers.

    Args:
        pool: folder of shards for training (``python -m train.pool``), or None to render live.
        val_pool: folder of held-out shards, or None to render live with another seed.
        batch_size: views per batch.
        sizes: (height, width) choices of training views; repeat one to have it more often.
        val_size: (height, width) of whole frames in validation.
        val_batches: of ``batch_size`` frames.
        render_size: (height, width) of live renders.
        view: how views are drawn.
        seed: of the views; validation uses another stream.
        workers: processes that draw, and render where there is no pool.
    """

    def __init__(
        self,
        pool: str | None = None,
        val_pool: str | None = None,
        batch_size: int = 16,
        sizes: list[tuple[int, int]] | None = None,
        val_size: tuple[int, int] = (192, 320),
        val_batches: int = 8,
        render_size: tuple[int, int] = (360, 640),
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
        """Endless."""
        data = ViewBatches(self._frames(self.pool), self.batch_size, self.sizes, self.view, self.seed)
        return DataLoader(
            data, batch_size=None, num_workers=self.workers, prefetch_factor=4 if self.workers else None
        )

    def val_dataloader(self) -> DataLoader[Batch]:
        """Held-out frames."""
        frames = self._frames(self.val_pool)
        data = FullBatches(
            frames, self.batch_size, self.val_size, self.view, self.seed + 7_919, self.val_batches
        )
        return DataLoader(data, batch_size=None)

    test_dataloader = val_dataloader
    predict_dataloader = val_dataloader
