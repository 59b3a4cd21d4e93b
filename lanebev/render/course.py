"""The course of roads, of a drive and of single views: straights, clothoids and curves, crests and dips."""

import math

import torch
from torch import Tensor

from lanebev.render.scene.road.alignment import Alignment, arc_nodes, build_alignment
from lanebev.render.scene.sampler import BatchSampler

_NODES = 90.0  # m between the nodes of the curvature
_BEYOND = 2600.0  # m of road beyond the drive


class Course:
    """A road's curvature and elevation by the arc length (m) from the start of the drive.

    Args:
        sampler: the randomness, one row.
        length: m that the camera drives.
        curves: largest curvature is this over 300 m.
        hills: factor of the crests; 0 is a flat road.
    """

    def __init__(self, sampler: BatchSampler, length: float, curves: float, hills: float) -> None:
        count = int((length + _BEYOND) / _NODES) + 3
        value = sampler.uniform(-1, 1, count)[0].double() * sampler.chance(0.65, count)[0]
        value[: 1 + int(sampler.uniform(1, 4))] = 0.0  # the first hundreds of metres are straight
        self._curvature = value * curves / 300.0
        self._wave = 2 * math.pi / sampler.uniform(250, 700, 3)[0].double()
        self._wave_phase = sampler.uniform(0, 2 * math.pi, 3)[0].double()
        self._wave_bend = hills * sampler.uniform(0, 1, 3)[0].double() / 9000.0

    def curvature(self, arc: Tensor) -> Tensor:
        """Return the curvature, 1/m; linear between nodes."""
        position = (arc / _NODES + 1.0).clamp(0, len(self._curvature) - 1.001)
        index = position.long()
        low, high = self._curvature[index], self._curvature[index + 1]
        return low + (high - low) * (position - index)

    def heading(self, arc: float) -> float:
        """Return the direction relative to that at the start, rad."""
        nodes = torch.linspace(0, arc, max(2, int(arc / 5) + 2), dtype=torch.float64)
        return float(torch.trapezoid(self.curvature(nodes), nodes))

    def elevation(self, arc: float, ahead: Tensor) -> Tensor:
        """Return the elevation above the tangent at ``arc``, m, for distances ``ahead`` m."""
        amplitude = self._wave_bend / self._wave**2
        angle = self._wave * arc + self._wave_phase
        there = (self._wave * (ahead[..., None] + arc) + self._wave_phase).sin()
        tangent = angle.sin() + self._wave * angle.cos() * ahead[..., None]
        return (amplitude * (there - tangent)).sum(-1)

    def alignment(self, arc: float) -> Alignment:
        """Return the road's alignment from ``arc`` on."""
        ahead = arc_nodes()
        return build_alignment(self.curvature(ahead + arc)[None], self.elevation(arc, ahead)[None])


def sample_alignment(sampler: BatchSampler) -> Alignment:
    """Sample the alignment of random roads.

    Half of them straight; the others chains of clothoids, curvature linear between nodes 40 to 120 m apart.
    A third goes over a crest or through a dip that begins at or beyond the camera.
    """
    nodes = 24
    straight = sampler.chance(0.45)
    sharp = torch.where(sampler.chance(0.25), 1 / 250, 1 / 900)[:, None]
    knots = sampler.normal(0.6, nodes).clamp(-1.3, 1.3) * sharp
    keep = sampler.chance(0.4, nodes)
    for i in range(1, nodes):
        knots[:, i] = torch.where(keep[:, i], knots[:, i - 1], knots[:, i])
    knots = torch.where(straight[:, None], 0.0, knots).double()
    spacing = sampler.uniform(40, 120, 1).double()
    shift = sampler.uniform(0, 1, 1).double()
    arc = arc_nodes()
    position = (arc / spacing + shift).clamp(max=nodes - 1.001)
    index = position.long()
    low, high = knots.gather(1, index), knots.gather(1, index + 1)
    curvature = low + (high - low) * (position - index)

    bend = torch.where(sampler.chance(0.3), sampler.uniform(-1, 1) / sampler.uniform(1500, 5000), 0.0)[
        :, None
    ].double()
    onset, extent = sampler.uniform(0, 80, 1).double(), sampler.uniform(20, 120, 1).double()
    inside = (arc - onset).clamp(min=0).minimum(extent)
    beyond = (arc - onset - extent).clamp(min=0)
    elevation = bend * (0.5 * inside * inside + extent * beyond)
    return build_alignment(curvature, elevation)
