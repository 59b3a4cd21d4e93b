"""The detector's training, with the pose that an arm of the experiment gives it."""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

import lightning as L
import torch
from torch import Tensor

from lanebev.pipeline import LaneBEV
from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid
from train.detector.drives import NOMINAL
from train.detector.frames import Frames, mirrored
from train.detector.network import VehicleDetector
from train.detector.targets import detection_loss

Arm = Literal["nominal", "noisy", "online", "tuned", "true"]
ARMS: tuple[Arm, ...] = get_args(Arm)
NOISE = (math.radians(0.75), math.radians(0.75), math.radians(0.75), 0.03)
"""Standard deviations of the noise on pitch, yaw, roll and height of the arm ``noisy``."""


def arm_poses(arm: Arm, frames: Frames, noise: Tensor | None = None) -> Tensor:
    """Return the poses (B, 4) that an arm takes for true, without a network in training.

    Args:
        arm: "nominal" and "noisy": the mount's as it is said to be, in training of "noisy" with ``noise``
            times NOISE; "online" and "tuned": of the online calibration; "true": the truth.
        frames: B of them.
        noise: (B, 4) of unit variance, or None.
    """
    if arm == "true":
        return frames.extrinsics
    if arm in ("online", "tuned"):
        return frames.online
    nominal = frames.extrinsics.new_tensor(NOMINAL).expand_as(frames.extrinsics)
    return nominal if arm == "nominal" or noise is None else nominal + noise * noise.new_tensor(NOISE)


class DetectorTraining(L.LightningModule):
    """Training of a :class:`VehicleDetector` with one arm's poses.

    Args:
        arm: see :func:`arm_poses`; "tuned" trains the lane network too, by the detector's loss alone.
        grid: grid of the bird's-eye view.
        width: channels of the image features.
        bev_width: channels of the bird's-eye features.
        top: px of the image above which nothing is looked at.
        learning_rate: largest, of one cycle (Smith and Topin 2019).
        lane_rate: the lane network's, as a share of it.
        network_width: px of the lane network's input.
        fps: frame rate of the drives.
    """

    def __init__(
        self,
        arm: Arm,
        grid: BEVGrid,
        width: int = 32,
        bev_width: int = 48,
        top: int = 96,
        learning_rate: float = 3e-3,
        lane_rate: float = 0.01,
        network_width: int | None = None,
        fps: float = 10.0,
    ) -> None:
        super().__init__()
        self.arm, self.grid = arm, grid
        self.fps = fps
        self.learning_rate = float(learning_rate)  # a plain number, which a checkpoint may hold
        self.lane_rate = float(lane_rate)
        self.detector = VehicleDetector(grid, width, bev_width, top)
        self.lanes: LaneBEV | None = None
        if arm == "tuned":
            self.lanes = LaneBEV.from_pretrained(network_width=network_width)

    def training_step(self, batch: Frames, batch_idx: int) -> Tensor:
        """Find the boxes of a batch by the arm's poses."""
        if self.lanes is None:
            if bool(torch.rand(()) < 0.5):
                batch = mirrored(batch)
            poses = arm_poses(self.arm, batch, torch.randn_like(batch.extrinsics))
        else:
            poses = self._estimated(batch, self.lanes)
        image = batch.image.float() / 255
        maps = self.detector(image, batch.intrinsics, Extrinsics.unstack(poses)).float()
        loss = detection_loss(maps, batch.boxes, batch.seen, self.grid)
        self.log("loss", loss, prog_bar=True)
        return loss

    def on_train_epoch_start(self) -> None:
        """Keep the lane network's statistics as they are."""
        if self.lanes is not None:
            self.lanes.eval()

    def _estimated(self, batch: Frames, lanes: LaneBEV) -> Tensor:
        """Estimate the poses (B, 4) by the current lane network, from the states before the frames."""
        image, state = batch.image.float() / 255, batch.state
        width = batch.lane_width.to(state[0].dtype)
        out, _ = lanes(image, batch.intrinsics.double(), state, 1 / self.fps, width, truncation=1, bev=False)
        poses: Tensor = out.calibration.extrinsics.stack().to(batch.extrinsics.dtype)
        return poses

    def configure_optimizers(self) -> Any:
        """Return one cycle of AdamW."""
        groups = [{"params": self.detector.parameters(), "lr": self.learning_rate}]
        if self.lanes is not None:
            rate = self.lane_rate * self.learning_rate
            groups.append({"params": self.lanes.segmenter.parameters(), "lr": rate})
        optimizer = torch.optim.AdamW(groups, weight_decay=0.01)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            [group["lr"] for group in optimizer.param_groups],
            int(self.trainer.max_steps),  # plain, as the rates are
            pct_start=0.15,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
