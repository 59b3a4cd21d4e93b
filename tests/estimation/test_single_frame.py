"""The single-frame fit: from anywhere, through outliers, and honest about what it cannot see."""

import math

import pytest
import torch
from torch import Tensor

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.frame.boundary_curves import boundary_polylines, fit_boundaries
from lanebev.estimation.joint.frame.single_frame import fit_single_frame
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.measurement.observations import boundary_places, observe
from lanebev.estimation.joint.measurement.residuals import NUM_PARAMS, boundary_residuals
from lanebev.estimation.still import calibrate_still
from lanebev.geometry.road import image_from_road_points
from lanebev.observation.segments import LaneSegments
from lanebev.testing.segments import noisy_segments, project_boundaries
from lanebev.types import Extrinsics

torch.set_num_threads(1)
DOUBLE = torch.float64
CAMERA = torch.tensor([[1050.0, 0.0, 959.5], [0.0, 1050.0, 509.5], [0.0, 0.0, 1.0]], dtype=DOUBLE)


def drive_frames(params: Tensor, sigma: float, seed: int, per_boundary: int = 30, boundaries=range(6)):
    """Segments between random points at 5-60 m of every boundary, for (B, 7) parameters."""
    generator = torch.Generator().manual_seed(seed)
    index = torch.tensor(list(boundaries)).repeat_interleave(per_boundary).expand(params.shape[0], -1)
    inverse = torch.rand(*index.shape, 2, generator=generator, dtype=DOUBLE)
    z = 1 / (1 / 5.0 + (1 / 60.0 - 1 / 5.0) * inverse)
    endpoints = project_boundaries(params, index, z, cameras(params.shape[0]))
    return noisy_segments(endpoints, index, sigma, generator)


def random_params(batch: int, seed: int, degrees: tuple[float, float, float], curvature: float = 0.0):
    generator = torch.Generator().manual_seed(seed)
    half = torch.tensor([*map(math.radians, degrees), 0.4, 1.2, curvature, 0.0], dtype=DOUBLE)
    centre = torch.tensor([0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 0.0], dtype=DOUBLE)
    return centre + half * (2 * torch.rand(batch, NUM_PARAMS, generator=generator, dtype=DOUBLE) - 1)


def cameras(batch: int) -> Tensor:
    return CAMERA.expand(batch, 3, 3)


@pytest.mark.parametrize("curved", [0.0, 1e-3])
def test_residual_jacobian_equals_jacfwd(curved):
    params = random_params(2, 0, (5, 5, 10))
    params[:, 5], params[:, 6] = curved, curved / 100
    seen = observe(drive_frames(params, 0.0, 1, per_boundary=4), cameras(2), 6)
    places = boundary_places(3.7, 6, params).gather(1, seen.boundary)
    found = boundary_residuals(params, places, seen)
    assert found.distance.abs().max() < 1e-9  # the truth lies on its boundaries
    full = torch.func.jacfwd(lambda p: boundary_residuals(p, places, seen).distance)(params)
    expected = torch.stack([full[row, :, :, row] for row in range(2)])
    torch.testing.assert_close(found.jacobian.mT, expected.flatten(1, 2), rtol=1e-9, atol=1e-6)


def test_distance_is_that_in_pixels_also_where_they_are_oblique():
    """A point moved by a pixel across its boundary's image is a pixel off it."""
    oblique = CAMERA * torch.tensor([[1.1], [0.9], [1.0]]).double()
    oblique[0, 1] = 30.0
    params = torch.tensor([[0.05, -0.03, 0.02, 1.5, 0.3, 0.0, 0.0]], dtype=DOUBLE)
    places = boundary_places(3.7, 6, params)
    z = torch.tensor([8.0, 20.0], dtype=DOUBLE)
    road = torch.stack([(places[0, 3] + 0.3).expand(2), z], dim=-1)[None]
    ends, _ = image_from_road_points(road, oblique[None], Extrinsics.unstack(params[:, :4]))
    along = torch.nn.functional.normalize(ends[0, 1] - ends[0, 0], dim=0)
    ends = ends + torch.stack([-along[1], along[0]])
    one = torch.ones(1, 1, dtype=DOUBLE)
    seen = observe(LaneSegments(ends[None], torch.tensor([[3]]), one, one), oblique[None], 6)
    distance = boundary_residuals(params, places[:, 3:4], seen).distance
    torch.testing.assert_close(distance.abs(), torch.ones_like(distance))


def test_a_row_without_a_lane_width_has_the_priors_numbers():
    params = random_params(2, 0, (2, 2, 2))
    segments = drive_frames(params, 0.5, 1)
    width = torch.full((2, 5), 3.7, dtype=DOUBLE)
    alone = fit_single_frame(segments, cameras(2), width)
    width[0, 4] = math.nan
    fit = fit_single_frame(segments, cameras(2), width)
    assert fit.valid.tolist() == [False, True]
    prior = FramePrior()
    torch.testing.assert_close(fit.params()[0], prior.mean(params))
    torch.testing.assert_close(fit.covariance[0].diagonal().sqrt(), prior.std(params))
    torch.testing.assert_close(fit.params()[1], alone.params()[1])


def test_distance_of_a_straight_boundary_is_exact():
    params = torch.tensor([[0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 0.0]], dtype=DOUBLE)
    segments = drive_frames(params, 0.0, 0, per_boundary=2, boundaries=(3,))
    # boundary 3 at X = 1.85, height 1.5: slope 1.85/1.5 in the image; move 10 px along its normal
    normal = torch.tensor([1.5, -1.85], dtype=DOUBLE) / math.hypot(1.5, 1.85)
    moved = segments._replace(endpoints=segments.endpoints + 10 * normal)
    seen = observe(moved, cameras(1), 6)
    places = boundary_places(3.7, 6, params).gather(1, seen.boundary)
    distance = boundary_residuals(params, places, seen).distance
    torch.testing.assert_close(distance, torch.full_like(distance, 10.0))


@pytest.mark.parametrize(
    ("degrees", "curvature"), [((2, 2, 2), 0.0), ((8, 8, 20), 0.0), ((4, 4, 5), 1 / 300)]
)
def test_finds_the_pose_from_anywhere(degrees, curvature):
    truth = random_params(12, 3, degrees, curvature)
    fit = fit_single_frame(drive_frames(truth, 1.0, 4), cameras(12))
    error = fit.params() - truth
    nees = (error.unsqueeze(-2) @ torch.linalg.solve(fit.covariance, error.unsqueeze(-1))).squeeze() / 7
    assert fit.valid.all()
    assert fit.observed.all()
    assert error[:, :3].abs().max() < math.radians(0.3)
    assert error[:, 3].abs().max() < 0.01
    assert 0.6 < nees.mean() < 1.5  # chi2 of 84 degrees of freedom: 0.7..1.35 at 98 %
    assert (fit.inliers > 0.9).double().mean() > 0.98


def test_survives_half_gross_outliers_and_wrong_indices():
    truth = random_params(12, 5, (4, 4, 8), 1 / 500)
    segments = drive_frames(truth, 1.0, 6)
    generator = torch.Generator().manual_seed(7)
    gross = torch.rand(segments.weight.shape, generator=generator) < 0.5
    anywhere = torch.rand(segments.endpoints.shape, generator=generator, dtype=DOUBLE)
    anywhere = anywhere * torch.tensor([1920.0, 510.0], dtype=DOUBLE) + torch.tensor([0.0, 510.0])
    wrong = torch.rand(segments.weight.shape, generator=generator) < 0.05
    shifted = (segments.boundary + torch.randint(1, 6, wrong.shape, generator=generator)) % 6
    segments = segments._replace(
        endpoints=torch.where(gross[..., None, None], anywhere, segments.endpoints),
        boundary=torch.where(wrong, shifted, segments.boundary),
    )
    fit = fit_single_frame(segments, cameras(12))
    error = fit.params() - truth
    assert error[:, :3].abs().max() < math.radians(0.4)
    assert error[:, 3].abs().max() < 0.015
    assert fit.inliers[gross | wrong].mean() < 0.03
    assert fit.inliers[~(gross | wrong)].mean() > 0.95


def test_one_lane_leaves_roll_at_the_prior():
    truth = random_params(8, 8, (3, 3, 0))
    truth[:, 3] = 1.5
    fit = fit_single_frame(drive_frames(truth, 1.0, 9, boundaries=(2, 3)), cameras(8))
    assert fit.valid.all()
    assert fit.observed[:, :2].all()
    assert not fit.observed[:, 2].any()
    assert (fit.extrinsics.roll.abs() < math.radians(2)).all()
    assert (fit.covariance[:, 2, 2].sqrt() > 0.4 * FramePrior().roll_std).all()


def test_one_boundary_is_not_a_pose():
    truth = random_params(4, 10, (1, 1, 1))
    fit = fit_single_frame(drive_frames(truth, 1.0, 11, boundaries=(2,)), cameras(4))
    assert not fit.observed[:, 2:].any()
    assert fit.params().isfinite().all()


def test_rows_are_independent_and_bad_rows_finite():
    truth = random_params(5, 12, (3, 3, 3))
    segments = drive_frames(truth, 1.0, 13, per_boundary=8)
    alone = fit_single_frame(LaneSegments(*(value[:1] for value in segments)), cameras(1))
    matrix = cameras(5).clone()
    segments.endpoints[1] = torch.nan
    segments.weight[2] = 0.0
    segments.endpoints[3] = segments.endpoints[3, :1, :1]  # one point, again and again
    matrix[4] = torch.nan
    fit = fit_single_frame(segments, matrix)
    assert all(value.isfinite().all() for value in (fit.params(), fit.covariance, fit.inliers, fit.scale))
    assert fit.valid.tolist() == [True, False, False, False, False]
    torch.testing.assert_close(fit.params()[:1], alone.params(), rtol=0, atol=1e-9)


def test_order_and_direction_of_segments_do_not_matter():
    truth = random_params(2, 14, (3, 3, 3))
    segments = drive_frames(truth, 1.0, 15, per_boundary=8)
    order = torch.randperm(48, generator=torch.Generator().manual_seed(1))
    mixed = LaneSegments(*(value[:, order] for value in segments))
    mixed = mixed._replace(endpoints=mixed.endpoints.flip(2))
    one, other = fit_single_frame(segments, cameras(2)), fit_single_frame(mixed, cameras(2))
    torch.testing.assert_close(one.params(), other.params(), rtol=0, atol=1e-9)


def test_gradient_reaches_the_endpoints():
    truth = random_params(1, 16, (2, 2, 2))
    segments = drive_frames(truth, 0.5, 17, per_boundary=6)

    def pitch(points: Tensor) -> Tensor:
        fit = fit_single_frame(segments._replace(endpoints=points), cameras(1), iterations=12)
        return fit.extrinsics.pitch.sum()

    points = segments.endpoints.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(pitch(points), points)
    direction = torch.randn(points.shape, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    step = 1e-4 * direction
    numeric = (pitch(segments.endpoints + step) - pitch(segments.endpoints - step)) / 2e-4
    torch.testing.assert_close((gradient * direction).sum(), numeric, rtol=0.02, atol=0)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"pitch_std": 0.0}, "pitch_std: expected more than 0, got 0.0"),
        ({"roll_steps": 0}, "roll_steps: expected at least 1, got 0"),
        ({"roll": math.nan}, "roll: expected a finite number, got nan"),
        ({"height": 0.0}, "height: expected more than 0 m, got 0.0"),
        ({"freedom": 0.0}, "freedom: expected more than 0, got 0.0"),
    ],
)
def test_a_prior_that_is_none_is_refused(numbers, message):
    with pytest.raises(ValueError, match=message):
        FramePrior(**numbers)


def test_a_search_of_one_step_is_at_the_mean():
    prior = FramePrior(pitch=0.03, roll=0.01, pitch_steps=1, roll_steps=1)
    truth = torch.tensor([[0.03, 0.02, 0.01, 1.5, 0.0, 0.0, 0.0]], dtype=DOUBLE)
    fit = fit_single_frame(drive_frames(truth, 0.5, 3), cameras(1), prior=prior)
    assert bool(fit.valid[0])
    assert (fit.extrinsics.stack() - truth[:, :4]).abs().max() < 0.01


def test_wrong_shapes_are_one_clear_line():
    segments = drive_frames(random_params(2, 18, (1, 1, 1)), 1.0, 19, per_boundary=2)
    with pytest.raises(ValueError, match=r"segments.weight: expected \(2, 12\)"):
        fit_single_frame(segments._replace(weight=segments.weight[:, :3]), cameras(2))
    with pytest.raises(ValueError, match=r"intrinsics: expected \(2, 3, 3\), got \(3, 3\)"):
        fit_single_frame(segments, CAMERA)
    with pytest.raises(ValueError, match=r"lane_width: expected a float, \(2,\) or \(2, 5\), got \(2, 3\)"):
        fit_single_frame(segments, cameras(2), lane_width=torch.full((2, 3), 3.7))


def test_boundaries_of_unequal_lanes_and_their_polylines():
    truth = random_params(3, 20, (2, 2, 2), 1e-3)
    segments = drive_frames(truth, 0.3, 21)
    pose = Extrinsics.unstack(truth[:, :4])
    segments.weight[:, segments.boundary[0] == 5] = 0.0
    widened = truth.clone()
    widened[:, 4] += 0.4  # boundary 4 stands 40 cm farther right
    other = drive_frames(widened, 0.3, 21)
    is_4 = segments.boundary[0] == 4
    segments.endpoints[:, is_4] = other.endpoints[:, is_4]
    found = fit_boundaries(segments, cameras(3), pose)
    expected = boundary_places(3.7, 6, truth) + truth[:, 4:5]
    expected[:, 4] += 0.4
    assert found.present.tolist() == [[True] * 5 + [False]] * 3
    assert (found.offset - expected)[:, :5].abs().max() < 0.03
    lines, visible = boundary_polylines(found, cameras(3), pose, num_points=16)
    assert lines.shape == (3, 6, 16, 2)
    assert visible[:, :5].all()
    assert not visible[:, 5].any()
    seen = observe(
        segments._replace(
            endpoints=lines[:, 4].view(3, 8, 2, 2),
            boundary=torch.full((3, 8), 4),
            weight=torch.ones(3, 8),
            sigma=torch.ones(3, 8),
        ),
        cameras(3),
        6,
    )
    places = expected[:, 4:5].expand(3, 8) - truth[:, 4:5]
    assert boundary_residuals(truth, places, seen).distance.abs().max() < 2.0


def test_a_sharp_line_beside_a_vague_one_is_no_outlier():
    """Where the vague one leads the search astray, that is by far more than the sharp one's sigma."""
    frames = drive_frames(random_params(16, 4, (2, 2, 1)), 0.1, 5, per_boundary=8, boundaries=(2, 3))
    vague = frames.boundary == 3
    sideways = 4.0 * torch.randn(16, 1, 1, 1, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    frames = frames._replace(
        endpoints=frames.endpoints + vague[..., None, None] * sideways * torch.tensor([1.0, 0.0]),
        sigma=torch.where(vague, 8.0, frames.sigma),
    )
    found = fit_single_frame(frames, cameras(16))
    assert (found.inliers[~vague] > 0.5).all()
    assert found.valid.all()


def test_autocast_changes_nothing():
    frames = drive_frames(random_params(2, 4, (2, 2, 1)), 1.0, 5)
    expected = fit_single_frame(frames, cameras(2))
    with torch.autocast("cpu", torch.bfloat16):
        found = fit_single_frame(frames, cameras(2))
    assert torch.equal(found.covariance, expected.covariance)


def test_a_still_of_a_bend_says_how_sure_it_is():
    """R = 700 m, which vague lines hardly tell from straight: all they know is needed to tell."""
    params = random_params(48, 6, (1, 1, 1))
    params[:, 5] = 1 / 700
    frames = drive_frames(params, 2.5, 7, per_boundary=12, boundaries=(1, 2, 3, 4))
    found = calibrate_still(JointCalibrator(), frames, cameras(48), 3.7)
    error = found.extrinsics.stack() - params[:, :4]
    nees = (error.unsqueeze(1) @ torch.linalg.solve(found.covariance, error.unsqueeze(-1))).mean() / 4
    assert nees < 2


def test_curvature_is_common_to_all_boundaries():
    truth = random_params(8, 22, (2, 2, 2), 1e-3)
    segments = drive_frames(truth, 0.1, 23)
    pose = Extrinsics.unstack(truth[:, :4])
    found = fit_boundaries(segments, cameras(8), pose)
    assert truth[:, 5].abs().max() > 5e-4
    assert (found.curvature[:, 0] - truth[:, 5]).abs().max() < 5e-5
    assert (found.offset - boundary_places(3.7, 6, truth) - truth[:, 4:5]).abs().max() < 0.02
    alone = fit_boundaries(
        LaneSegments(*(part[3:4] for part in segments)), cameras(1), Extrinsics.unstack(truth[3:4, :4])
    )
    torch.testing.assert_close(alone.curvature, found.curvature[3:4])
