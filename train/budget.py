"""The used fraction of a run's budget of steps or minutes, and what depends on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import lightning as L
from jsonargparse.typing import PositiveInt
from lightning.pytorch.callbacks import Timer


def used_share(trainer: L.Trainer, step: int | None = None) -> float:
    """Return the used share of ``max_steps`` or of ``max_time``, the larger one; 0 where neither is given.

    A run in steps is the same each time; one in minutes depends on the machine's speed.

    Args:
        trainer: trainer of the run.
        step: step in question; by default the next one. The time is always now.
    """
    step = trainer.global_step if step is None else step
    by_step = step / trainer.max_steps if trainer.max_steps > 0 else 0.0
    timers = [callback for callback in trainer.callbacks if isinstance(callback, Timer)]  # type: ignore[attr-defined]
    by_time = [
        timer.time_elapsed() / (timer.time_elapsed() + left)
        for timer in timers
        if (left := timer.time_remaining()) is not None
    ]
    return min(1.0, max([by_step, *by_time]))


def rate_factor(
    step: int, total: int, share: float, *, warmup_steps: int, decay_steps: int, decay_share: float
) -> float:
    """Compute the learning rate of a step as a share of the largest: warm-up, stable, decay.

    Args:
        step: steps done.
        total: steps of the run; not positive where it has no such end.
        share: used fraction of the budget.
        warmup_steps: number of steps of linear growth.
        decay_steps: last steps of ``total``, in which the rate falls linearly to zero.
        decay_share: last share of the budget in which it does; 0 for none.
    """
    warm = min(1.0, (step + 1) / max(1, warmup_steps))
    left = (total - step) / max(1, decay_steps) if total > 0 else 1.0
    if decay_share > 0:
        left = min(left, (1 - share) / decay_share)
    return warm * min(1.0, max(0.0, left))


@dataclass(frozen=True)
class Stage:
    """Settings of the training until a fraction of its budget is used.

    Attributes:
        until: share of the budget.
        size: (height, width) of the views.
        batch_size: views per batch.
    """

    until: float
    size: tuple[PositiveInt, PositiveInt]
    batch_size: PositiveInt


def stage_at(stages: Sequence[Stage], share: float) -> Stage:
    """Return the stage at a share of the budget; the last one lasts to the end."""
    return next((stage for stage in stages if share < stage.until), stages[-1])
