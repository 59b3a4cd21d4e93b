"""The detector's training, with the pose that an arm of the experiment gives it."""

import math
from typing import Any

import lightning as L
import torch
from torch import Tensor

from lanebev.pipeline import LaneBEV
from lanebev.types import Extrinsics
from train.detector.drives import NOMINAL
from train.detector.frames import Frames, mirrored
from train.detector.network import VehicleDetector
from train.detector.settings import Arm, Experiment
from train.detector.targets import detection_loss

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
        experiment: the settings.
        arm: see :func:`arm_poses`; "tuned" trains the lane network too, by the detector's loss alone, and
            must continue a training of "online".
        seed: seed of the mirroring and of the noise.
    """

    def __init__(self, experiment: Experiment, arm: Arm, seed: int) -> None:
        super().__init__()
        self.arm, self.grid = arm, experiment.grid
        self.fps, self.seed = experiment.fps, seed
        self.learning_rate = float(experiment.learning_rate)  # a plain number, which a checkpoint may hold
        self.lane_rate = float(experiment.lane_rate)
        self.steps, self.tuned_steps = int(experiment.steps), int(experiment.tuned_steps)
        self.detector = VehicleDetector(
            experiment.grid, experiment.width, experiment.bev_width, experiment.top
        )
        self.lanes: LaneBEV | None = None
        if arm == "tuned":
            self.lanes = LaneBEV.from_pretrained(network_width=experiment.network_width)

    def training_step(self, batch: Frames, batch_idx: int) -> Tensor:
        """Find the boxes of a batch by the arm's poses, in half of the steps mirrored."""
        if self.lanes is not None:
            batch = batch._replace(online=self._estimated(batch, self.lanes))
        random = torch.Generator().manual_seed(1_000_003 * self.seed + self.global_step)
        if bool(torch.rand((), generator=random) < 0.5):
            batch = mirrored(batch)
        noise = torch.randn(batch.extrinsics.shape, generator=random).to(batch.extrinsics)
        poses = arm_poses(self.arm, batch, noise)
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
        """Return AdamW with one cycle of the detector's learning rate, and one of the lane network's."""
        begin = self.steps - self.tuned_steps
        groups = [{"params": self.detector.parameters(), "lr": self.learning_rate, "weight_decay": 0.01}]
        cycles = [lambda step: one_cycle(step / self.steps)]
        if self.lanes is not None:
            lanes = self.lanes.segmenter.parameters()
            groups.append({"params": lanes, "lr": self.lane_rate, "weight_decay": 0.0})
            cycles.append(lambda step: one_cycle((step - begin) / self.tuned_steps))
        optimizer = torch.optim.AdamW(groups)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, cycles)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the gradients of detector and lane network separately: neither shortens the other's."""
        for group in optimizer.param_groups:
            torch.nn.utils.clip_grad_norm_(group["params"], gradient_clip_val or math.inf)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the lane network to a checkpoint of a training without it."""
        if self.lanes is None or any(name.startswith("lanes.") for name in checkpoint["state_dict"]):
            return
        checkpoint["state_dict"] |= {f"lanes.{name}": part for name, part in self.lanes.state_dict().items()}
        optimizer, schedule = checkpoint["optimizer_states"][0], checkpoint["lr_schedulers"][0]
        (detector,) = optimizer["param_groups"]
        first, count = len(detector["params"]), len(list(self.lanes.segmenter.parameters()))
        rates = {"initial_lr": self.lane_rate, "lr": self.lane_rate * one_cycle(0.0), "weight_decay": 0.0}
        added = {**detector, **rates, "params": [*range(first, first + count)]}
        optimizer["param_groups"] = [detector, added]
        schedule["base_lrs"] = [*schedule["base_lrs"], rates["initial_lr"]]
        schedule["_last_lr"] = [*schedule["_last_lr"], rates["lr"]]
        schedule["lr_lambdas"] = [*schedule["lr_lambdas"], None]


def one_cycle(done: float, rise: float = 0.15) -> float:
    """Compute the learning rate as a fraction of the largest: up from 1/25 and down to 0, by half cosines.

    Source: Smith and Topin 2019, "Super-Convergence"; of torch's OneCycleLR without the momentum's cycle.

    Args:
        done: fraction of the training that is done.
        rise: fraction of the training in which the rate rises.
    """
    first, last, share = (1 / 25, 1.0, done / rise) if done < rise else (1.0, 0.0, (done - rise) / (1 - rise))
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * min(max(share, 0.0), 1.0)))
