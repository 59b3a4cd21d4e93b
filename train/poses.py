"""Whole frames with the pose they were taken from, and the pose that a network's logits lead to."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from lanebev.estimation.joint.single_frame import SingleFrameFit, fit_single_frame
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


class PoseBatches(IterableDataset[PoseBatch]):
    """Batches of whole frames; ``batches`` of them, or endless with None."""

    def __init__(
        self,
        frames: PoolFrames | LiveFrames,
        batch_size: int,
        size: tuple[int, int],
        view: ViewConfig,
        seed: Seed,
        batches: int | None = None,
        first: int = 0,
    ) -> None:
        super().__init__()
        self.frames, self.batch_size, self.size = frames, batch_size, size
        self.view, self.seed, self.batches, self.first = view, seed, batches, first

    def __iter__(self) -> Iterator[PoseBatch]:
        """Draw."""
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
    where_only: bool = False,
    reach: float = 1.0,
) -> SingleFrameFit:
    """Estimate each image's pose from logits, differentiable, in double precision.

    A frame's gradient is at most ``reach`` times as long as that of most.

    With ``where_only`` gradients reach where lines lie, not how much they count: a network cannot get a
    better pose by seeing fewer of them.
    """
    dtype = widest_dtype(logits.device)
    even: Tensor = EvenGradients.apply(logits.to(dtype), reach)  # type: ignore[no-untyped-call]
    intrinsics, distortion = intrinsics.to(dtype), distortion.to(dtype)
    segments = segments_from_vertices(extractor.vertices(even, size, size), intrinsics, distortion)
    if where_only:
        segments = segments._replace(weight=segments.weight.detach(), sigma=segments.sigma.detach())
    width = cast_floating(lane_width, dtype)
    return fit_single_frame(segments, intrinsics, width)


class EvenGradients(torch.autograd.Function):
    """The identity, whose gradient is at most ``reach`` times as long for one sample as for most of a batch.

    A fit close to another solution has a gradient a thousand times that of the others, and says the least.
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
        fit: of B frames.
        truth: (B, 4).
        unit: (4,) rad, rad, rad, m: errors that count as one; far larger ones count linearly.
        with_prior: what the fit took from the prior (roll on one lane) counts too, and frames without a fit.
    """
    counted = fit.valid | with_prior
    said = (fit.observed | with_prior) & counted.unsqueeze(-1)
    error = (fit.extrinsics.stack() - truth) / unit
    error = torch.where(said & error.isfinite(), error, 0.0)
    return ((1 + error.square()).sqrt() - 1).sum() / counted.sum().clamp(min=1)


def pose_surprise(fit: SingleFrameFit, truth: Tensor, floor: Tensor, factor: float = 1.0) -> Tensor:
    """Compute the negative log likelihood of the truth under the fit's sigmas, mean over frames.

    A proper score (Gneiting and Raftery 2007): lines that are not seen cost the sigma that they would have
    given, and a line that is none costs what it claims to know. The density is Student's t with 4 degrees of
    freedom, so that one frame gone wrong does not decide.

    Args:
        fit: of B frames; where one does not observe an axis, its prior answers for it.
        truth: (B, 4).
        floor: (4,) rad, rad, rad, m, added to the sigmas in quadrature: smaller errors are as good as none.
        factor: on the fit's sigmas, see ``SegmenterConfig.pose_sigma_scale``.
    """
    error = fit.extrinsics.stack() - truth
    variance = factor**2 * fit.covariance.diagonal(dim1=-2, dim2=-1)[:, :4] + floor.square()
    surprise = 2.5 * (error.square() / (4 * variance)).log1p() + 0.5 * (variance / floor.square()).log()
    usable = surprise.isfinite().all(-1)
    return torch.where(usable.unsqueeze(-1), surprise, 0.0).sum() / usable.sum().clamp(min=1)
