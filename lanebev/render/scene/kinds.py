"""The kinds of road that a world shows, drawn independently, so that kinds combine."""

from typing import NamedTuple

from torch import Tensor

from lanebev.render.scene.sampler import BatchSampler

KINDS = ("any", "highway", "varied", "city", "country", "night", "snow", "tunnel", "works", "camera")
_VARIED = 0.43  # share of the worlds of "any" that are not the plain highway


class Kinds(NamedTuple):
    """The kinds of road that a world has besides the plain road, (B,) bool each.

    Attributes:
        city: a street with kerbs, pavements, parked cars and all that is painted in towns.
        country: a narrow road, mostly without any paint.
        night: no daylight; headlights, at times street lamps and lights of the town.
        snow: snow or slush at the edges and between the wheel tracks.
        tunnel: walls, a ceiling and its lamps.
        works: road works: yellow lines over white ones, cones, barriers.
        camera: faults of windscreen, lens and recorder.
    """

    city: Tensor
    country: Tensor
    night: Tensor
    snow: Tensor
    tunnel: Tensor
    works: Tensor
    camera: Tensor


def sample_kinds(sampler: BatchSampler, kind: str) -> Kinds:
    """Sample the kind of each world.

    Args:
        sampler: the randomness.
        kind: one of ``KINDS``: "any" is mostly plain highways, "varied" never draws on purpose a plain one,
            any other name is that kind alone.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    if kind not in ("any", "varied"):
        nothing = sampler.chance(0.0)
        return Kinds(**{name: ~nothing if name == kind else nothing for name in Kinds._fields})
    varied = sampler.chance(_VARIED if kind == "any" else 1.0)
    place = sampler.pick([0.55, 0.11, 0.34])
    city, country = varied & (place == 0), varied & (place == 1)
    return Kinds(
        city=city,
        country=country,
        night=varied & sampler.chance(0.33),
        snow=varied & sampler.chance(0.08),
        tunnel=varied & sampler.chance(0.07),
        works=varied & ~country & sampler.chance(0.13),
        camera=varied & sampler.chance(0.5),
    )
