"""The roll and height that a drive has shown, against which doubtful ones are compared.

With one lane in view, a lane that becomes narrower looks like a camera that becomes higher. With a wrongly
numbered line in view, the others may fit a wrong roll and height. A camera on a vehicle does not move so.
"""

import torch
from torch import Tensor

from lanebev.batch import has_flag, select_rows
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.update import membership
from lanebev.estimation.joint.layout import NUM_POSE, POSE
from lanebev.estimation.joint.measurement.observations import Observations, per_end
from lanebev.estimation.joint.measurement.residuals import ROLL
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.geometry.linalg import times_vector
from lanebev.tensors import constant
from lanebev.types import Status

_MEMORY = 20.0  # s, time constant of the means
_TURNED = 3.0  # s, for which pitch or yaw differs from its mean if the camera was moved
_LEAST_SHARE = 0.2  # a line of whose segments a smaller fraction fits bounds no lane
_LEAST_ENDS = 8.0  # end points of such a line
_FREE = 3.0  # sigmas by which the pose of a vehicle's body differs from its mean
_IS_ROLL = tuple(axis == ROLL for axis in range(NUM_POSE))
_LEAST_TIME = 1e-6  # s; smaller sums are not divided by


def compare_with_usual(
    before: JointState, after: JointState, seen: Observations, inliers: Tensor, dt: Tensor, cfg: JointConfig
) -> JointState:
    """Compare roll and height with their means so far where the frame tells them badly, and update the means.

    Source: (J37). A camera that was moved has another pitch or yaw too, and begins new means after a while. A
    frame that is not tracked changes nothing.

    Args:
        before: state before the frame.
        after: after it.
        seen: what was observed.
        inliers: (B, N), of the state.
        dt: (B,) s between both.
        cfg: the configuration.
    """
    tracked = after.status == int(Status.TRACKING)
    roll_unseen = has_flag(after.reasons, Reason.ROLL_UNSEEN)
    doubtful = roll_unseen | has_odd_line(seen, inliers, cfg.num_boundaries)
    unseen = roll_unseen.unsqueeze(-1) & constant(_IS_ROLL, like=roll_unseen)
    told = tracked.unsqueeze(-1) & ~unseen  # (B, 4)
    pose, (total, time) = after.mean[:, POSE], before.usual.unbind(1)
    free = _FREE * constant(cfg.motion.pose_std, like=pose)
    apart = torch.where(told & (time > _LEAST_TIME), pose - total / time.clamp(min=_LEAST_TIME), 0.0) / free
    turned = torch.where((apart[:, :ROLL].abs() > 1).any(-1), before.turned + dt, 0.0)
    moved = turned > _TURNED
    doubtful = doubtful & ~moved
    farthest = apart[:, ROLL:].square().amax(-1)
    far = doubtful & (farthest > 1)
    beyond = (1 - torch.where(far, farthest, 2.0).reciprocal()).sqrt()  # 2: the slope at 1 is infinite
    unusual = torch.where(far, beyond, 0.0).unsqueeze(-1) * (free * apart)[:, ROLL:]

    fade = torch.where(doubtful, (-dt / _MEMORY).exp(), 0.0)[:, None, None]
    now = _MEMORY * torch.stack([pose, torch.ones_like(pose)], dim=1)
    usual = torch.where(told.unsqueeze(1), torch.lerp(now, before.usual, fade), before.usual)
    return after._replace(
        usual=usual,
        turned=torch.where(tracked, torch.where(moved, 0.0, turned), before.turned),
        unusual=select_rows(tracked, unusual, before.unusual),
    )


def has_odd_line(seen: Observations, inliers: Tensor, num_boundaries: int) -> Tensor:
    """Tell in which rows (B,) hardly any segment of some line fits, so that it bounds no lane."""
    member = membership(seen.boundary, num_boundaries, like=inliers)
    count = times_vector(member, per_end(seen.weight))
    fitting = times_vector(member, per_end(seen.weight * inliers))
    return ((count >= _LEAST_ENDS) & (fitting < _LEAST_SHARE * count)).any(-1)
