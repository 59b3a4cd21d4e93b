"""Line angles, widths, and the search for roll and height."""

import itertools
import math

import pytest
import torch

from lanebev import Extrinsics, LaneSegments
from lanebev.estimation.two_stage import lane_width as lw
from lanebev.geometry.road import segment_rays
from lanebev.geometry.rotation import cam_from_world
from lanebev.testing.segments import project_boundaries

K = torch.tensor([[[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]]], dtype=torch.float64)
OFFSET = -0.25  # m, of the middle of four boundaries 3.7 m apart


def t(*values):
    return [torch.tensor([v], dtype=torch.float64) for v in values]


def boundary_segments(pitch, yaw, roll, height, boundaries=(0, 1, 2, 3)):
    """A segment from 9 to 30 m of each boundary, (1, N, 2, 2), and the pose."""
    params = torch.tensor([[pitch, yaw, roll, height, OFFSET, 0.0, 0.0]], dtype=torch.float64)
    index = torch.tensor([boundaries])
    z = torch.tensor([9.0, 30.0], dtype=torch.float64).expand(1, len(boundaries), 2)
    ends = project_boundaries(params, index, z, K, num_boundaries=4)
    return ends, Extrinsics(*t(pitch, yaw, roll, height))


def angles_of(ends, pose, sigma=1.0, boundary=None):
    rows, n = ends.shape[:2]
    intrinsics = K.expand(rows, 3, 3)
    rays = segment_rays(ends, intrinsics)
    boundary = torch.arange(n).expand(rows, n) if boundary is None else boundary
    weight = torch.ones(rows, n, dtype=torch.float64)
    segments = LaneSegments(ends, boundary, weight, sigma * weight)
    return lw.boundary_angles(segments, rays, intrinsics, pose.pitch, pose.yaw, 4)


@pytest.mark.parametrize(
    ("pitch", "yaw", "roll", "height"),
    list(itertools.product((-0.05, 0.08), (-0.1, 0.1), (-0.3, 0.0, 0.2), (1.2, 2.0))),
)
def test_deviation_angle_positive_to_the_left_makes_widths_exact(pitch, yaw, roll, height):
    ends, pose = boundary_segments(pitch, yaw, roll, height)
    rays = segment_rays(ends, K)
    near, far = lw.line_angles(rays @ cam_from_world(pose.pitch, pose.yaw)).unbind(-1)
    torch.testing.assert_close(near, far)  # in one plane with the vanishing direction
    angles = near
    widths = lw.lane_widths(angles, pose.roll, pose.height)
    torch.testing.assert_close(widths, torch.full((1, 3), 3.7, dtype=torch.float64))
    found = angles_of(ends, pose)
    torch.testing.assert_close(found.angles.tan(), angles.tan())
    # The other sign, or no rotation into the frame of the vanishing direction, is not exact:
    assert (lw.lane_widths(-angles, pose.roll, pose.height) - 3.7).abs().max() > 0.5
    raw = lw.line_angles(rays)[..., 0]
    assert (lw.lane_widths(raw, pose.roll, pose.height) - 3.7).abs().max() > 1e-4


@pytest.mark.parametrize(
    ("roll", "height"), list(itertools.product((-0.35, -0.02, 0.0, 0.1, 0.35), (1.0, 2.3)))
)
def test_initial_roll_and_height_over_all_signs(roll, height):
    ends, pose = boundary_segments(0.03, -0.02, roll, height)
    prior = torch.full((1, 3), 3.7, dtype=torch.float64)
    found = lw.initial_roll_height(angles_of(ends, pose), prior, *t(0.0))
    assert [float(x) for x in found] == pytest.approx([roll, height], abs=1e-9)


def test_deviation_a_sum_of_signed_residuals_has_no_minimum():
    # Eq. (19) as printed falls without end as the height grows; the squares have their minimum at 1.5 m.
    ends, pose = boundary_segments(0.0, 0.0, 0.0, 1.5)
    angles = angles_of(ends, pose).angles
    heights = torch.linspace(1.0, 3.0, 21, dtype=torch.float64)
    errors = torch.stack([3.7 - lw.lane_widths(angles, *t(0.0), h[None]).squeeze() for h in heights])
    assert (errors.sum(-1).diff() < 0).all()
    assert float(heights[errors.square().sum(-1).argmin()]) == pytest.approx(1.5)


def test_energy_is_that_of_the_lanes_in_sight():
    """Eqs. (19), (20) by hand: lanes of 3.5 and 3.8 m count, the one that is not there does not."""
    widths, there = torch.tensor([[3.5, 3.8, 9.0]]).double(), torch.tensor([[True, True, False]])
    residuals = lw.width_residuals(widths, torch.full((1, 3), 3.7).double(), there)
    assert residuals[0].tolist() == pytest.approx([0.2, -0.1, 0.0])
    assert float(lw.width_energy(residuals)) == pytest.approx(0.05)


def test_one_lane_leaves_roll_at_the_guess():
    ends, pose = boundary_segments(0.0, 0.0, 0.1, 1.5, (1, 2))
    found = angles_of(ends, pose)
    prior = torch.full((1, 3), 3.7, dtype=torch.float64)
    roll, height = lw.initial_roll_height(found, prior, *t(0.07))
    assert float(roll) == pytest.approx(0.07)
    assert float(lw.measure_widths(found, roll, height).widths[0, 0]) == pytest.approx(3.7)


def test_a_missed_boundary_is_two_lanes_missed_not_one_twice_as_wide():
    ends, pose = boundary_segments(0.0, 0.0, 0.0, 1.5, (0, 2, 3))
    measured = lw.measure_widths(
        angles_of(ends, pose, boundary=torch.tensor([[0, 2, 3]])), pose.roll, pose.height
    )
    assert measured.present.tolist() == [[False, False, True]]
    assert float(measured.widths[0, 2]) == pytest.approx(3.7)


def test_jacobians_equal_jacfwd():
    ends, pose = boundary_segments(0.03, -0.05, 0.06, 1.4)
    found = angles_of(ends, pose)
    measured = lw.measure_widths(found, pose.roll, pose.height)

    def widths(x):
        return lw.lane_widths(found.angles, x[:1], x[1:])[0]

    expected = torch.func.jacfwd(widths)(torch.cat([pose.roll, pose.height]))
    torch.testing.assert_close(measured.jacobian[0], expected)

    def angles_at(x):
        return angles_of(ends, Extrinsics(x[:1], x[1:], pose.roll, pose.height)).angles[0]

    by_pose = torch.func.jacfwd(angles_at)(torch.cat([pose.pitch, pose.yaw]))
    torch.testing.assert_close(found.jacobian[0], by_pose, rtol=2e-3, atol=1e-4)


def test_width_noise_equals_monte_carlo():
    ends, pose = boundary_segments(0.02, 0.01, 0.03, 1.5)
    noise = lw.measure_widths(angles_of(ends, pose, 0.5), pose.roll, pose.height).noise[0]
    generator = torch.Generator().manual_seed(0)
    runs = 3000
    noisy = ends + 0.5 * torch.randn((runs, *ends.shape[1:]), generator=generator, dtype=torch.float64)
    poses = Extrinsics(*(each.expand(runs) for each in pose))
    cov = torch.cov(lw.measure_widths(angles_of(noisy, poses, 0.5), poses.roll, poses.height).widths.T)
    torch.testing.assert_close(cov.diagonal(), noise.diagonal(), rtol=0.12, atol=0)
    assert float(cov[0, 1] / noise[0, 1]) == pytest.approx(1.0, abs=0.25)


def test_a_segment_far_off_its_boundary_is_left_out_of_its_angle():
    ends, pose = boundary_segments(0.03, -0.02, 0.05, 1.5)
    several = torch.cat([ends.repeat(1, 5, 1, 1), ends[:, :1] + torch.tensor([150.0, 0.0])], dim=1)
    boundary = torch.cat([torch.arange(4).repeat(5), torch.tensor([0])])[None]
    torch.testing.assert_close(
        angles_of(several, pose, boundary=boundary).angles, angles_of(ends, pose).angles
    )


def test_lanes_differ_by_lane_noise():
    ends, pose = boundary_segments(0.0, 0.0, 0.0, 1.5)
    found = angles_of(ends, pose)
    plain, more = (lw.measure_widths(found, pose.roll, pose.height, None, each).noise for each in (0.0, 0.2))
    torch.testing.assert_close(more - plain, 0.04 * torch.eye(3, dtype=torch.float64)[None])


def test_above_the_rolled_horizon_is_not_a_lane():
    found = lw.BoundaryAngles(
        *t([math.atan(a) for a in (1.0, -1.0, -40.0)]),
        *t([1e-6] * 3),
        *t([[0.0, 0.0]] * 3),
        torch.ones(1, 3, dtype=torch.bool),
        *t([[0.0, 0.0]] * 3),
    )
    for roll, there in ((20, [True, False]), (2, [True, False]), (-5, [True, True])):
        measured = lw.measure_widths(found, *t(math.radians(roll)), *t(1.5))
        assert measured.present.tolist() == [there]
        assert measured.widths.isfinite().all()
