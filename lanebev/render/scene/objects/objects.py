"""Objects on the road, in the local road frame: vehicles, poles, signs, bridges."""

from typing import NamedTuple

from torch import Tensor

CAR, TRUCK, POLE, SIGN, BRIDGE = range(5)


class SceneObjects(NamedTuple):
    """Pairs of convex hexahedra in the local road frame, (B, M) each unless said otherwise.

    Attributes:
        x: m, middle.
        z: m, middle.
        ground: m, the road's elevation below it.
        heading: rad, positive to the right.
        shape: (B, M, 2, 8) m, two hexahedra: half width below and above, rear and front end below,
            rear and front end above, lower and upper face's height. No volume: not there.
        kind: int64, CAR, TRUCK, POLE, SIGN, BRIDGE.
        colour: (B, M, 3) linear reflectance.
        braking: bool, lights its brake lights.
        valid: bool.
    """

    x: Tensor
    z: Tensor
    ground: Tensor
    heading: Tensor
    shape: Tensor
    kind: Tensor
    colour: Tensor
    braking: Tensor
    valid: Tensor
