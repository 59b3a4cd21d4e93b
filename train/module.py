"""The training step."""

import contextlib
import math
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import kornia.augmentation as K
import lightning as L
import numpy as np
import torch
from torch import Tensor, nn
from torchmetrics.classification import MulticlassJaccardIndex

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from train.backbone import load_backbone
from train.budget import rate_factor, used_share
from train.data import Batch
from train.datasets import ScoredBatch
from train.losses import boundary_cross_entropy, row_cross_entropy, unweighted_bias
from train.metrics import point_recall
from train.scores import BenchmarkScores

_NOT_LABELLED = -1  # class of a pixel without weight


class Photometric(nn.Module):
    """Changes brightness, contrast, colour, blur and noise of each image independently; geometry stays."""

    def __init__(self, strength: float = 1.0) -> None:
        super().__init__()
        s = strength
        self.steps = K.ImageSequential(
            K.RandomBrightness((1 - 0.35 * s, 1 + 0.35 * s), p=0.6),
            K.RandomContrast((1 - 0.4 * s, 1 + 0.4 * s), p=0.6),
            K.RandomGamma((1 - 0.3 * s, 1 + 0.4 * s), p=0.3),
            K.RandomSaturation((1 - 0.6 * s, 1 + 0.4 * s), p=0.3),
            K.RandomPlanckianJitter(mode="blackbody", p=0.3),
            K.RandomGrayscale(p=0.08),
            K.RandomGaussianBlur((5, 5), (0.3, 1.2 * s + 0.3), p=0.15),
            K.RandomMotionBlur((3, 7), 90.0, 0.0, p=0.05),
            K.RandomGaussianNoise(0.0, 0.03 * s, p=0.3),
            K.RandomErasing((0.005, 0.04), p=0.15),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Augment (B, 3, H, W) in [0, 1]."""
        augmented: Tensor = self.steps(image)
        return augmented.clamp(0, 1)


class Segmentation(L.LightningModule):
    """Training of a :class:`LaneSegmenter`.

    Args:
        network: its shape.
        optimizer: "sgd" with Nesterov momentum, as in the paper, or "adamw".
        learning_rate: after warm-up.
        weight_decay: weight decay, of weights of two dimensions and more.
        warmup_steps: number of steps of linear growth.
        decay_steps: the last steps of the run, in which the rate falls linearly to zero; before them it
            stays, so that a run can be prolonged at any time (warm-up, stable, decay).
        decay_share: the same as a share of the run's steps or, with ``max_time``, minutes; 0 for none.
        class_weight: (1+L,) of the cross-entropy, or None for ones; undone on export.
        row_weight: weight of :func:`row_cross_entropy` beside the cross-entropy; the paper's is 0.
        augment: strength of the photometric augmentation, 0 for none.
        init_from: checkpoint or weights file to begin with; a network of half the width is widened.
        backbone: ``state_dict`` of torchvision's ResNet-18 to begin the trunk with, such as ImageNet's.
        compiled: compile the network; worth it in runs of hours.
    """

    def __init__(
        self,
        network: SegmenterConfig | None = None,
        optimizer: Literal["sgd", "adamw"] = "adamw",
        learning_rate: float = 2e-3,
        weight_decay: float = 0.02,
        warmup_steps: int = 100,
        decay_steps: int = 0,
        decay_share: float = 0.0,
        class_weight: list[float] | None = None,
        row_weight: float = 0.03,
        augment: float = 1.0,
        init_from: str | None = None,
        backbone: str | None = None,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        network = network or SegmenterConfig()
        given = locals()
        self.settings = {"network": asdict(network), **{name: given[name] for name in _SETTINGS}}
        self.segmenter = LaneSegmenter(network)
        weights = torch.tensor(class_weight or [1.0] * (1 + network.num_boundaries))
        if weights.numel() != 1 + network.num_boundaries:
            raise ValueError(
                f"class_weight: expected {1 + network.num_boundaries} values, got {weights.numel()}"
            )
        self.class_weight: Tensor
        self.register_buffer("class_weight", weights, persistent=False)
        self.photometric = Photometric(augment) if augment > 0 else None
        self.compiled = compiled
        if init_from is not None and backbone is not None:
            raise ValueError("backbone: expected none beside init_from, whose weights have their own trunk")
        if backbone is not None:
            load_backbone(self.segmenter.trunk, Path(backbone))
        if init_from is not None:
            from train.export import load_weights

            load_weights(self.segmenter, Path(init_from), weights)

    def forward(self, image: Tensor) -> Tensor:
        """Convert (B, 3, H, W) in [0, 1] to logits whose softmax is a frequency, class weights removed."""
        bias = unweighted_bias(self.class_weight).view(1, -1, 1, 1)
        return self.segmenter(image).float() + bias  # type: ignore[no-any-return]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the settings; not as hyperparameters, which LightningCLI would read back."""
        checkpoint["settings"] = self.settings

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse another network's in one line, not in one of each weight, and another optimizer's state.

        The strength of augmentation is that of this run, which may have none.
        """
        strengths = _of_augmentation(self.state_dict())
        for key in checkpoint.keys() & {"state_dict", "current_model_state"}:  # the second beside averages
            former = _of_augmentation(checkpoint[key])
            if strengths.keys() != former.keys() or not all(
                torch.allclose(part, former[name].to(part)) for name, part in strengths.items()
            ):
                weights = {name: part for name, part in checkpoint[key].items() if name not in former}
                checkpoint[key] = weights | strengths
        own, other = self.settings["network"], checkpoint["settings"]["network"]
        for name in sorted(own.keys() - {"image_size", "sigma_scale", "pose_sigma_scale"}):
            if own[name] != other[name]:
                raise ValueError(f"ckpt_path: expected a network of {name} {own[name]}, got {other[name]}")
        own, other = self.settings["optimizer"], checkpoint["settings"]["optimizer"]
        if own != other and self._trainer is not None and self._trainer.training:
            raise ValueError(
                f"ckpt_path: expected a run by {own}, got {other}; to begin anew from its weights, give it "
                "as --model.init_args.init_from"
            )

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Augment, segment, compare."""
        return self.map_loss(batch, batch_idx)[0]

    def map_loss(self, batch: Any, batch_idx: int) -> tuple[Tensor, Tensor]:
        """Return the loss of the maps, and the logits (class weights not removed) of an augmented batch."""
        image, target, weight = unpack(batch)
        if self.photometric is not None:
            with torch.no_grad(), self._own_randomness(batch_idx):
                image = self.photometric(image)
        logits = self.segmenter(image).float()  # sums need it
        pixels = boundary_cross_entropy(logits, target, weight, self.class_weight)
        rows = row_cross_entropy(logits, target, weight)
        self.log_dict({"loss/pixels": pixels.detach(), "loss/rows": rows.detach()}, prog_bar=True)
        return pixels + self.settings["row_weight"] * rows, logits

    @contextlib.contextmanager
    def _own_randomness(self, batch_idx: int) -> Iterator[None]:
        """Draw random numbers by seed, process and batch, so that a resumed run draws the same."""
        entropy = (int(os.environ.get("PL_GLOBAL_SEED", "0")), self.global_rank, batch_idx)
        with torch.random.fork_rng(devices=[self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(int(np.random.default_rng(entropy).integers(2**62)))
            yield

    def validation_step(self, batch: Batch | ScoredBatch, batch_idx: int) -> None:
        """Compute the loss, and the recall of each boundary's points."""
        image, target, weight = unpack(batch)
        logits = self(image)
        self.log("val/loss", boundary_cross_entropy(logits, target, weight), batch_size=len(image))
        found, there = point_recall(logits.softmax(1)[:, 1:], target[:, 1:])
        self.val_found += found.sum(0)
        self.val_there += there.sum(0)

    def on_validation_epoch_start(self) -> None:
        """Forget the figures of the epoch before."""
        self.val_found = torch.zeros(self.segmenter.config.num_boundaries, device=self.device)
        self.val_there = torch.zeros_like(self.val_found)

    def on_validation_epoch_end(self) -> None:
        """Report."""
        recall = self.val_found / self.val_there.clamp(min=1)
        self.log_dict({f"val/recall_{k}": value for k, value in enumerate(recall)})
        self.log("val/recall", self.val_found.sum() / self.val_there.sum().clamp(min=1), prog_bar=True)

    def on_test_start(self) -> None:
        """Add the intersection over union of all labelled pixels, and a benchmark's scores on its data."""
        self.iou = MulticlassJaccardIndex(
            1 + self.segmenter.config.num_boundaries,
            average=None,
            ignore_index=_NOT_LABELLED,
            zero_division=math.nan,
        ).to(self.device)
        self.scores = BenchmarkScores()

    def test_step(self, batch: Batch | ScoredBatch, batch_idx: int) -> None:
        """Compute the loss, the intersection over union of each boundary, and scores."""
        image, target, weight = unpack(batch)
        logits = self(image)
        self.log("test/loss", boundary_cross_entropy(logits, target, weight), batch_size=len(image))
        self.iou.update(logits.argmax(1), torch.where(weight > 0, target.argmax(1), _NOT_LABELLED))
        if isinstance(batch, ScoredBatch):
            self.scores.update(logits, (image.shape[-2], image.shape[-1]), batch)

    def on_test_epoch_end(self) -> None:
        """Report."""
        boundaries = self.iou.compute()[1:]  # NaN: not once there
        self.log_dict({f"test/iou_{k}": value for k, value in enumerate(boundaries)})
        self.log("test/iou", boundaries.nanmean())
        self.log_dict({f"test/{name}": value for name, value in self.scores.compute().items()})

    def predict_step(self, batch: Batch | ScoredBatch, batch_idx: int) -> Tensor:
        """Return probabilities, (B, 1+L, h, w)."""
        return self(unpack(batch)[0]).softmax(1)  # type: ignore[no-any-return]

    def configure_optimizers(self) -> Any:
        """Return the optimizer with a learning rate that warms up, stays and decays."""
        settings = self.settings
        decayed = [p for p in self.segmenter.parameters() if p.ndim > 1]
        others = [p for p in self.segmenter.parameters() if p.ndim <= 1]
        groups: list[dict[str, Any]] = [{"params": decayed}, {"params": others, "weight_decay": 0.0}]
        kwargs = {"lr": settings["learning_rate"], "weight_decay": settings["weight_decay"]}
        optimizer: torch.optim.Optimizer
        if settings["optimizer"] == "sgd":
            optimizer = torch.optim.SGD(groups, momentum=0.9, nesterov=True, **kwargs)
        else:
            optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.99), **kwargs)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def _rate(self, step: int) -> float:
        names = ("warmup_steps", "decay_steps", "decay_share")
        schedule = {name: self.settings[name] for name in names}
        return rate_factor(step, self.trainer.max_steps, used_share(self.trainer, step), **schedule)

    def on_train_start(self) -> None:
        """Set rate and weight decay as given: a checkpoint has those of the run before, perhaps 0."""
        for schedule in self.trainer.lr_scheduler_configs:
            groups = schedule.scheduler.optimizer.param_groups
            schedule.scheduler.base_lrs = [self.settings["learning_rate"]] * len(groups)
            for group in groups:
                group["lr"] = self.settings["learning_rate"] * self._rate(self.trainer.global_step)
            groups[0]["weight_decay"] = self.settings["weight_decay"]
        if self.compiled:
            self.segmenter.compile()  # in place: weights keep their names


def _of_augmentation(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the augmentation's buffers among a module's weights."""
    return {name: part for name, part in state.items() if name.startswith("photometric.")}


_SETTINGS = (
    "optimizer", "learning_rate", "weight_decay", "warmup_steps", "decay_steps", "decay_share",
    "class_weight", "row_weight", "augment", "init_from", "backbone",
)  # fmt: skip


def unpack(batch: Batch | ScoredBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Return image in [0, 1], target (B, 1+L, h, w) with its background, weight (B, h, w)."""
    views = batch.views if isinstance(batch, ScoredBatch) else batch
    target = views.target.float() / 255
    background = (1 - target.sum(1, keepdim=True)).clamp(min=0)
    return views.image.float() / 255, torch.cat([background, target], dim=1), views.weight.float()
