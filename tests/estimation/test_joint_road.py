"""How the shape of the road moves with the camera, and its curve."""

import pytest
import torch

from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.filter.update import estimated_entries
from lanebev.estimation.joint.layout import SHAPE, STEPS
from lanebev.estimation.joint.measurement.residuals import NUM_SHAPE
from lanebev.estimation.joint.measurement.road_curve import (
    KNOT_SPACING,
    NUM_STEPS,
    curve_by_shape,
    road_curve,
    road_shape,
)
from lanebev.estimation.joint.motion.road import propagate_road_shape, speed_share, turn_along
from tests.estimation.joint_drives import DOUBLE, PLACE

torch.set_num_threads(1)


def test_road_comes_nearer_by_the_way_that_was_driven():
    """A clothoid seen ahead is the same clothoid after 23 m, of which the knots passed two."""
    rate = 4e-5
    mean = torch.zeros(1, PLACE.size, dtype=DOUBLE)
    mean[:, SHAPE.start] = 1e-3
    mean[:, STEPS] = rate * KNOT_SPACING
    cov = torch.eye(NUM_SHAPE, dtype=DOUBLE)[None] * 1e-10
    cfg = MotionConfig(speed=20.0)
    none = torch.zeros(1, dtype=DOUBLE)
    after = propagate_road_shape(mean, cov, none, torch.tensor([1.15], dtype=DOUBLE), PLACE, cfg)
    assert after.phase.item() == pytest.approx(3.0)
    turned = turn_along(mean[:, SHAPE], none, torch.tensor([23.0], dtype=DOUBLE))[0]
    torch.testing.assert_close(turned, mean[0, SHAPE], rtol=0.02, atol=0.0)  # R > 300 m: a slight turn
    assert after.shape[0, 0].item() == pytest.approx(turned[:3].sum().item())
    steps = torch.cat([turned[3:], turned.new_zeros(2)])
    torch.testing.assert_close(after.shape[0, 1:], steps)
    # an unknown speed is an unknown curvature on a clothoid: by 1 m/s · 1.15 s · rate
    assert after.by_speed[0, 0].item() == pytest.approx(1.15 * rate, rel=0.01)
    torch.testing.assert_close(after.transition[0] @ mean[0, SHAPE], after.shape[0], rtol=0.02, atol=1e-6)


@pytest.mark.parametrize("phase", [0.0, 6.0])
def test_the_curve_is_the_sum_of_its_basis_and_the_integral_of_its_curvature(phase):
    generator = torch.Generator().manual_seed(0)
    shape = 1e-3 * torch.randn(2, NUM_SHAPE, generator=generator, dtype=DOUBLE)
    z = torch.linspace(0.0, 90.0, 9001, dtype=DOUBLE).expand(2, -1)
    behind = torch.full((2,), phase, dtype=DOUBLE)
    road = road_shape(shape, behind)
    curve = road_curve(z, road)
    tilt = torch.linspace(-3.0, 3.0, 9001, dtype=DOUBLE).expand(2, -1)
    rows = torch.cat(curve_by_shape(z, 2 + tilt, tilt, road), dim=1)
    total = (shape.unsqueeze(1) @ rows).squeeze(1)
    torch.testing.assert_close(total, (2 + tilt) * curve.bend + tilt * curve.heading)
    heading = torch.cumulative_trapezoid(curve.curvature, dx=0.01)
    torch.testing.assert_close(curve.heading[:, 1:], heading, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(
        curve.bend[:, 1:], torch.cumulative_trapezoid(curve.heading, dx=0.01), rtol=1e-4, atol=1e-6
    )
    assert (curve.heading[:, 0].abs() < 1e-15).all()


@pytest.mark.parametrize("phase", [0.0, 6.0])
def test_the_frame_turns_along_an_arc_and_its_shape_stays(phase):
    """On an arc the road ahead looks the same everywhere: b'' = κ (1 - κ² Z²)^(-3/2)."""
    curvature, way = 1 / 60, 3.0

    def bend(behind):
        z = KNOT_SPACING * torch.arange(NUM_STEPS + 1, dtype=DOUBLE) - behind
        return curvature * (1 - (curvature * z.clamp(max=36)).square()) ** -1.5

    before = bend(phase)
    shape = torch.cat([before[:1], before.diff()])[None]
    turned = turn_along(shape, *torch.tensor([[phase], [way]], dtype=DOUBLE))[0].cumsum(0)
    near = slice(1, 4)  # knots at 10 to 30 m
    missed = (turned - bend(phase + way))[near].abs().amax()
    assert missed < 0.25 * (before - bend(phase + way))[near].abs().amax()


def test_turning_along_at_once_is_turning_along_in_steps():
    """And a way beyond all knots leaves each with what it has where it is passed."""
    shape = torch.tensor([[1 / 60, 1e-3, 3e-3, -2e-3, 0.0, 0.0]], dtype=DOUBLE)
    none = torch.zeros(1, dtype=DOUBLE)
    at_once = turn_along(shape, none, none + 8.0)
    assert (at_once - shape).abs().max() > 1e-3
    by_steps = shape
    for _ in range(16):  # the knots stay where they are, so they turn about the camera alone
        by_steps = turn_along(by_steps, none, none + 0.5)
    torch.testing.assert_close(by_steps.cumsum(-1), at_once.cumsum(-1), rtol=0.05, atol=0.0)
    far, farther = (turn_along(shape, none, none + way) for way in (50.0, 5000.0))
    torch.testing.assert_close(far, farther)
    assert (turn_along(torch.zeros_like(shape), none, none + 8.0) == 0).all()


def test_steps_like_noise_tell_no_speed():
    """χ² of the five steps, whose mean for noise is 5, of which the first shape has 20 and the second 4."""
    cov = 1e-8 * torch.eye(NUM_SHAPE, dtype=DOUBLE).repeat(2, 1, 1)
    shape = torch.zeros(2, NUM_SHAPE, dtype=DOUBLE)
    shape[0, 1:], shape[1, 1:] = 2e-4, 1e-4 * 0.8**0.5
    torch.testing.assert_close(speed_share(shape, cov), torch.tensor([0.75, 0.0], dtype=DOUBLE))


def test_a_speed_that_the_road_does_not_tell_is_considered():
    """Its gain is multiplied by the share; the shape's uncertainty by it stays in the covariance."""
    std = torch.full((2, 5), 1e-3, dtype=DOUBLE)
    share = torch.tensor([0.0, 0.6], dtype=DOUBLE)
    estimated = estimated_entries(std, share, 6)
    assert estimated[:, PLACE.speed].tolist() == [0.0, 0.6]
    assert torch.equal(estimated.sum(-1), PLACE.size - 1 + share)
    mean = torch.zeros(2, PLACE.size, dtype=DOUBLE)
    mean[:, STEPS] = 1e-5 * torch.arange(5).double()  # in the first row like noise
    cov = torch.tensor([1e-6, 1e-12], dtype=DOUBLE)[:, None, None] * torch.eye(NUM_SHAPE, dtype=DOUBLE)
    none, dt = torch.zeros(2, dtype=DOUBLE), torch.full((2,), 0.1, dtype=DOUBLE)
    by_speed = propagate_road_shape(mean, cov, none, dt, PLACE, MotionConfig()).by_speed
    assert by_speed[0].abs().max() > 0
    torch.testing.assert_close(by_speed[0], by_speed[1])
