"""A module of tensors only that can be exported, with the names and an example of what goes in and out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, nn

from lanebev.camera.model import Camera

ROWS = 2  # of the example: a batch of one would be taken for a constant

Inputs = dict[str, Tensor]


@dataclass(frozen=True)
class Part:
    """A module that can be exported.

    Attributes:
        module: takes the tensors of ``inputs`` in their order and returns a tuple of those of ``outputs``.
        inputs: an example by name; the first dimension of each is the batch.
        outputs: names.
        facts: what its caller has to know, as JSON can hold it.
        free: further dimensions of all inputs that are not fixed, and of what number each is a multiple.
    """

    module: nn.Module
    inputs: Inputs
    outputs: tuple[str, ...]
    facts: Mapping[str, Any] = field(default_factory=dict)
    free: Mapping[int, int] = field(default_factory=dict)


def lens_inputs(camera: Camera) -> Inputs:
    """Return intrinsics and, behind a lens, distortion."""
    inputs = {"intrinsics": camera.intrinsics.double().repeat(ROWS, 1, 1)}
    if camera.distortion.numel():
        inputs["distortion"] = camera.distortion.double().repeat(ROWS, 1)
    return inputs
