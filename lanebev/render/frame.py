"""A rendered image and its exact ground truth."""

from typing import NamedTuple

from torch import Tensor

from lanebev.types import Extrinsics


class RenderedFrame(NamedTuple):
    """A batch of rendered images and their ground truth.

    Lengths in metres, angles in radians. Over a crest the road frame, and with it the extrinsics, is the
    tangent plane of the road below the camera; the points stay exact.

    Attributes:
        image: (B, 3, H, W) in [0, 1], as taken: lens distortion and the sensor's faults included.
        boundaries: (B, L, P, 2) px, undistorted, the centre of each painted boundary, near to far. Slots
            2 and 3 are the ego lane's left and right boundary, 0 the leftmost, 5 the rightmost.
        painted: (B, L, P) in [0, 1]: 1 where the boundary exists and is marked; the gap of a dash counts
            as marked, a missing stretch, an unmarked edge and a place outside the image do not.
        visible: (B, L, P) in [0, 1]: painted, and nothing stands in front of it.
        extrinsics: each (B,), the camera over the road, yaw to the lanes' direction below the camera.
        intrinsics: (B, 3, 3) px.
        distortion: (B, D).
        lane_width: (B, L - 1) m, from each boundary to the next; nominal where there is none.
        offset: (B,) m, the camera right of the ego lane's centre.
        curvature: (B, 2) 1/m and 1/m², at the camera, positive to the right, and its change along the road.
        boxes: (B, M, 5) X, Z, length, width, heading of vehicles on the road; heading positive to the right.
        box_valid: (B, M) bool.
    """

    image: Tensor
    boundaries: Tensor
    painted: Tensor
    visible: Tensor
    extrinsics: Extrinsics
    intrinsics: Tensor
    distortion: Tensor
    lane_width: Tensor
    offset: Tensor
    curvature: Tensor
    boxes: Tensor
    box_valid: Tensor
