"""Images to vertices of lane boundaries: network and line extraction, of one view or of two."""

from collections.abc import Collection
from contextlib import AbstractContextManager, nullcontext
from typing import Self

import torch
from torch import Tensor, nn

from lanebev.batch import replace_rows, select_rows
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.far_view import (
    FarView,
    ViewSizes,
    covered_size,
    crop_images,
    far_vertices,
    inside_far_view,
    merge_vertices,
    place_crop,
    view_sizes,
    with_columns,
)
from lanebev.observation.frames import resize_image, resized_size
from lanebev.observation.lines import LineExtractor
from lanebev.observation.polylines import VERTICES_PER_LINE
from lanebev.types import check_tensor


class BoundaryDetector(nn.Module):
    """Finds lane boundaries in images; the first half of :class:`lanebev.LaneBEV`.

    Its arguments are those of the same names of :class:`lanebev.LaneBEV`.
    """

    def __init__(
        self,
        segmenter: nn.Module,
        extractor: LineExtractor,
        network_width: int | None,
        network_pixels: int | None,
        frozen: Collection[str],
        far_view: FarView | None,
    ) -> None:
        super().__init__()
        if not (far_view is None or isinstance(far_view, FarView)):
            raise TypeError(
                f"far_view: expected a lanebev.FarView or None, got {far_view!r}; write FarView()"
            )
        for name, value in (("network_width", network_width), ("network_pixels", network_pixels)):
            if value is not None and (value != int(value) or value <= 0):
                raise ValueError(f"{name}: expected a whole number of px above 0, or None, got {value!r}")
        self.segmenter = segmenter
        self.extractor = extractor
        self.network_width = None if network_width is None else int(network_width)
        self.network_pixels = None if network_pixels is None else int(network_pixels)
        self.frozen = frozenset(frozen)
        self.far_view = far_view

    def train(self, mode: bool = True) -> Self:
        """Set the mode of all stages but the frozen ones."""
        super().train(mode)
        for stage in self.frozen:
            self.get_submodule(stage).eval()
        return self

    def network_size(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """Return the (h, w) px to which images of (H, W) px are resized for the segmenter."""
        if self.network_width is None:
            return image_size
        return resized_size(image_size, self.network_width, self.network_pixels)

    def view_sizes(self, image_size: tuple[int, int]) -> ViewSizes:
        """Return the sizes of the whole image and of the far view for images of (H, W) px."""
        return view_sizes(self.far_view or FarView(), image_size, self.network_size(image_size))

    def boundary_vertices(
        self, image: Tensor, vanishing_point: Tensor | None = None
    ) -> tuple[Tensor, BoundaryVertices]:
        """Run network and line extraction only.

        Args:
            image: (B, 3, H, W) as taken.
            vanishing_point: (B, 2) px of the image, where the lanes are expected to meet; not finite in rows
                where this is not known. With it the network also looks at a far view about this point, in
                rows where it is known. None: at the whole image alone.

        Returns:
            logits (B, 1 + L, h, w) of the whole image, and vertices in pixels of the image as taken. A row
            whose image is not finite counts as black and has none, so that it spoils neither other rows nor
            gradients.
        """
        size = (image.shape[-2], image.shape[-1])
        if vanishing_point is None:
            return self._detect_whole(image, self.network_size(size))
        logits, whole = self.whole_vertices(image)
        return logits, self.add_far_view(image, whole, vanishing_point)

    def whole_vertices(self, image: Tensor) -> tuple[Tensor, BoundaryVertices]:
        """Run network and line extraction on the smaller whole image beside a far view.

        Args:
            image: (B, 3, H, W) as taken.

        Returns:
            as :meth:`boundary_vertices`.
        """
        return self._detect_whole(image, self.view_sizes((image.shape[-2], image.shape[-1])).whole)

    def add_far_view(
        self, image: Tensor, whole: BoundaryVertices, vanishing_point: Tensor
    ) -> BoundaryVertices:
        """Add the vertices of the far view to those of the smaller whole image.

        Each row has a far view of its own. Where the vanishing point is not known, the vertices are those of
        the whole image at its full size, as without a far view. A compiled program computes both for all
        rows.

        Args:
            image: (B, 3, H, W) as taken.
            whole: vertices by :meth:`whole_vertices`.
            vanishing_point: (B, 2) px of the image, not finite where not known.

        Returns:
            (B, L, VERTICES_PER_LINE).

        Raises:
            TypeError: the vanishing point is not a tensor.
            ValueError: it has another shape, or whole numbers.
        """
        check_vanishing_point(vanishing_point, image.shape[0])
        point = vanishing_point.to(image.device, torch.float32)
        known = point.isfinite().all(-1)
        point = torch.where(known.unsqueeze(-1), point, 0.0)
        found = with_columns(whole, VERTICES_PER_LINE)
        if torch.compiler.is_compiling():  # torch.cond cannot contain the network (torch 2.13)
            both = self._with_far_view(image, whole, point)
            return select_rows(known, both, self._without_far_view(image))
        found = replace_rows(known, found, self._with_far_view, image, whole, point)
        return replace_rows(~known, found, self._without_far_view, image)

    def _with_far_view(self, image: Tensor, whole: BoundaryVertices, point: Tensor) -> BoundaryVertices:
        """Return the vertices of both views; all rows know their vanishing points."""
        size = (image.shape[-2], image.shape[-1])
        sizes = self.view_sizes(size)
        resized = resize_image(image, sizes.resized)
        corner = place_crop(point, sizes, size, (self.far_view or FarView()).above)
        view = crop_images(resized, corner, sizes.far)
        _, seen = self._detect(view, _finite(resized), covered_size(sizes, size))
        far = far_vertices(seen, corner, sizes, size)
        inside = inside_far_view(whole.points, corner, sizes, size)
        return merge_vertices(whole, far, inside, point[:, 1].to(whole.points))

    def _without_far_view(self, image: Tensor) -> BoundaryVertices:
        found = self._detect_whole(image, self.network_size((image.shape[-2], image.shape[-1])))[1]
        return with_columns(found, VERTICES_PER_LINE)

    def _detect_whole(self, image: Tensor, size: tuple[int, int]) -> tuple[Tensor, BoundaryVertices]:
        """Look at whole images, resized to (h, w) px."""
        resized = resize_image(image, size)
        return self._detect(resized, _finite(resized), (image.shape[-2], image.shape[-1]))

    def _detect(
        self, view: Tensor, finite: Tensor, covered: tuple[float, float]
    ) -> tuple[Tensor, BoundaryVertices]:
        """Run network and extraction on views.

        Args:
            view: (B, 3, h, w), the network's input.
            finite: (B,) bool, of which images all numbers are finite.
            covered: (height, width), px of the image, that the views show.
        """
        view = view.contiguous()  # a network rounds otherwise for another order in memory
        with self._gradients("segmenter"):
            logits = self.segmenter(torch.where(finite[:, None, None, None], view, 0.0))
        with self._gradients("extractor"):
            vertices = self.extractor.vertices(logits, covered, (view.shape[-2], view.shape[-1]))
        weight = torch.where(finite[:, None, None], vertices.weight, 0.0)
        return logits, vertices._replace(weight=weight)

    def _gradients(self, stage: str) -> AbstractContextManager[object]:
        """Return the context of a stage: without gradients if it is frozen.

        Raises:
            ValueError: it is frozen and has parameters that want gradients, which would silently be zero.
        """
        if stage not in self.frozen:
            return nullcontext()
        parts = self.get_submodule(stage).parameters()
        if torch.is_grad_enabled() and any(part.requires_grad for part in parts):
            raise ValueError(
                f"{stage}: expected parameters without gradients, since it is frozen, got some with; to "
                f"train it, set model.frozen = model.frozen - {{{stage!r}}}, else "
                f"{stage}.requires_grad_(False)"
            )
        return torch.no_grad()


def check_vanishing_point(point: Tensor, rows: int) -> None:
    """Raise unless these are points (rows, 2) of floating point.

    Raises:
        TypeError: not a tensor.
        ValueError: another shape, or whole numbers.
    """
    check_tensor("vanishing_point", point)
    if point.shape != (rows, 2) or not point.is_floating_point():
        got = f"{tuple(point.shape)} {point.dtype}"
        raise ValueError(f"vanishing_point: expected ({rows}, 2) of floating point, px, got {got}")


def _finite(image: Tensor) -> Tensor:
    """Return which images (B, ...) are finite, (B,) bool."""
    return image.isfinite().flatten(1).all(1)
