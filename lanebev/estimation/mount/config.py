"""Configuration of the mount estimator."""

from dataclasses import dataclass, fields

PerAxis = tuple[float, float, float, float]


@dataclass(frozen=True)
class MountConfig:
    """Configuration of :class:`MountEstimator`; rad, m, s, in the order pitch, yaw, roll, height.

    Attributes:
        block_time: time of accepted frames in a block, s.
        num_blocks: number of blocks kept.
        needed: number of blocks for a valid estimate.
        lower, upper: validity limits of the mount.
        margin: hysteresis of the limits.
        largest_std: largest standard deviation of a frame's pose with which it is used on that axis.
        block_std: prior standard deviation of blocks.
        prior_blocks: number of blocks that ``block_std`` counts as.
        block_correlation: correlation of neighbouring blocks, due to slow motion.
        prior_pose, prior_std: mean and standard deviation of the prior.
        moved_least: smallest change that counts as a moved camera.
        moved_sigmas: number of a block's sigmas that the change must also exceed.
        moved_blocks: number of consecutive, agreeing blocks that must show the change.
        blend_steps: number of accepted frames over which the output changes from an old to a new estimate.
        drift_std: standard deviation of the mount's random walk, per square root of an hour without a new
            block.
        stale_time: time without a new block after which an axis is reported as stale, s.
        min_speed: speed of the vehicle below which a frame is not used, m/s.
        max_yaw_rate: yaw rate of the vehicle above which a frame is not used, rad/s.
        max_curvature: curvature of the road above which a frame is not used, 1/m.
    """

    block_time: float = 4.0
    num_blocks: int = 50
    needed: int = 5
    lower: PerAxis = (-0.09, -0.07, -0.35, 0.4)
    upper: PerAxis = (0.17, 0.07, 0.35, 4.0)
    margin: PerAxis = (0.003, 0.003, 0.005, 0.02)
    largest_std: PerAxis = (0.01, 0.01, 0.02, 0.1)
    block_std: PerAxis = (0.004, 0.006, 0.004, 0.01)
    prior_blocks: float = 4.0
    block_correlation: float = 0.2
    prior_pose: PerAxis = (0.0, 0.0, 0.0, 1.5)
    prior_std: PerAxis = (0.12, 0.15, 0.05, 0.5)
    moved_least: PerAxis = (0.015, 0.02, 0.02, 0.06)
    moved_sigmas: float = 5.0
    moved_blocks: int = 3
    blend_steps: int = 10
    drift_std: PerAxis = (0.003, 0.003, 0.003, 0.01)
    stale_time: float = 1800.0
    min_speed: float = 6.7
    max_yaw_rate: float = 0.035
    max_curvature: float = 1e-3

    def __post_init__(self) -> None:
        if not 1 <= self.moved_blocks < self.needed <= self.num_blocks:
            raise ValueError(
                "moved_blocks, needed, num_blocks: expected 1 <= moved_blocks < needed <= num_blocks, got "
                f"{self.moved_blocks}, {self.needed}, {self.num_blocks}"
            )
        if not self.block_time > 0:
            raise ValueError(f"block_time: expected a positive time in s, got {self.block_time}")
        for setting in fields(self):
            value = getattr(self, setting.name)
            if isinstance(setting.default, tuple) and not (isinstance(value, tuple) and len(value) == 4):
                expected = "a tuple of 4 numbers, of pitch, yaw, roll and height"
                raise ValueError(f"{setting.name}: expected {expected}, got {value!r}")
