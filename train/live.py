"""Render views on the device that trains, in the training step's own process."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import lightning as L
import numpy as np
import torch
from jsonargparse.typing import PositiveFloat, PositiveInt
from torch.utils.data import DataLoader, IterableDataset

from lanebev import FarView
from lanebev.observation.far_view import view_sizes
from lanebev.render import WindowConfig
from lanebev.tensors import join_tensors
from train.budget import Stage, stage_at, used_share
from train.data import Batch, Seed, run_position
from train.labels import ViewConfig
from train.rendering import (
    Scenes,
    Views,
    labelled,
    mirrored,
    random_views,
    render_sampled,
    sample_scenes,
)
from train.stopwatch import Stopwatch


class Block(NamedTuple):
    """Views rendered together, which are the new views of several batches."""

    views: Views
    fresh: int  # views of each batch that are new

    def part(self, batch: int) -> Views:
        """Return the new views of the block's batch of this number."""
        return Views(*(field[batch * self.fresh : (batch + 1) * self.fresh] for field in self.views))


@dataclass(eq=False)
class LiveBatches(IterableDataset[Batch]):
    """Endless batches of new views; with ``repeats`` each view is in that many consecutive batches.

    Of a batch, one ``repeats``-th is new. So a view comes again beside others, and mirrored or not anew.
    Views are rendered for several batches together, since a GPU renders many in little more time than few.

    Args:
        share: fraction of the run's budget that is used at a batch.
        stages: sizes of views and batches by that share, at the beginning of each block.
        repeats: batches that have each view.
        together: batches whose new views are rendered together, a block.
        view: stride and stripes of the labels, and the probability of mirroring.
        window: window of the views; None for whole images.
        seed: together with the number of the batch, decides everything.
        first: number of the first batch.
        device: device of the rendering.
        rows: views whose pixels are computed at once.
        far_share: probability that a block's views are far views, see :func:`far_stage`.
    """

    share: Callable[[int], float]
    stages: list[Stage]
    repeats: int
    together: int
    view: ViewConfig
    window: WindowConfig | None
    seed: Seed
    first: int
    device: torch.device
    rows: int
    far_share: float = 0.0

    def __post_init__(self) -> None:
        """Make the watch of rendering and labelling."""
        self.watch = Stopwatch(self.device)

    def __iter__(self) -> Iterator[Batch]:
        """Render, mirror, label."""
        blocks: dict[int, Block] = {}
        with ThreadPoolExecutor(1) as pool:
            ahead = ScenesAhead(pool, self._sample)
            for number in itertools.count(self.first):
                with self.watch.time("rendering"):
                    wanted = range(max(0, number - self.repeats + 1), number + 1)
                    needed = sorted({each // self.together for each in wanted})
                    blocks = {each: blocks.get(each) or self._render(each, ahead) for each in needed}
                    parts = [blocks[each // self.together].part(each % self.together) for each in wanted]
                    same = [part for part in parts if part.image.shape == parts[-1].image.shape]
                    views = join_tensors(torch.cat, same)
                with self.watch.time("labelling"):
                    rng = np.random.default_rng((*self.seed, number))
                    which = torch.from_numpy(rng.random(len(views.image)) < self.view.flip)
                    batch = labelled(mirrored(views, which.to(self.device)), self.view)
                yield batch

    def _render(self, block: int, ahead: ScenesAhead) -> Block:
        stage = self._stage(block)
        views = render_sampled(ahead.take(block, stage), stage.size, self.device, self.rows)
        ahead.begin(block + 1, self._stage(block + 1))
        return Block(views, self._fresh(stage))

    def _stage(self, block: int) -> Stage:
        stage = stage_at(self.stages, self.share(block * self.together))
        is_far = np.random.default_rng((*self.seed, block, 2)).random() < self.far_share
        return far_stage(stage) if is_far else stage

    def _fresh(self, stage: Stage) -> int:
        count: int = stage.batch_size // self.repeats
        return max(1, count)

    def _sample(self, block: int, stage: Stage) -> Scenes:
        seed = (*self.seed, block, 1)
        return sample_scenes(self._fresh(stage) * self.together, stage.size, seed, self.window)


def far_stage(stage: Stage) -> Stage:
    """Return a stage with views of the size of :class:`~lanebev.FarView`, and as many pixels in a batch.

    A far view is a wide and low window about the horizon.
    """
    (height, width), (rows, columns) = stage.size, view_sizes(FarView(), stage.size, stage.size).far
    batch_size = max(1, round(stage.batch_size * height * width / (rows * columns)))
    return Stage(stage.until, (rows, columns), batch_size)


class ScenesAhead:
    """Samples the next block's scenes on another thread, while the device renders and trains.

    Args:
        pool: the thread.
        sample: samples the scenes of a block and a stage; always the same for these.
    """

    def __init__(self, pool: ThreadPoolExecutor, sample: Callable[[int, Stage], Scenes]) -> None:
        self._pool, self._sample = pool, sample
        self._next: tuple[int, Stage, Future[Scenes]] | None = None

    def begin(self, block: int, stage: Stage) -> None:
        """Begin to sample a block's scenes."""
        self._next = (block, stage, self._pool.submit(self._sample, block, stage))

    def take(self, block: int, stage: Stage) -> Scenes:
        """Return the scenes, which are sampled now if others were begun, as where a stage has ended since."""
        if self._next is None or self._next[:2] != (block, stage):
            return self._sample(block, stage)
        return self._next[2].result()


@dataclass(eq=False)
class HeldOutBatches(IterableDataset[Batch]):
    """A fixed number of whole frames, the same every time on one kind of device."""

    batches: int
    batch_size: int
    size: tuple[int, int]
    view: ViewConfig
    seed: int
    device: torch.device

    def __iter__(self) -> Iterator[Batch]:
        """Render and label."""
        for number in range(self.batches):
            seed = (self.seed, number)
            yield labelled(
                random_views(self.batch_size, self.size, seed, self.device, None, self.batch_size), self.view
            )


class LiveRoads(L.LightningDataModule):
    """Rendered roads, on the device that trains.

    Args:
        stages: sizes of views and batches, by the share of the run's steps or minutes that is used.
        batch_share: factor on all batch sizes; halve it if memory does not suffice.
        repeats: batches that have each view; more than 1 where rendering takes longer than training.
        together: batches whose new views are rendered together.
        rows: views whose pixels are computed at once, for the memory's sake.
        window: how windows about the horizon are drawn; None for whole images.
        far_share: probability that the views rendered together are far views; these need a ``window``.
        view: stride and stripes of the labels, and the probability of mirroring; the rest of it is not used.
        val_size: (height, width) of whole frames in validation.
        val_batch_size: frames per batch in validation.
        val_batches: number of validation batches.
        seed: seed of the views; validation uses another stream.
    """

    def __init__(
        self,
        stages: list[Stage],
        batch_share: PositiveFloat = 1.0,
        repeats: PositiveInt = 1,
        together: PositiveInt = 4,
        rows: PositiveInt = 256,
        window: WindowConfig | None = None,
        far_share: float = 0.0,
        view: ViewConfig | None = None,
        val_size: tuple[PositiveInt, PositiveInt] = (320, 576),
        val_batch_size: PositiveInt = 32,
        val_batches: PositiveInt = 4,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not stages:
            raise ValueError("stages: expected at least one, got none")
        if not 0.0 <= far_share <= 1.0:
            raise ValueError(f"far_share: expected a probability of 0 to 1, got {far_share}")
        if far_share and window is None:
            raise ValueError(
                f"far_share: expected the setting window too, got {far_share} without; give window: {{}}"
            )
        self.stages = [
            Stage(stage.until, stage.size, max(repeats, round(batch_share * stage.batch_size)))
            for stage in stages
        ]
        self.repeats, self.together, self.rows = repeats, together, rows
        self.window, self.view, self.far_share = window, view or ViewConfig(), far_share
        self.val_size, self.val_batch_size, self.val_batches = val_size, val_batch_size, val_batches
        self.seed = seed
        self.batches: LiveBatches | None = None  # of the training under way

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return endless training batches."""
        trainer = self._trainer()
        rank, first = run_position(self)
        every = trainer.accumulate_grad_batches
        self.batches = LiveBatches(
            share=lambda number: used_share(trainer, number // every),
            stages=self.stages,
            repeats=self.repeats,
            together=self.together,
            view=self.view,
            window=self.window,
            seed=(self.seed, rank),
            first=first,
            device=trainer.strategy.root_device,
            rows=self.rows,
            far_share=self.far_share,
        )
        return DataLoader(self.batches, batch_size=None)

    def val_dataloader(self) -> DataLoader[Batch]:
        """Return held-out frames."""
        device = self._trainer().strategy.root_device
        frames = (self.val_batches, self.val_batch_size, self.val_size)
        return DataLoader(HeldOutBatches(*frames, self.view, self.seed + 7_919, device), batch_size=None)

    test_dataloader = val_dataloader
    predict_dataloader = val_dataloader

    def _trainer(self) -> L.Trainer:
        if self.trainer is None:
            raise RuntimeError("LiveRoads renders on the device of its trainer: expected one, got none")
        return self.trainer
