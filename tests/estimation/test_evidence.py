"""Evidence against the motion model, and the process noise of a road that bends."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.filter.evidence import CALL, accumulate_evidence
from lanebev.estimation.joint.measurement.residuals import NUM_SHAPE
from lanebev.estimation.joint.motion.road import step_variance
from lanebev.testing.evaluation import track
from lanebev.testing.moments import FPS, Moment, moments
from tools.bench_kinds import measure
from tools.known_road import KnownRoad, shape_of

torch.set_num_threads(1)
DOUBLE = torch.float64
MEMORY = 0.15
DT = torch.full((1,), 1 / 30, dtype=DOUBLE)


def accumulated(score: float, frames: int, entry: int) -> list[float]:
    """Evidence of one entry after frames that all have the same score."""
    evidence, found = torch.zeros(1, 17, dtype=DOUBLE), []
    for _ in range(frames):
        evidence = accumulate_evidence(evidence, torch.full_like(evidence, score), DT, MEMORY)
        found.append(float(evidence[0, entry]))
    return found


def test_scores_of_the_road_add_up_at_unit_variance():
    ratio = math.exp(-1 / 30 / MEMORY)
    last = accumulated(1.0, 200, entry=8)[-1]
    assert last == pytest.approx(math.sqrt(1 - ratio**2) / (1 - ratio))
    generator = torch.Generator().manual_seed(0)
    evidence = torch.zeros(4000, 17, dtype=DOUBLE)
    for _ in range(40):
        score = torch.randn(evidence.shape, generator=generator, dtype=DOUBLE)
        evidence = accumulate_evidence(evidence, score, DT.expand(4000), MEMORY)
    assert evidence[:, 4:].std() == pytest.approx(1.0, abs=0.02)
    assert evidence[:, :4].std() == pytest.approx(1.2, abs=0.05)  # the larger of two


def test_evidence_of_the_pose_fades_in_every_frame_also_by_a_factor():
    ratio = math.exp(-1 / 30 / MEMORY)
    one = torch.zeros(1, 17, dtype=DOUBLE)
    one[0, 0] = 3.0
    after = accumulate_evidence(one, torch.zeros_like(one), DT, MEMORY)
    assert after[0, 0] == pytest.approx(3.0 * 0.85 * ratio)
    steady = 0.85 * math.sqrt(1 - ratio**2) / (1 - 0.85 * ratio)  # of constant scores of 1
    assert accumulated(1.0, 200, entry=0)[-1] == pytest.approx(steady)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_of_the_pose_one_large_score_counts_at_once_and_many_smaller_ones_together(sign):
    assert accumulated(8.0 * sign, 1, entry=0) == [8.0 * sign]
    many = [sign * value for value in accumulated(4.5 * sign, 12, entry=0)]
    assert many[0] == 4.5 < CALL < max(many)
    assert sign * accumulated(2.0 * sign, 50, entry=0)[-1] < CALL


def test_evidence_of_the_pose_begins_anew_after_it_exceeded_the_threshold():
    before = torch.zeros(1, 17, dtype=DOUBLE)
    before[0, 0], before[0, 1], before[0, 8] = CALL + 1, CALL - 1, CALL + 1
    after = accumulate_evidence(before, torch.zeros_like(before), DT, MEMORY)
    assert after[0, 0] == 0
    assert after[0, 1] > 2.5
    assert after[0, 8] == pytest.approx((CALL + 1) * math.exp(-1 / 30 / MEMORY))


def test_the_next_step_may_be_larger_where_the_road_bends():
    cfg = MotionConfig()
    shape = torch.zeros(3, NUM_SHAPE, dtype=DOUBLE)
    shape[1, 0], shape[2, 0] = 2.9e-4, 3.3e-3
    cov = torch.zeros(3, NUM_SHAPE, NUM_SHAPE, dtype=DOUBLE)
    cov[:, 0, 0] = 1e-8
    straight, unclear, bend = step_variance(shape, cov, cfg).sqrt().tolist()
    assert straight == unclear == cfg.curvature_step
    assert bend == pytest.approx(math.hypot(cfg.curvature_step, 0.12 * math.sqrt(3.3e-3**2 - 9e-8)))


@pytest.mark.slow
def test_a_fall_with_only_the_ego_lane_in_view_is_followed():
    found = measure("drop, ego lane", range(60_000, 60_006))
    assert found.within >= 0.97
    assert max(found.back) <= 15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "ratio"),
    [
        ("motion up to 1.5°, 1.2 Hz, R 300 m", 1.3),  # before the bend's own process noise 1.4
        ("winding road at 3 to 12 m/s", 1.6),  # 1.68, and 96 %, when only clear bends changed the speed
        ("winding road at 3 to 12 m/s, speed given", 1.2),
    ],
)
def test_yaw_in_bends_is_near_its_bound(kind, ratio):
    """The bound knows the shape of the road."""
    found = measure(kind, range(60_000, 60_006))
    assert found.ratio[1] < ratio
    assert found.within >= 0.97
    if kind.endswith("speed given"):
        assert 0.7 < found.nees < 1.3


def test_the_shape_that_a_filter_is_told_is_that_of_the_road():
    """A clothoid of 1e-5 /m² begins 20 m ahead; the first knot is 4 m behind."""
    moment = Moment((0.0, 0.0, 0.0, 1.5), curvature=lambda s: 1e-5 * (s - 20.0).clamp(min=0.0))
    shape = shape_of(moment, torch.tensor([4.0], dtype=DOUBLE))
    expected = torch.tensor([0.0] * 5 + [1e-5] + [5e-5] * 5, dtype=DOUBLE)
    torch.testing.assert_close(shape[0], expected, atol=2e-7, rtol=0)


def test_a_filter_that_is_told_the_road_begins_again_with_every_drive():
    drive = moments(3 / FPS, lambda _, moment: replace(moment, curvature=lambda s: 1e-4 * s))
    told = KnownRoad(drive, speed=30.0)
    first, second = (track(told, drive, rows=1) for _ in range(2))
    assert torch.equal(first.errors, second.errors)
