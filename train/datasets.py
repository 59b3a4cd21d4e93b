"""Labelled images on disk in the layouts of TuSimple, CULane and OpenLane, for your own data."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import lightning as L
import numpy as np
from jsonargparse.typing import PositiveInt
from lightning.pytorch.utilities import rank_zero_warn
from torch.utils.data import DataLoader, IterableDataset

from lanebev.io.images.pixels import image_size, read_image
from lanebev.io.lanes.contrast import LaneContrast
from lanebev.io.lanes.culane import read_culane
from lanebev.io.lanes.openlane import read_openlane
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.size import size_doubt
from lanebev.io.lanes.tusimple import read_tusimple
from lanebev.observation.boundary_order import boundary_indices
from lanebev.types import NUM_BOUNDARIES
from train.data import Batch, Seed, ViewBatches, run_position
from train.labels import LabelledImage, ViewConfig, full_view

_LOOKED_AT = 20  # entries, for the size and the contrast of their images
_REMEDY = "give the images that were labelled, or convert the labels to pixels of the given images"
Format = Literal["tusimple", "culane", "openlane"]


class Entry(NamedTuple):
    """An image and its lines, in pixels of the image."""

    image: Path
    lines: FrameLines


class ScoredBatch(NamedTuple):
    """Whole images with the additional data that a benchmark's score needs.

    Attributes:
        views: images and label maps at the network's size.
        lines: the label of each image, in its own pixels.
        image_sizes: (height, width) of each image as taken.
        benchmark: the benchmark whose rules apply.
    """

    views: Batch
    lines: list[FrameLines]
    image_sizes: list[tuple[int, int]]
    benchmark: Format


def read_entries(layout: Format, root: Path, names: list[str]) -> list[Entry]:
    """Read the entries of a data set.

    Args:
        layout: "tusimple": names are label files whose ``raw_file`` is under the root. "culane": names are
            lists of images under the root, each with its ``.lines.txt`` beside it (what follows the image in
            a line of ``train_gt.txt`` is passed over). "openlane": names are folders of JSON files, whose
            ``file_path`` is under the root's ``images``.
        root: root of the data set.
        names: relative to the root.
    """
    entries: list[Entry] = []
    for name in names:
        path = root / name
        if layout == "tusimple":
            entries += [Entry(root / frame.name, frame) for frame in read_tusimple(path)]
        elif layout == "culane":
            entries += [_culane_entry(root, line) for line in _lines(path) if line.strip()]
        elif layout == "openlane":
            frames = [read_openlane(file) for file in sorted(path.rglob("*.json"))]
            entries += [Entry(root / "images" / frame.name, frame) for frame in frames]
        else:
            raise ValueError(f"layout: expected tusimple, culane or openlane, got {layout!r}")
    if not entries:
        raise ValueError(f"{root}: expected labelled images in {', '.join(names) or 'a list'}, found none")
    return entries


def check_labels(entries: list[Entry]) -> None:
    """Warn if some lines seem to be of other images, or in pixels of smaller or cropped ones.

    Raises:
        ValueError: lines lie outside the images, or there are none.
    """
    if not any(entry.lines.lines for entry in entries):
        raise ValueError(f"{entries[0].lines.name} and others: lanes: none of the entries has a line")
    of_size: dict[tuple[int, int], list[FrameLines]] = defaultdict(list)
    contrast = LaneContrast()
    for number, entry in enumerate(entries[:: max(1, len(entries) // _LOOKED_AT)]):
        size = image_size(entry.image)
        if size is not None:
            of_size[size].append(entry.lines)
            contrast.add(number, read_image(entry.image), (line.points for line in entry.lines.lines))
    doubts = [(frames[0].name, size_doubt(frames, size)) for size, frames in of_size.items()]
    for name, doubt in doubts:
        if doubt is None:
            continue
        words = f"{name} and others: lanes: {doubt.words} {_REMEDY}"
        if doubt.is_outside:
            raise ValueError(words)
        rank_zero_warn(words)
    if (words := contrast.remark()) and not any(doubt for _, doubt in doubts):
        rank_zero_warn(f"{entries[0].lines.name} and others: lanes: {words} {_REMEDY}")


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError as error:
        raise ValueError(f"{path}: expected a list of images: {error.strerror}") from error


def _culane_entry(root: Path, line: str) -> Entry:
    image = root / line.split(maxsplit=1)[0].lstrip("/")
    return Entry(image, read_culane(image.with_suffix(".lines.txt")))


def labelled_image(entry: Entry) -> LabelledImage:
    """Decode an image and give its lines their boundary; lines beyond the outermost are left out.

    Boundaries are those that the file states, as in a ``lanes.json`` of our own, else by their order.
    """
    image = read_image(entry.image)
    lines = entry.lines.lines
    drawn = [line.points[np.isfinite(line.points).all(-1)] for line in lines]
    drawn = [points[np.argsort(-points[:, 1])] for points in drawn]  # near to far
    count = max([len(points) for points in drawn] + [2])
    points = np.full((NUM_BOUNDARIES, count, 2), np.nan, np.float32)
    told = all(line.boundary is not None for line in lines)
    indices = [line.boundary for line in lines] if told else boundary_indices(drawn, NUM_BOUNDARIES)
    for line, index in zip(drawn, indices, strict=True):
        if index is not None and index < NUM_BOUNDARIES:
            points[index, : len(line)] = line
    there = np.asarray(np.isfinite(points).all(-1))
    return LabelledImage(image, points, there, there, np.full(2, np.nan, np.float32))


class EntryFrames:
    """Labelled images in random order, endless."""

    def __init__(self, entries: list[Entry]) -> None:
        self.entries = entries

    def __call__(self, seed: Seed, first: int = 0) -> Iterator[LabelledImage]:
        """Yield each entry once, then again in another order; from the ``first``-th on."""
        rng = np.random.default_rng(seed)
        while True:
            order = rng.permutation(len(self.entries))
            yield from (labelled_image(self.entries[i]) for i in order[first:])
            first = max(0, first - len(order))


@dataclass(eq=False)
class ScoredBatches(IterableDataset[ScoredBatch]):
    """All entries in order, as whole images."""

    entries: list[Entry]
    layout: Format
    batch_size: int
    size: tuple[int, int]
    view: ViewConfig

    def __iter__(self) -> Iterator[ScoredBatch]:
        """Yield the batches."""
        for start in range(0, len(self.entries), self.batch_size):
            entries = self.entries[start : start + self.batch_size]
            samples = [labelled_image(entry) for entry in entries]
            views = Batch.stack([full_view(sample, self.size, self.view) for sample in samples])
            sizes = [sample.image.shape[:2] for sample in samples]
            yield ScoredBatch(views, [entry.lines for entry in entries], sizes, self.layout)


class LaneFiles(L.LightningDataModule):
    """A data set on disk.

    Args:
        layout: see :func:`read_entries`.
        root: its folder.
        train: label files, lists or folders to train on.
        val: the same for validation, test and prediction.
        batch_size: views per batch.
        sizes: (height, width) choices of training views.
        val_size: (height, width) that whole images are resized to.
        view: how views are drawn.
        seed: seed of the views.
        workers: processes that read.
    """

    def __init__(
        self,
        layout: Format,
        root: str,
        train: list[str] | None = None,
        val: list[str] | None = None,
        batch_size: PositiveInt = 8,
        sizes: list[tuple[PositiveInt, PositiveInt]] | None = None,
        val_size: tuple[PositiveInt, PositiveInt] = (192, 320),
        view: ViewConfig | None = None,
        seed: int = 0,
        workers: int = 1,
    ) -> None:
        super().__init__()
        self.layout, self.root, self.train, self.val = layout, Path(root), train or [], val or []
        self.batch_size, self.sizes, self.val_size = batch_size, sizes or [(192, 320)], val_size
        self.view, self.seed, self.workers = view or ViewConfig(), seed, workers

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return endless random views."""
        entries = read_entries(self.layout, self.root, self.train)
        check_labels(entries)
        frames = EntryFrames(entries)
        rank, first = run_position(self)
        return DataLoader(
            ViewBatches(frames, self.batch_size, self.sizes, self.view, (self.seed, rank), first),
            batch_size=None,
            num_workers=self.workers,
        )

    def val_dataloader(self) -> DataLoader[ScoredBatch]:
        """Return every image once, whole."""
        entries = read_entries(self.layout, self.root, self.val)
        check_labels(entries)
        data = ScoredBatches(entries, self.layout, self.batch_size, self.val_size, self.view)
        return DataLoader(data, batch_size=None, collate_fn=lambda batch: batch)

    test_dataloader = val_dataloader
    predict_dataloader = val_dataloader
