"""Whole frames with their true pose, and the pose estimated from a network's logits."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from lanebev.estimation.joint.frame.single_frame import SingleFrameFit, fit_single_frame
from lanebev.geometry.precision import cast_floating, widest_dtype
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segments import segments_from_vertices
from train.data import Batch, LiveFrames, PoolFrames, RenderedRoads, Seed, run_position
from train.labels import LabelledImage, ViewConfig, full_view
from train.pool import Pose


class PoseBatch(NamedTuple):
    """Whole frames, their labels and their cameras.

    Attributes:
        image, target, weight: as in :class:`~train.data.Batch`.
        extrinsics: (B, 4) pitch, yaw, roll in rad, height in m.
        intrinsics: (B, 3, 3) px of ``image``.
        distortion: (B, 5).
        lane_width: (B, L - 1) m.
    """

    image: Tensor
    target: Tensor
    weight: Tensor
    extrinsics: Tensor
    intrinsics: Tensor
    distortion: Tensor
    lane_width: Tensor

    @classmethod
    def stack(
        cls, samples: list[tuple[LabelledImage, Pose]], size: tuple[int, int], view: ViewConfig
    ) -> PoseBatch:
        """Stack frames resized to (height, width)."""
        views = Batch.stack([full_view(sample, size, view) for sample, _ in samples])
        pose = Pose(*(np.stack(field) for field in zip(*(pose for _, pose in samples), strict=True)))
        taken = [sample.image.shape[:2] for sample, _ in samples]
        scale = np.array([[size[1] / width, size[0] / height, 1.0] for height, width in taken], np.float32)
        intrinsics = pose.intrinsics * scale[:, :, None]
        intrinsics[:, :2, 2] += 0.5 * (scale[:, :2] - 1)  # pixel centres at integers
        resized = pose._replace(intrinsics=intrinsics)
        return cls(*views, *(torch.from_numpy(field) for field in resized))


@dataclass(eq=False)
class PoseBatches(IterableDataset[PoseBatch]):
    """Batches of whole frames; ``batches`` of them, or endless with None."""

    frames: PoolFrames | LiveFrames
    batch_size: int
    size: tuple[int, int]
    view: ViewConfig
    seed: Seed
    batches: int | None = None
    first: int = 0

    def __iter__(self) -> Iterator[PoseBatch]:
        """Yield the batches."""
        samples = self.frames.posed(self.seed, self.first * self.batch_size)
        for _ in itertools.count() if self.batches is None else range(self.batches):
            yield PoseBatch.stack([next(samples) for _ in range(self.batch_size)], self.size, self.view)


class RenderedPoses(RenderedRoads):
    """As :class:`~train.data.RenderedRoads`, but whole frames of ``val_size`` with their poses."""

    def train_dataloader(self) -> DataLoader[PoseBatch]:  # type: ignore[override]
        """Return endless training batches."""
        rank, first = run_position(self)
        return self._batches(self.pool, (self.seed, rank), None, first)

    def val_dataloader(self) -> DataLoader[PoseBatch]:  # type: ignore[override]
        """Return held-out frames."""
        return self._batches(self.val_pool, (self.seed + 7_919,), self.val_batches)

    def _batches(
        self, pool: str | None, seed: Seed, batches: int | None, first: int = 0
    ) -> DataLoader[PoseBatch]:
        frames = self._frames(pool)
        data = PoseBatches(frames, self.batch_size, self.val_size, self.view, seed, batches, first)
        return DataLoader(data, batch_size=None)

    test_dataloader = val_dataloader  # type: ignore[assignment]
    predict_dataloader = val_dataloader  # type: ignore[assignment]


def fit_poses(
    logits: Tensor,
    size: tuple[int, int],
    intrinsics: Tensor,
    distortion: Tensor,
    lane_width: float | Tensor,
    extractor: LineExtractor,
    detach_confidence: bool = False,
    reach: float = 1.0,
) -> SingleFrameFit:
    """Estimate each image's pose from logits, differentiable, in double precision.

    A frame's gradient is at most ``reach`` times as long as the median one.

    With ``detach_confidence`` gradients reach the positions of lines but not their weights: a network cannot
    get a better pose by finding fewer of them.
    """
    dtype = widest_dtype(logits.device)
    even: Tensor = GradientClip.apply(logits.to(dtype), reach)  # type: ignore[no-untyped-call]
    intrinsics, distortion = intrinsics.to(dtype), distortion.to(dtype)
    segments = segments_from_vertices(extractor.vertices(even, size, size), intrinsics, distortion)
    if detach_confidence:
        segments = segments._replace(weight=segments.weight.detach(), sigma=segments.sigma.detach())
    width = cast_floating(lane_width, dtype)
    return fit_single_frame(segments, intrinsics, width)


class GradientClip(torch.autograd.Function):
    """The identity, with each sample's gradient at most ``reach`` times as long as the median of the batch.

    A fit close to another solution has a gradient a thousand times that of the others, and the least
    information.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, reach: float) -> Tensor:
        """Return (B, ...) unchanged."""
        ctx.reach = reach
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Shorten each sample's gradient to the limit; leave out what is not finite."""
        finite = gradient.isfinite().flatten(1).all(1)
        length = torch.where(finite, gradient.nan_to_num(0, 0, 0).flatten(1).norm(dim=1), 0.0)
        factor = (ctx.reach * length.median() / length.clamp(min=1e-12)).clamp(max=1) * finite
        return gradient.nan_to_num(0, 0, 0) * factor.view(-1, *[1] * (gradient.ndim - 1)), None


def pose_loss(fit: SingleFrameFit, truth: Tensor, unit: Tensor, with_prior: bool = False) -> Tensor:
    """Compute the Charbonnier loss of the fitted pose, summed over axes, mean over frames with a fit.

    Args:
        fit: fit of B frames.
        truth: (B, 4).
        unit: (4,) rad, rad, rad, m: errors of loss one; much larger ones count linearly.
        with_prior: also count frames without a fit, and axes that have the prior (roll on one lane).
    """
    counted = fit.valid | with_prior
    said = (fit.observed | with_prior) & counted.unsqueeze(-1)
    error = (fit.extrinsics.stack() - truth) / unit
    error = torch.where(said & error.isfinite(), error, 0.0)
    return ((1 + error.square()).sqrt() - 1).sum() / counted.sum().clamp(min=1)


def student_t_nll(fit: SingleFrameFit, truth: Tensor, floor: Tensor, factor: float = 1.0) -> Tensor:
    """Compute the negative log likelihood of the truth under the fit's sigmas, mean over frames.

    It is a proper score (Gneiting and Raftery 2007): a missed line costs because sigmas are larger, a false
    one because errors are larger than sigmas. The density is Student's t with 4 degrees of freedom, so that
    one wrong frame does not dominate.

    Args:
        fit: fits of B frames; unobserved axes have the prior.
        truth: (B, 4).
        floor: (4,) rad, rad, rad, m, added to the sigmas in quadrature, so that smaller errors do not matter.
        factor: factor on the fit's sigmas, see ``SegmenterConfig.pose_sigma_scale``.
    """
    error = fit.extrinsics.stack() - truth
    variance = factor**2 * fit.covariance.diagonal(dim1=-2, dim2=-1)[:, :4] + floor.square()
    nll = 2.5 * (error.square() / (4 * variance)).log1p() + 0.5 * (variance / floor.square()).log()
    usable = nll.isfinite().all(-1)
    return torch.where(usable.unsqueeze(-1), nll, 0.0).sum() / usable.sum().clamp(min=1)
