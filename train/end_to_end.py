"""Fine-tune a network through extractor and calibrator by a loss on the pose."""

import math
from typing import Any

import torch
from torch import Tensor

from lanebev.geometry.precision import widest_dtype
from lanebev.observation.lines import LineExtractor
from train.losses import unweighted_bias
from train.module import Segmentation, unpack
from train.poses import PoseBatch, fit_poses, pose_loss, student_t_nll


class EndToEnd(Segmentation):
    """A segmentation trained with an additional loss on the pose.

    The loss is on pitch, yaw, roll and height of a joint single-frame fit to the extracted segments, and
    differentiable in the maps.

    Args:
        pose_weight: weight of the pose's loss; with 0 only the cross-entropy is trained, on the same frames.
            Keep the logged ``gradient/pose_by_maps`` below ten: an adaptive optimizer divides by the size of
            all gradients, so with a much longer gradient of the pose the cross-entropy has almost no effect.
        likelihood: the loss is the negative log likelihood of the true pose under the fit and its sigmas;
            else it is the error alone.
        pose_unit: deg, deg, deg, m: unit of the errors; with ``likelihood`` the error below which accuracy
            does not matter.
        error_weight: weight of the errors of all frames and axes beside ``likelihood``, which does not
            penalise a large error with a large sigma.
        error_unit: deg, deg, deg, m: unit of these errors.
        max_gradient_ratio: largest ratio of a frame's gradient to the median one.
        detach_confidence: the pose's loss changes where lines are, but not their weights.
        kwargs: arguments of :class:`~train.module.Segmentation`.
    """

    def __init__(
        self,
        pose_weight: float = 0.05,
        pose_unit: tuple[float, float, float, float] = (0.3, 0.3, 0.6, 0.06),
        detach_confidence: bool = False,
        max_gradient_ratio: float = 1.0,
        likelihood: bool = False,
        error_weight: float = 0.0,
        error_unit: tuple[float, float, float, float] = (0.2, 0.4, 0.6, 0.03),
        **kwargs: Any,
    ) -> None:
        if not (math.isfinite(max_gradient_ratio) and max_gradient_ratio > 0):
            raise ValueError(f"max_gradient_ratio: expected more than 0 and finite, got {max_gradient_ratio}")
        if error_weight and not likelihood:
            raise ValueError(
                "error_weight: expected 0 without likelihood, whose loss is the errors themselves"
            )
        super().__init__(**kwargs)
        self.settings |= {
            "pose_weight": pose_weight,
            "pose_unit": list(pose_unit),
            "detach_confidence": detach_confidence,
            "max_gradient_ratio": max_gradient_ratio,
            "likelihood": likelihood,
            "error_weight": error_weight,
            "error_unit": list(error_unit),
        }
        self.extractor = LineExtractor.for_network(self.segmenter.config, correlation=0)
        self.unit: Tensor
        self.error_unit: Tensor
        for name, unit in (("unit", pose_unit), ("error_unit", error_unit)):
            inside = torch.tensor([*map(math.radians, unit[:3]), unit[3]])
            self.register_buffer(name, inside, persistent=False)

    def training_step(self, batch: PoseBatch, batch_idx: int) -> Tensor:  # type: ignore[override]
        """Augment, segment, compare maps and poses."""
        loss, logits = self.map_loss(batch, batch_idx)
        if self.settings["pose_weight"] > 0:
            fit = self._fit(logits + unweighted_bias(self.class_weight).view(1, -1, 1, 1), batch)
            truth = batch.extrinsics.to(widest_dtype(logits.device))
            if self.settings["likelihood"]:
                pose = student_t_nll(fit, truth, self.unit, self.segmenter.config.pose_sigma_scale)
                if self.settings["error_weight"] > 0:
                    errors = pose_loss(fit, truth, self.error_unit, with_prior=True)
                    pose = pose + self.settings["error_weight"] * errors
            else:
                pose = pose_loss(fit, truth, self.unit)
            self.log("loss/pose", pose, prog_bar=True)
            weighted = self.settings["pose_weight"] * pose.to(loss.dtype)
            if (batch_idx + 1) % self.trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
                self.log("gradient/pose_by_maps", gradient_ratio(weighted, loss, logits))
            loss = loss + weighted
        return loss

    def validation_step(self, batch: PoseBatch, batch_idx: int) -> None:  # type: ignore[override]
        """Compute the loss and recall, and the errors of the pose."""
        super().validation_step(batch, batch_idx)  # type: ignore[arg-type]
        fit = self._fit(self(unpack(batch)[0]), batch)  # type: ignore[arg-type]
        said = fit.observed & fit.valid.unsqueeze(-1)
        error = fit.extrinsics.stack() - batch.extrinsics
        self.val_squares += torch.where(said, error, 0.0).square().sum(0)
        self.val_frames += said.sum(0)

    def on_validation_epoch_start(self) -> None:
        """Forget the figures of the epoch before."""
        super().on_validation_epoch_start()
        self.val_squares, self.val_frames = torch.zeros_like(self.unit), torch.zeros_like(self.unit)

    def on_validation_epoch_end(self) -> None:
        """Report in degrees and metres."""
        super().on_validation_epoch_end()
        rmse = (self.val_squares / self.val_frames.clamp(min=1)).sqrt()
        rmse = torch.cat([rmse[:3].rad2deg(), rmse[3:]])
        names = ("pitch_deg", "yaw_deg", "roll_deg", "height_m")
        self.log_dict({f"val/rmse_{name}": value for name, value in zip(names, rmse, strict=True)})

    def _fit(self, logits: Tensor, batch: PoseBatch) -> Any:
        size = (batch.image.shape[-2], batch.image.shape[-1])
        return fit_poses(
            logits,
            size,
            batch.intrinsics,
            batch.distortion,
            batch.lane_width,
            self.extractor,
            self.settings["detach_confidence"],
            self.settings["max_gradient_ratio"],
        )


def gradient_ratio(loss: Tensor, by: Tensor, logits: Tensor) -> Tensor:
    """Compute the ratio of the lengths of two losses' gradients on the logits."""
    one, other = (torch.autograd.grad(each, logits, retain_graph=True)[0].norm() for each in (loss, by))
    ratio: Tensor = one / other.clamp(min=torch.finfo(other.dtype).tiny)
    return ratio
