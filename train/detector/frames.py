"""Frames of drives in memory, for the detector's training."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from lanebev.estimation.joint.state import JointState
from lanebev.tensors import join_tensors, map_tensors
from lanebev.view.grid import BEVGrid
from train.detector.boxes import in_grid
from train.detector.drives import WARM_UP, DriveRecord, read_drive


class Frames(NamedTuple):
    """A batch of frames.

    Attributes:
        image: (B, 3, H, W) uint8.
        boxes: (B, M, 5).
        seen: (B, M) bool, visible and in the grid.
        extrinsics: (B, 4) true.
        online: (B, 4) of the online calibration.
        intrinsics: (B, 3, 3) px.
        lane_width: (B, L - 1) m.
        state: state of the calibration before the frame.
    """

    image: Tensor
    boxes: Tensor
    seen: Tensor
    extrinsics: Tensor
    online: Tensor
    intrinsics: Tensor
    lane_width: Tensor
    state: JointState


class DriveFrames(Dataset[Frames]):
    """All frames of the drives in a folder except those of the warm-up.

    Args:
        folder: folder of the files that :mod:`train.detector.drives` wrote.
        grid: boxes elsewhere are left out.
        drives: the first so many; None: all.

    Raises:
        ValueError: there are none.
    """

    def __init__(self, folder: Path, grid: BEVGrid, drives: int | None = None) -> None:
        paths = sorted(folder.glob("*.npz"))[:drives]
        if not paths:
            raise ValueError(
                f"{folder}: expected drives, got none; python -m train.detector.drives writes some"
            )
        self.records = [read_drive(path) for path in paths]
        self.frames = frames_of(self.records, grid)

    def __len__(self) -> int:
        return len(self.frames.image)

    def __getitems__(self, indices: list[int]) -> Frames:
        """Return a batch of frames."""
        rows = torch.tensor(indices)
        state = JointState(*(part[rows] for part in self.frames.state))
        own = {name: getattr(self.frames, name)[rows] for name in Frames._fields[:-1]}
        return Frames(**own, state=state)


def frames_of(records: list[DriveRecord], grid: BEVGrid) -> Frames:
    """Return the frames of drives, one drive after the other."""

    def joined(parts: list[NDArray[Any]]) -> Tensor:
        return torch.from_numpy(np.concatenate([part[WARM_UP:] for part in parts]))

    boxes = joined([record.boxes for record in records])
    states = [map_tensors(lambda part: part[WARM_UP:], record.state) for record in records]
    count = [len(record.ends) for record in records]
    return Frames(
        image=joined([record.images() for record in records]).permute(0, 3, 1, 2),
        boxes=boxes,
        seen=joined([record.seen for record in records]) & in_grid(boxes, grid),
        extrinsics=joined([record.extrinsics for record in records]),
        online=joined([record.online for record in records]),
        intrinsics=joined([np.repeat(r.intrinsics[None], n, 0) for r, n in zip(records, count, strict=True)]),
        lane_width=joined([record.lane_width for record in records]),
        state=join_tensors(torch.cat, states),
    )


class StepBatches(Sampler[list[int]]):
    """The frames of each step of a training: shuffled, all of them once before any twice.

    They depend on the seed and the step only, so that arms and continued trainings see the same.

    Args:
        count: number of frames; must be ``size`` or more.
        size: frames of a batch; the rest of a pass is left out.
        steps: number of steps of the training.
        seed: seed of the order.
        begin: number of steps done before.

    Raises:
        ValueError: fewer frames than a batch.
    """

    def __init__(self, count: int, size: int, steps: int, seed: int, begin: int = 0) -> None:
        if count < size:
            raise ValueError(f"batch_size: expected at most {count}, the number of frames, got {size}")
        self.count, self.size, self.steps = count, size, steps
        self.seed, self.begin = seed, begin

    def __len__(self) -> int:
        """Return the number of steps of the whole training."""
        return self.steps

    def __iter__(self) -> Iterator[list[int]]:
        """Yield the rows of each step from ``begin`` on."""
        generator = torch.Generator().manual_seed(self.seed)
        each = self.count // self.size
        for step in range(self.steps):
            if step % each == 0:
                order = torch.randperm(self.count, generator=generator).split(self.size)
            if step >= self.begin:
                yield order[step % each].tolist()


def mirrored(frames: Frames) -> Frames:
    """Swap left and right; the state of the calibration is not changed."""
    flip = frames.extrinsics.new_tensor([1.0, -1.0, -1.0, 1.0])
    intrinsics = frames.intrinsics.clone()
    intrinsics[:, 0, 2] = frames.image.shape[-1] - 1 - intrinsics[:, 0, 2]
    return frames._replace(
        image=frames.image.flip(-1),
        boxes=frames.boxes * frames.boxes.new_tensor([-1.0, 1.0, 1.0, 1.0, -1.0]),
        extrinsics=frames.extrinsics * flip,
        online=frames.online * flip,
        intrinsics=intrinsics,
    )
