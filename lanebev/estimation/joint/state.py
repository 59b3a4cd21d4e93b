"""State of the joint filter between two frames."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from lanebev.estimation.reasons import Reason
from lanebev.tensors import constant, map_tensors
from lanebev.torch_internals import register_pytree


@register_pytree
class JointState(NamedTuple):
    """The state of the calibrator between frames, tensors only.

    Attributes:
        mean: (B, D), see :class:`~lanebev.estimation.joint.layout.Layout`.
        cov: (B, D, D).
        phase: (B,) m, how far the first knot of the road's curvature lies behind the camera.
        evidence: (B, 11 + L) evidence against the motion, the accumulated scores of (J15).
        pose_sensitivity: (B, 4, L) change of the pose by each boundary's own deviation (per m), in the last
            frames that determined the pose.
        heading_sensitivity: (B, D, L) change of the mean by each boundary's own heading (per rad) that lasts.
        scatter: (B, 2, L + 4) moments of the boundaries' own deviations and headings in the last frames, see
            :func:`~lanebev.estimation.joint.filter.scatter.averaged_moments`.
        places: (B, L, L + 1) information on the boundaries' deviations from equal lanes, matrix and vector,
            of the frames so far, see (J35).
        motion_scale: (B, 4) >= 1, factor on the variance of the pose's motion, adapted to the drive.
        hills: (B,) 1/m², variance of the road's vertical curvature beyond that of a plane road, by the crests
            and dips so far (J21).
        vertical: (B, 2) information on the road's vertical curvature, matrix (m²) and vector (m), of the last
            frames that do not determine the roll, each by itself (J28).
        early: (B,) s by which the state is ahead of the last frame, which came out of order.
        unseen: (B,) s since the last usable frame.
        misfit: (B,) s for which there were segments that did not fit.
        doubt: (B,) number of further frames to be fitted alone and compared with the state.
        contrary: (B,) number of consecutive usable frames that contradicted the state.
        contradiction: (B, 4) pose of the last of them less that of the state, until a frame agrees.
        usual: (B, 2, 4) the pose (rad and m) summed over the last frames, weighted by time, and the sums of
            the weights, s (J37). A frame that tells roll and height well replaces those before.
        turned: (B,) s for which pitch or yaw differed from its mean.
        unusual: (B, 2) rad and m, by which roll and height differ from their means where the frame tells them
            badly, else 0.
        status: (B,) int64, values of Status.
        reasons: (B,) int64, :class:`Reason` flags of the last frame; those of what is unseen decide how the
            next prediction moves.
    """

    mean: Tensor
    cov: Tensor
    phase: Tensor
    evidence: Tensor
    pose_sensitivity: Tensor
    heading_sensitivity: Tensor
    scatter: Tensor
    places: Tensor
    motion_scale: Tensor
    hills: Tensor
    vertical: Tensor
    early: Tensor
    unseen: Tensor
    misfit: Tensor
    doubt: Tensor
    contrary: Tensor
    contradiction: Tensor
    usual: Tensor
    turned: Tensor
    unusual: Tensor
    status: Tensor
    reasons: Tensor

    def detach(self) -> JointState:
        """Return the state without the graph that computed it."""
        return map_tensors(Tensor.detach, self)


def unobserved_mask(reasons: Tensor) -> Tensor:
    """Return which of pitch, yaw, roll and height the last frame did not determine, (B, 4) bool."""
    bits = (Reason.DIRECTION_UNSEEN, Reason.DIRECTION_UNSEEN, Reason.ROLL_UNSEEN, Reason.HEIGHT_UNSEEN)
    return (reasons.unsqueeze(-1) & constant(tuple(map(int, bits)), like=reasons)) != 0
