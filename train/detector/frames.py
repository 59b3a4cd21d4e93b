"""Frames of drives in memory, for the detector's training."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from lanebev.estimation.joint.state import JointState
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
    states = [_after_warm_up(record.state) for record in records]
    count = [len(record.ends) for record in records]
    return Frames(
        image=joined([record.images() for record in records]).permute(0, 3, 1, 2),
        boxes=boxes,
        seen=joined([record.seen for record in records]) & in_grid(boxes, grid),
        extrinsics=joined([record.extrinsics for record in records]),
        online=joined([record.online for record in records]),
        intrinsics=joined([np.repeat(r.intrinsics[None], n, 0) for r, n in zip(records, count, strict=True)]),
        lane_width=joined([record.lane_width for record in records]),
        state=JointState(*(torch.cat(part) for part in zip(*states, strict=True))),
    )


def _after_warm_up(state: JointState) -> JointState:
    """Return the states of the frames after the warm-up."""
    return JointState(*(part[WARM_UP:] for part in state))


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
