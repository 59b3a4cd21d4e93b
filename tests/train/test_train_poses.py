import json
import math
import sys
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lanebev.geometry.lens import distort_points
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.render import render_views
from lanebev.types import Extrinsics
from lanebev.weights import save_segmenter
from train import evaluate_poses
from train.data import LiveFrames, PoolFrames
from train.end_to_end import EndToEnd, gradient_ratio
from train.labels import ViewConfig
from train.module import unpack
from train.pool import read_shard, write_shard
from train.poses import GradientClip, PoseBatch, PoseBatches, fit_poses, pose_loss, student_t_nll

SIZE = (144, 256)


@pytest.fixture(scope="module")
def rendered():
    return render_views(4, (72, 128), torch.Generator().manual_seed(5))


@pytest.fixture(scope="module")
def batch():
    return next(iter(PoseBatches(LiveFrames((72, 128)), 6, SIZE, ViewConfig(), seed=(3,))))


def logits_of(batch):
    return unpack(batch)[1].clamp(min=1e-4).log()


@pytest.fixture
def trainer():
    """Of which a step asks how often to log."""
    return SimpleNamespace(log_every_n_steps=1)


def fit(logits, batch, **options):
    camera = (batch.intrinsics, batch.distortion, batch.lane_width)
    return fit_poses(logits, SIZE, *camera, LineExtractor(), **options)


def test_shards_keep_the_pose(rendered, tmp_path):
    write_shard(tmp_path / "a.npz", [rendered])
    shard = read_shard(tmp_path / "a.npz")
    pose = shard.pose(2)
    np.testing.assert_allclose(pose.extrinsics, rendered.extrinsics.stack()[2], rtol=1e-6)
    np.testing.assert_allclose(pose.lane_width, rendered.lane_width[2], rtol=1e-6)
    samples = list(zip(range(8), PoolFrames(tmp_path).posed((0,)), strict=False))
    assert len({tuple(pose.extrinsics) for _, (_, pose) in samples}) == 4
    (tmp_path / "a.npz").write_bytes(b"cut")
    with pytest.raises(ValueError, match="expected a pool shard with jpeg"):
        read_shard(tmp_path / "a.npz")


def test_frames_go_on_from_any_of_them(rendered, tmp_path):
    for name in "abcde":
        write_shard(tmp_path / f"{name}.npz", [rendered])
    pool, live = PoolFrames(tmp_path, resident=2), LiveFrames((36, 64), batch=3)
    for frames, first, count in ((pool, 26, 6), (live, 4, 4)):
        whole = [frame.image for frame, _ in zip(frames((1, 2)), range(first + count), strict=False)]
        rest = [frame.image for frame, _ in zip(frames((1, 2), first), range(count), strict=False)]
        assert all(map(np.array_equal, whole[first:], rest))


def test_a_round_of_the_pool_has_every_shard_once(rendered, tmp_path):
    for name in "abcde":
        write_shard(tmp_path / f"{name}.npz", [rendered])
    seen = Counter()
    pool = PoolFrames(tmp_path, resident=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.data.read_shard", lambda path: seen.update([path.name]) or read_shard(path))
        for _ in zip(range(2 * 5 * 4), pool((0,)), strict=False):
            pass
    assert set(seen.values()) == {2}


def test_resized_intrinsics_project_to_resized_pixels(rendered, tmp_path):
    """A pixel (x, y) of the frame is (2x + 0.5, 2y + 0.5) of one twice as large, lens and all."""
    write_shard(tmp_path / "a.npz", [rendered])
    shard = read_shard(tmp_path / "a.npz")
    two = PoseBatch.stack([(shard.frame(0), shard.pose(0))], SIZE, ViewConfig())
    plane = torch.tensor([[[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]]])
    small = distort_points(
        (plane @ rendered.intrinsics[:1].mT)[..., :2], rendered.intrinsics[:1], two.distortion
    )
    large = distort_points((plane @ two.intrinsics.mT)[..., :2], two.intrinsics, two.distortion)
    torch.testing.assert_close(large, 2 * small + 0.5, atol=1e-3, rtol=0)


def test_labels_lead_to_the_pose(batch):
    found = fit(logits_of(batch), batch)
    error = (found.extrinsics.stack() - batch.extrinsics)[found.valid]
    assert found.valid.sum() >= 4
    assert error[:, 0].abs().median() < math.radians(0.1)
    assert error[:, 3].abs().median() < 0.05


def test_pose_loss_counts_what_was_said(batch):
    found = fit(logits_of(batch), batch)
    unit = torch.ones(4, dtype=torch.float64)
    truth = found.extrinsics.stack()
    assert pose_loss(found, truth, unit) == 0
    shifted = truth + torch.tensor([3.0**0.5, 0, 0, 0])  # Charbonnier of sqrt(3) is 1
    torch.testing.assert_close(pose_loss(found, shifted, unit), unit.new_tensor(1.0))
    nothing = found._replace(valid=torch.zeros_like(found.valid))
    assert pose_loss(nothing, shifted, unit) == 0
    torch.testing.assert_close(pose_loss(nothing, shifted, unit, with_prior=True), unit.new_tensor(1.0))
    broken = Extrinsics(*(torch.full_like(part, torch.nan) for part in found.extrinsics))
    assert pose_loss(found._replace(extrinsics=broken), truth, unit, with_prior=True) == 0


@pytest.mark.slow
def test_gradient_of_the_pose_lowers_its_error(batch):
    """Maps shifted sideways by a label pixel: following the gradient for a few steps turns the pose back."""
    logits = logits_of(batch).roll(1, dims=-1).double().requires_grad_()
    unit = torch.tensor([0.005, 0.005, 0.01, 0.05], dtype=torch.float64)
    losses = []
    for _ in range(8):
        loss = pose_loss(fit(logits, batch), batch.extrinsics.double(), unit)
        (gradient,) = torch.autograd.grad(loss, logits)
        assert gradient.isfinite().all()
        losses.append(loss.item())
        logits = (
            logits - 0.3 * gradient / gradient.abs().amax((1, 2, 3), keepdim=True).clamp(min=1e-9)
        ).detach()
        logits.requires_grad_()
    assert losses[-1] < 0.9 * losses[0]


def faint_logits(share):
    """Strengths (L, 1, 1) of the boundaries' maps, all 1, and the logits of maps (B, L, h, w) times these."""
    faint = torch.ones(6, 1, 1, dtype=torch.float64, requires_grad=True)
    maps = torch.cat([1 - (faint * share).sum(1, keepdim=True), faint * share], dim=1)
    return faint, maps.clamp(min=1e-6).log()


def test_fainter_lines_are_no_way_to_a_better_pose(batch):
    """A map as a whole made fainter lies where it lay: with ``detach_confidence`` that has no gradient."""
    unit = torch.tensor([0.005, 0.005, 0.01, 0.05], dtype=torch.float64)
    share = (unpack(batch)[1][:, 1:].double() * 0.5).roll(1, dims=-1)
    slopes = []
    for detach_confidence in (False, True):
        faint, logits = faint_logits(share)
        found = fit(logits, batch, detach_confidence=detach_confidence)
        (slope,) = torch.autograd.grad(pose_loss(found, batch.extrinsics.double(), unit), faint)
        slopes.append(slope.norm())
    assert slopes[1] < 0.1 * slopes[0]


def test_likelihood_is_largest_where_sigmas_are_the_errors(batch):
    """Errors of 0.1: sigmas that say so are better than a tenth of them, and than ten times as much."""
    found = fit(logits_of(batch), batch)
    floor = torch.full((4,), 0.01, dtype=torch.float64)
    truth = found.extrinsics.stack() + 0.1
    sizes = (0.01, 0.1, 1.0)
    eye = torch.eye(7, dtype=torch.float64).expand(len(truth), 7, 7)
    scores = [student_t_nll(found._replace(covariance=s**2 * eye), truth, floor) for s in sizes]
    assert scores[1] < min(scores[0], scores[2])
    widened = student_t_nll(found._replace(covariance=0.01 * eye), truth, floor, factor=10.0)
    torch.testing.assert_close(widened, scores[2])
    broken = found._replace(covariance=torch.full_like(eye, torch.nan))
    assert student_t_nll(broken, truth, floor) == 0


def test_likelihood_asks_for_what_can_be_seen(batch):
    """Faint maps where the truth is: stronger ones lower the loss, which errors alone don't ask for."""
    floor = torch.tensor([0.0005, 0.0015, 0.002, 0.005], dtype=torch.float64)
    faint, logits = faint_logits(unpack(batch)[1][:, 1:].double() * 0.6)
    found = fit(logits, batch)
    (slope,) = torch.autograd.grad(student_t_nll(found, batch.extrinsics.double(), floor), faint)
    assert slope.isfinite().all()
    assert slope.sum() < 0


@pytest.mark.parametrize("reach", [1.0, 4.0])
def test_even_gradients_are_no_longer_than_so_many_medians(reach):
    x = torch.zeros(4, 2, requires_grad=True)
    slope = torch.tensor([[3.0, 4], [0, 1], [300, 400], [float("nan"), 1]])
    (GradientClip.apply(x, reach) * slope).sum().backward()
    # lengths 5, 1, 500 and none: the (lower) median is 1
    long = reach * torch.tensor([0.6, 0.8])
    torch.testing.assert_close(x.grad, torch.stack([long, slope[1], long, torch.zeros(2)]))


@pytest.mark.parametrize(("likelihood", "error_weight"), [(False, 0.0), (True, 0.0), (True, 2.0)])
def test_empty_maps_train_on_finite_gradients(batch, trainer, likelihood, error_weight):
    torch.manual_seed(0)
    network = SegmenterConfig(base_width=4, decoder_width=4)
    model = EndToEnd(network=network, augment=0.0, likelihood=likelihood, error_weight=error_weight)
    model.trainer = trainer
    model.log = model.log_dict = lambda *args, **kwargs: None
    model.training_step(batch, 0).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


def test_errors_count_beside_likelihood(batch, trainer):
    """Boundaries that are elsewhere: the loss is higher by the errors, as often as they are weighed."""
    losses = []
    for error_weight in (0.0, 1.0, 3.0):
        torch.manual_seed(0)
        network = SegmenterConfig(base_width=4, decoder_width=4)
        model = EndToEnd(
            network=network, augment=0.0, likelihood=True, error_weight=error_weight, pose_weight=1.0
        )
        model.trainer = trainer
        model.log = model.log_dict = lambda *args, **kwargs: None
        losses.append(model.training_step(batch, 0).detach())
    assert losses[1] > losses[0] + 0.1
    torch.testing.assert_close(losses[2] - losses[0], 3 * (losses[1] - losses[0]), rtol=1e-3, atol=1e-4)
    with pytest.raises(ValueError, match="error_weight: expected 0 without likelihood"):
        EndToEnd(error_weight=1.0)


@pytest.mark.parametrize(("every", "logged"), [(1, True), (3, True), (2, False)])
def test_the_share_of_the_poses_gradient_is_logged_with_the_rest(batch, every, logged):
    """Of step 2, the third, in as many as are logged; twice the weight is twice the ratio."""
    ratios = []
    for pose_weight in (0.01, 0.02):
        network = SegmenterConfig(base_width=4, decoder_width=4)
        model = EndToEnd(network=network, pose_weight=pose_weight)
        model.trainer = SimpleNamespace(log_every_n_steps=every)
        seen = {}
        model.log = lambda name, value, seen=seen, **kwargs: seen.update({name: value})
        logits = (0.9 * logits_of(batch)).requires_grad_()
        model.map_loss = lambda batch, number, logits=logits: (logits.square().mean(), logits)
        model.training_step(batch, 2).backward()
        assert ("gradient/pose_by_maps" in seen) == logged
        ratios.append(seen.get("gradient/pose_by_maps"))
    if logged:
        assert ratios[0] > 0
        torch.testing.assert_close(ratios[1], 2 * ratios[0])


def test_gradient_ratio():
    """Of 6 x and 3 x at (3, 4): lengths 5 by 6 and 3."""
    x = torch.tensor([[3.0, 4.0]], requires_grad=True)
    loss, by = 3 * x.square().sum(), 1.5 * x.square().sum()
    torch.testing.assert_close(gradient_ratio(loss, by, x), torch.tensor(2.0))
    assert gradient_ratio(0 * loss, by, x) == 0
    (loss + by).backward()  # the graph is still there
    torch.testing.assert_close(x.grad, 9 * x.detach())


@pytest.mark.slow
def test_evaluate_poses_reports_both(tmp_path, capsys, monkeypatch):
    torch.manual_seed(0)
    for name in ("before", "after"):
        network = LaneSegmenter(SegmenterConfig(base_width=4, decoder_width=4))
        save_segmenter(network, tmp_path / f"{name}.safetensors")
    paths = [str(tmp_path / f"{name}.safetensors") for name in ("before", "after")]
    options = ["--drives", "2", "--frames", "1", "--size", "64", "96"]
    monkeypatch.setattr(sys, "argv", ["evaluate_poses", *paths, *options])
    evaluate_poses.main()
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["weights"] for line in lines] == ["before.safetensors", "after.safetensors"]
    for counted in ("observed", "every_frame"):
        assert set(lines[0][counted]) == set(evaluate_poses.AXES)
        assert set(lines[1][counted]) == {*evaluate_poses.AXES, "rmse_below_first_by"}
    assert lines[0]["observed"]["roll_deg"]["frames"] < lines[0]["every_frame"]["roll_deg"]["frames"] == 2
    online = ["--online", "--drives", "1", "--frames", "12"]
    monkeypatch.setattr(sys, "argv", ["evaluate_poses", paths[0], *online])
    evaluate_poses.main()
    line = json.loads(capsys.readouterr().out)
    assert "observed" not in line
    assert line["every_frame"]["pitch_deg"]["frames"] == 2  # after ten frames of warm-up
    monkeypatch.setattr(sys, "argv", ["evaluate_poses", str(tmp_path / "none.safetensors")])
    with pytest.raises(SystemExit) as stop:
        evaluate_poses.main()
    assert stop.value.code == 2


def test_pose_error_summary():
    """Two frames off by 3 and 4 deg in pitch, one more that does not count."""
    error = torch.zeros(3, 4, dtype=torch.float64)
    error[:, 0] = torch.tensor([3.0, -4.0, 90.0]).deg2rad()
    error[:, 3] = torch.tensor([0.05, 0.05, 0.05])
    counted = torch.tensor([[True] * 4, [True] * 4, [False] * 3 + [True]])
    report = evaluate_poses.summary(error, counted)
    assert report["pitch_deg"] == {"rmse": round(12.5**0.5, 3), "median": 3.0, "frames": 2}
    assert report["height_cm"] == {"rmse": 5.0, "median": 5.0, "frames": 3}


def test_gain_is_an_interval_over_drives():
    """Half the error is a gain for sure; as much noise of its own, drive by drive, is none."""
    torch.manual_seed(0)
    before = torch.randn(40 * 5, 4, dtype=torch.float64)
    counted = torch.rand(200, 4) < 0.9
    found = evaluate_poses.gain(before, 0.5 * before, counted, 40)
    rmse = evaluate_poses.summary(before, counted)
    for name, (low, high) in found.items():
        assert 0 < low < 0.5 * rmse[name]["rmse"] < high
    found = evaluate_poses.gain(before, torch.randn_like(before), counted, 40)
    assert all(low < 0 < high for low, high in found.values())
    drives = torch.randn(40, 1, 4, dtype=torch.float64).expand(40, 5, 4).reshape(200, 4)
    wide = evaluate_poses.gain(drives, 0.0 * drives, counted, 40)
    narrow = evaluate_poses.gain(drives, 0.0 * drives, counted, 200)
    assert all(wide[name][1] - wide[name][0] > narrow[name][1] - narrow[name][0] for name in wide)
