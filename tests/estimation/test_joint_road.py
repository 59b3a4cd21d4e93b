"""How the shape of the road moves with the camera, and its curve."""

import math

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.filter.update import estimated_entries
from lanebev.estimation.joint.layout import SHAPE, STEPS
from lanebev.estimation.joint.measurement.residuals import NUM_SHAPE
from lanebev.estimation.joint.measurement.road_curve import (
    KNOT_SPACING,
    NUM_STEPS,
    arc_beside,
    lateral_by_shape,
    road_points,
    road_shape,
)
from lanebev.estimation.joint.motion.road import propagate_road_shape, sharp_bend_walk, speed_share
from lanebev.tensors import map_tensors
from lanebev.testing.moments import CAMERA, WIDTH
from tests.estimation.joint_drives import DOUBLE, PLACE
from tools.bench_kinds import drawn
from tools.random_drives import TURN

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
    assert after.phase.item() == pytest.approx(3.0)  # four knots of 5 m were passed
    clothoid = mean[0, SHAPE]
    assert after.shape[0, 0].item() == pytest.approx(clothoid[:5].sum().item())
    torch.testing.assert_close(after.shape[0, 1:], torch.cat([clothoid[5:], clothoid.new_zeros(4)]))
    # an unknown speed is an unknown curvature on a clothoid: by 1 m/s · 1.15 s · rate
    assert after.by_speed[0, 0].item() == pytest.approx(1.15 * rate, rel=0.01)
    torch.testing.assert_close(after.transition[0] @ mean[0, SHAPE], after.shape[0], rtol=0.02, atol=1e-6)


@pytest.mark.parametrize("phase", [0.0, 4.0])
def test_the_middle_line_is_the_integral_of_its_curvature(phase):
    """It begins at the camera in the direction of Z, in bends up to R = 20 m."""
    generator = torch.Generator().manual_seed(0)
    shape = 2e-3 * torch.randn(2, NUM_SHAPE, generator=generator, dtype=DOUBLE)
    shape[1, 0] = 0.05
    behind = torch.full((2,), phase, dtype=DOUBLE)
    arc = torch.linspace(0.0, 20.0, 2001, dtype=DOUBLE).expand(2, -1)
    line = road_points(arc, road_shape(shape, behind))
    knots = KNOT_SPACING * torch.arange(NUM_STEPS, dtype=DOUBLE)
    ramps = ((arc[0] + phase - knots[:, None]) / KNOT_SPACING).clamp(0.0, 1.0)
    torch.testing.assert_close(line.curvature, shape[:, :1] + shape[:, 1:] @ ramps)
    heading = torch.atan2(line.sin, line.cos)
    assert heading.abs().max() > 0.8
    for value, by_arc in ((heading, line.curvature), (line.x, line.sin), (line.z, line.cos)):
        assert value[:, 0].abs().max() < 1e-12
        integral = torch.cumulative_trapezoid(by_arc, dx=0.01)
        torch.testing.assert_close(value[:, 1:], integral, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("phase", "size"), [(0.0, 1e-4), (4.0, 2e-3), (None, 1e-3)])
def test_the_lateral_derivative_is_that_of_the_points_across_the_line(phase, size):
    generator = torch.Generator().manual_seed(0)
    shape = size * torch.randn(2, 2 if phase is None else NUM_SHAPE, generator=generator, dtype=DOUBLE)
    if phase is None:
        shape[:, 1] /= 100
    behind = None if phase is None else torch.full((2,), phase, dtype=DOUBLE)
    arc = 40 * torch.rand(2, 30, generator=generator, dtype=DOUBLE)
    road = road_shape(shape, behind)
    at = road_points(arc, road)

    def across(changed):
        line = road_points(arc, road_shape(changed, behind))
        return line.x * at.cos - line.z * at.sin

    full = torch.func.jacfwd(across)(shape)
    expected = torch.stack([full[row, :, row] for row in range(2)]).mT
    found = lateral_by_shape(at, road)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))


def test_a_point_is_beside_the_nearest_one_of_the_middle_line():
    """On an arc of R = 20 m, 3 m inside and outside of it."""
    shape = torch.zeros(1, NUM_SHAPE, dtype=DOUBLE)
    shape[0, 0] = 0.05
    road = road_shape(shape, torch.zeros(1, dtype=DOUBLE))
    angle = torch.linspace(0.1, 1.0, 10, dtype=DOUBLE).repeat(2)[None]
    radius = torch.tensor([17.0, 23.0], dtype=DOUBLE).repeat_interleave(10)[None]
    x, z = 20 - radius * angle.cos(), radius * angle.sin()
    arc = z
    for _ in range(2):  # the filter takes as many steps: one for the end point, one for its foot point
        arc = arc_beside(x, z, road_points(arc, road))
    torch.testing.assert_close(arc, 20 * angle, rtol=0, atol=0.03)


def test_beyond_the_largest_heading_the_middle_line_is_straight():
    shape = torch.zeros(1, NUM_SHAPE, dtype=DOUBLE)
    shape[0, 0] = 0.05
    far = road_points(
        torch.tensor([[40.0, 60.0, 80.0]], dtype=DOUBLE), road_shape(shape, torch.zeros(1).double())
    )
    torch.testing.assert_close(far.sin, torch.full_like(far.sin, math.sin(1.2)))
    torch.testing.assert_close(far.x.diff(), 20 * far.sin[:, 1:])
    assert (far.curvature == 0).all()


def test_only_in_a_sharp_bend_the_curvature_of_the_knots_walks():
    shape = torch.zeros(4, NUM_SHAPE, dtype=DOUBLE)
    shape[:, 0] = torch.tensor([1 / 25, 1 / 300, 1 / 15, -100.0])
    std = sharp_bend_walk(shape).sqrt()
    torch.testing.assert_close(std[0], torch.full_like(std[0], 0.12 / 25))
    assert (std[1] < 3e-6).all()
    torch.testing.assert_close(std[3], std[2])


def test_the_road_beyond_what_is_seen_of_a_sharp_turn_stays_possible():
    """The far knots of a turn are beyond the heading up to which the line bends, so nothing shows them."""
    [drive] = drawn(TURN, [20_011])
    calibrator, sharpest = JointCalibrator(), 0.0
    state = calibrator.initial_state(1, dtype=DOUBLE)
    for frame in range(len(drive.dt)):
        seen = map_tensors(lambda part, at=frame: part[at : at + 1], drive.segments)
        _, state = calibrator(seen, CAMERA[None].double(), state, drive.dt[frame : frame + 1], WIDTH)
        sharpest = max(sharpest, float(state.mean[:, SHAPE].cumsum(-1).abs().max()))
    assert 0.05 < sharpest < 0.2  # 1/m


def test_steps_like_noise_tell_no_speed():
    """χ² of the ten steps, which is 20 in the first row and 4 in the second; noise has less than 5."""
    cov = 1e-8 * torch.eye(NUM_SHAPE, dtype=DOUBLE).repeat(2, 1, 1)
    shape = torch.zeros(2, NUM_SHAPE, dtype=DOUBLE)
    shape[0, 1:], shape[1, 1:] = 1e-4 * 2**0.5, 1e-4 * 0.4**0.5
    torch.testing.assert_close(speed_share(shape, cov), torch.tensor([0.75, 0.0], dtype=DOUBLE))


def test_a_speed_that_the_road_does_not_tell_is_considered():
    """Its gain is multiplied by the share; the shape's uncertainty by it stays in the covariance."""
    std = torch.full((2, 5), 1e-3, dtype=DOUBLE)
    share = torch.tensor([0.0, 0.6], dtype=DOUBLE)
    estimated = estimated_entries(std, share, 6)
    assert estimated[:, PLACE.speed].tolist() == [0.0, 0.6]
    assert torch.equal(estimated.sum(-1), PLACE.size - 1 + share)
    mean = torch.zeros(2, PLACE.size, dtype=DOUBLE)
    mean[:, STEPS] = 1e-5 * torch.arange(NUM_STEPS).double()  # in the first row like noise
    cov = torch.tensor([1e-6, 1e-12], dtype=DOUBLE)[:, None, None] * torch.eye(NUM_SHAPE, dtype=DOUBLE)
    none, dt = torch.zeros(2, dtype=DOUBLE), torch.full((2,), 0.1, dtype=DOUBLE)
    by_speed = propagate_road_shape(mean, cov, none, dt, PLACE, MotionConfig()).by_speed
    assert by_speed[0].abs().max() > 0
    torch.testing.assert_close(by_speed[0], by_speed[1])
