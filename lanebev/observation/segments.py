"""Line segments on lane boundaries: vertices of any detector, paired for the calibrators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.geometry.distortion import check_lens
from lanebev.geometry.precision import full_precision
from lanebev.observation.boundary_vertices import BoundaryVertices, move_to_front, undistort_vertices
from lanebev.observation.polylines import LINE_SIGMA, LaneLine, lines_from_polylines, vertices_from_lines
from lanebev.observation.vertices import take
from lanebev.torch_internals import register_pytree
from lanebev.types import NUM_BOUNDARIES, check_tensor


@register_pytree
class LaneSegments(NamedTuple):
    """Line segments on lane boundaries, padded to N per image.

    Attributes:
        endpoints: (B, N, 2, 2) px, undistorted image coordinates, ``[segment, end, (x, y)]``.
        boundary: (B, N) int64, index of the semantic lane boundary, left to right, 0..L-1.
        weight: (B, N) in [0, 1]; 0 is padding or "not seen".
        sigma: (B, N) px, standard deviation of an end point's position across the line.
    """

    endpoints: Tensor
    boundary: Tensor
    weight: Tensor
    sigma: Tensor

    def check(self, num_boundaries: int = NUM_BOUNDARIES) -> LaneSegments:
        """Check the numbers, which calibrators do not check because that would wait for the device.

        A calibrator ignores segments that it cannot use. That is right for a bad frame of a detector, but
        hides a mistake in the code that makes segments; so call this on its first ones.

        Args:
            num_boundaries: L.

        Returns:
            the segments themselves.

        Raises:
            TypeError: a part is no tensor.
            ValueError: a part has another shape or dtype, or a segment with a weight has a boundary index
                outside 0..L-1, a weight outside 0..1, an end point that is not finite or a sigma that is
                not positive.
        """
        for name, part in self._asdict().items():
            check_tensor(f"segments.{name}", part)
        rows = self.weight.shape
        shapes = {"endpoints": (*rows, 2, 2), "boundary": rows, "sigma": rows}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                got = tuple(getattr(self, name).shape)
                raise ValueError(f"segments.{name}: expected {tuple(shape)}, got {got}")
        if self.boundary.dtype != torch.int64:
            raise ValueError(f"segments.boundary: expected int64 indices, got {self.boundary.dtype}")
        seen, last = self.weight != 0, num_boundaries - 1
        for name, expected, good in (
            ("weight", "0 to 1", (self.weight >= 0) & (self.weight <= 1)),
            ("boundary", f"0 to {last}", (self.boundary >= 0) & (self.boundary <= last)),
            ("endpoints", "finite px", self.endpoints.isfinite().flatten(2).all(-1)),
            ("sigma", "positive finite px", (self.sigma > 0) & self.sigma.isfinite()),
        ):
            if bool((seen & ~good).any()):
                got = getattr(self, name)[seen & ~good][0].tolist()
                raise ValueError(f"segments.{name}: expected {expected}, got {got}")
        return self

    @classmethod
    def from_polylines(
        cls,
        polylines: Sequence[ArrayLike | Tensor] | Mapping[int, ArrayLike | Tensor],
        camera: Camera,
        sigma: float = LINE_SIGMA,
        num_boundaries: int = NUM_BOUNDARIES,
    ) -> LaneSegments:
        """Make segments of the lane boundaries that another detector drew in one frame.

        Boundaries are numbered by their side of the ego lane. Points are sampled on rows of the image that
        are far enough apart for independent errors, undistorted, and paired.

        Args:
            polylines: one for each boundary, (P, 2) px (x, y) of the image as taken, along the boundary in
                either direction; x, or x and y, are NaN or masked in a gap. A mapping from number to
                polyline if the detector knows the numbers (0..L-1, left to right).
            camera: the lens.
            sigma: px, standard deviation of a polyline across its line.
            num_boundaries: L.

        Returns:
            segments of batch size 1, in double precision.

        Raises:
            ValueError: a polyline of another shape or in half precision, or a number outside 0..L-1.
        """
        return segments_from_lines(
            [lines_from_polylines(polylines, sigma, num_boundaries)], camera, num_boundaries
        )


@full_precision
def segments_from_vertices(
    vertices: BoundaryVertices, intrinsics: Tensor, distortion: Tensor | None = None, model: str = "pinhole"
) -> LaneSegments:
    """Pair the vertices of each boundary to line segments in undistorted pixels.

    Source: Sects. VI-A and VI-B, representative vertices sampled and paired. Deviation: not at random, which
    would use some vertices often and many never. Of K vertices of a boundary, vertex i is paired with vertex
    i + ceil(K/2). Each is used once, so that the errors of all end points are independent, and every segment
    is half as long as the boundary. Its weight is the smaller one of its ends, its variance their mean.

    Args:
        vertices: (B, P, V).
        intrinsics: (B, 3, 3) px.
        distortion: (B, D) of the lens, or None for images without distortion.
        model: "pinhole", "fisheye" or "omni".

    Returns:
        segments with N = P·(V // 2), in the widest dtype of the arguments. A vertex that the lens cannot
        have imaged, and every vertex of a row whose lens is not usable, is left out.

    Raises:
        ValueError: a lens model that does not exist, or another number of coefficients than it has.
    """
    check_lens(distortion, model)
    vertices = move_to_front(vertices)
    if distortion is not None and distortion.shape[-1] > 0:
        vertices = move_to_front(undistort_vertices(vertices, intrinsics, distortion, model))
    return pair_vertices(vertices)


def pair_vertices(vertices: BoundaryVertices) -> LaneSegments:
    """Pair vertex i of K with vertex i + ceil(K/2), see :func:`segments_from_vertices`.

    Args:
        vertices: (B, P, V), those with a weight in front.

    Returns:
        segments with N = P·(V // 2), in the pixels of the vertices.
    """
    points, weight, sigma, boundary = vertices
    most = weight.shape[-1]
    count = (weight > 0).sum(-1, keepdim=True)  # (B, P, 1)
    half = count // 2
    first = torch.arange(most // 2, device=points.device)
    second = (first + count - half).clamp(max=most - 1)  # (B, P, V // 2)
    seen = first < half
    ends = torch.stack([points[:, :, : most // 2], take(points, second)], dim=-2)  # (B, P, V // 2, 2, 2)
    smaller = torch.minimum(weight[..., : most // 2], weight.gather(-1, second))
    variance = sigma.square()
    variance = 0.5 * (variance[..., : most // 2] + variance.gather(-1, second))
    return LaneSegments(
        endpoints=torch.where(seen[..., None, None], ends, 0.0).flatten(1, 2),
        boundary=boundary.unsqueeze(-1).expand_as(second).flatten(1),
        weight=torch.where(seen, smaller, 0.0).flatten(1),
        sigma=torch.where(seen, variance, 1.0).sqrt().flatten(1),
    )


def camera_segments(vertices: BoundaryVertices, camera: Camera) -> LaneSegments:
    """Pair the vertices of B images that one camera took, see :func:`segments_from_vertices`."""
    rows = vertices.weight.shape[0]
    intrinsics, distortion = camera.intrinsics.expand(rows, 3, 3), camera.distortion.expand(rows, -1)
    return segments_from_vertices(vertices, intrinsics, distortion, camera.model)


def segments_from_lines(
    frames: Sequence[Sequence[LaneLine]], camera: Camera, num_boundaries: int = NUM_BOUNDARIES
) -> LaneSegments:
    """Convert the lines of B frames to segments, each frame a row of the batch."""
    parts = zip(*(vertices_from_lines(lines, camera, num_boundaries) for lines in frames), strict=True)
    return camera_segments(BoundaryVertices._make(map(torch.cat, parts)), camera)
