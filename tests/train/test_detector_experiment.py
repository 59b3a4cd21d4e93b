"""The shaking drives, what each arm takes for the pose, and the whole experiment at the least size."""

import json
import math
from pathlib import Path

import av
import pytest
import torch

from lanebev.pipeline import LaneBEV
from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid
from train.detector.__main__ import main, train_arm
from train.detector.drives import (
    MOUNT_ERROR,
    NOMINAL,
    SHAKE,
    WARM_UP,
    ShakingDrive,
    image_bearings,
    read_drive,
    render_drive,
    write_drive,
)
from train.detector.frames import DriveFrames, StepBatches, mirrored
from train.detector.module import NOISE, DetectorTraining, arm_poses, one_cycle
from train.detector.network import VehicleDetector
from train.detector.predict import OFFSETS_DEG, offset_poses
from train.detector.settings import Experiment
from train.detector.table import main as show
from train.detector.video import main as film

GRID = BEVGrid(x=(-8.0, 8.0), z=(4.0, 36.0), resolution=2.0)
SIZE = (96, 160)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    lanes = LaneBEV.from_pretrained(network_width=160).eval()
    folder = tmp_path_factory.mktemp("drives")
    for seed in (3, 4):
        write_drive(folder / f"{seed}.npz", render_drive(seed, WARM_UP + 2, SIZE, 10.0, lanes))
    return folder


@pytest.mark.slow
def test_the_camera_shakes_about_a_mount_that_is_off():
    poses = torch.stack([
        ShakingDrive(seed, image_size=(16, 32), num_frames=100, fps=10.0).extrinsics_at(t).stack()[0]
        for seed in range(8)
        for t in range(10)
    ]).unflatten(0, (8, 10))  # fmt: skip
    off = poses.mean(1) - torch.tensor(NOMINAL)
    assert (off[:, :3].abs() < MOUNT_ERROR + math.radians(0.8)).all()
    assert off[:, 0].abs().max() > 0.3 * MOUNT_ERROR
    spread = (poses - poses.mean(1, keepdim=True)).square().mean((0, 1)).sqrt()
    for axis in (0, 2, 3):  # half the amplitude; yaw has the course within the lane too
        assert float(spread[axis]) == pytest.approx(0.5 * SHAKE[axis], rel=0.35)


def test_edges_of_the_image_are_bearings_on_the_road():
    intrinsics = torch.tensor([[[100.0, 0, 99.5], [0, 100.0, 50], [0, 0, 1]]])
    left, right = image_bearings(intrinsics, torch.tensor([0.1]), 200)[0].tolist()
    assert (left, right) == pytest.approx((-math.pi / 4 - 0.1, math.pi / 4 - 0.1))  # looks left


@pytest.mark.slow
def test_a_drive_comes_back_from_its_file(folder, tmp_path):
    record = read_drive(folder / "3.npz")
    assert record.images().shape == (WARM_UP + 2, *SIZE, 3)
    write_drive(tmp_path / "again.npz", record)
    again = read_drive(tmp_path / "again.npz")
    assert (again.online == record.online).all()
    assert all(torch.equal(a, b) for a, b in zip(again.state, record.state, strict=True))
    (tmp_path / "other.npz").write_bytes(b"no drive")
    with pytest.raises(ValueError, match="expected a drive"):
        read_drive(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="expected drives, got none"):
        DriveFrames(tmp_path / "nothing", GRID)


@pytest.mark.slow
def test_each_arm_takes_its_own_pose(folder):
    frames = DriveFrames(folder, GRID).frames
    assert len(frames.image) == 4
    nominal = torch.tensor(NOMINAL).expand(4, 4)
    assert torch.equal(arm_poses("true", frames), frames.extrinsics)
    assert torch.equal(arm_poses("online", frames), frames.online)
    torch.testing.assert_close(arm_poses("nominal", frames), nominal)
    torch.testing.assert_close(arm_poses("noisy", frames), nominal)
    noisy = arm_poses("noisy", frames, torch.ones(4, 4))
    torch.testing.assert_close(noisy, nominal + torch.tensor(NOISE))


def test_a_mirrored_frame_is_seen_by_a_mirrored_camera(folder):
    frames = DriveFrames(folder, GRID).frames
    twice = mirrored(mirrored(frames))
    for name in ("image", "boxes", "extrinsics", "online", "intrinsics"):
        torch.testing.assert_close(getattr(twice, name), getattr(frames, name))
    point = torch.tensor([1.5, 0.0, 12.0, 1.0])
    pixels = []
    for each, side in ((frames, 1.0), (mirrored(frames), -1.0)):
        road = point * torch.tensor([side, 1.0, 1.0, 1.0])
        seen = Extrinsics.unstack(each.extrinsics).projection(each.intrinsics) @ road
        pixels.append(seen[:, :2] / seen[:, 2:])
    torch.testing.assert_close(pixels[1][:, 0], SIZE[1] - 1 - pixels[0][:, 0])
    torch.testing.assert_close(pixels[1][:, 1], pixels[0][:, 1])


def test_each_pass_has_every_frame_once_and_a_continued_one_the_same_frames():
    batches = list(StepBatches(count=7, size=2, steps=8, seed=1))
    assert len(batches) == 8
    for first in (0, 3):
        assert len({row for batch in batches[first : first + 3] for row in batch}) == 6
    assert batches[:3] != batches[3:6]
    assert list(StepBatches(7, 2, 8, 1, begin=4)) == batches[4:]
    assert list(StepBatches(7, 2, 8, 2)) != batches
    with pytest.raises(ValueError, match="batch_size: expected at most 7, the number of frames, got 8"):
        StepBatches(7, 8, 8, 1)


def test_the_cycle_is_that_of_torch():
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1.0, 101, pct_start=0.16, final_div_factor=1e9)
    for step in range(100):
        assert one_cycle(step / 100, rise=0.1516) == pytest.approx(cycle.get_last_lr()[0], abs=1e-6)
        optimizer.step()
        cycle.step()
    assert (one_cycle(0.0), one_cycle(0.15), one_cycle(1.0)) == pytest.approx((0.04, 1.0, 0.0))
    assert one_cycle(0.075) == pytest.approx(0.52)
    assert one_cycle(0.575) == pytest.approx(0.5)


def test_gradients_of_detector_and_lane_network_are_clipped_separately():
    module = DetectorTraining(small(Path("train"), Path("out")), "nominal", 1)
    near, far = (torch.nn.Parameter(torch.zeros(2)) for _ in range(2))
    near.grad, far.grad = torch.tensor([0.3, 0.4]), torch.tensor([300.0, 400.0])
    optimizer = torch.optim.SGD([{"params": [near]}, {"params": [far]}], lr=1.0)
    module.configure_gradient_clipping(optimizer, gradient_clip_val=5.0)
    torch.testing.assert_close(near.grad, torch.tensor([0.3, 0.4]))
    torch.testing.assert_close(far.grad, torch.tensor([3.0, 4.0]))


def test_offsets_turn_one_axis_of_every_frame_by_the_angle():
    poses = torch.rand(50, 4)
    turned = offset_poses(poses)
    assert len(turned) == 3 * len(OFFSETS_DEG)
    for (axis, degrees), pose in turned.items():
        off = (pose - poses).rad2deg()
        column = {"pitch": 0, "yaw": 1, "roll": 2}[axis]
        torch.testing.assert_close(off[:, column].abs(), torch.full((50,), degrees), atol=1e-3, rtol=0)
        assert off[:, column].sign().unique().tolist() == [-1, 1]
        off[:, column] = 0
        assert not off.any()


def test_rows_of_the_detector_do_not_influence_each_other_and_the_pose_has_a_gradient():
    torch.manual_seed(0)
    detector = VehicleDetector(GRID, 8, 8, top=32).eval()
    image = torch.rand(2, 3, *SIZE)
    intrinsics = torch.tensor([[[140.0, 0, 79.5], [0, 140.0, 47.5], [0, 0, 1]]]).expand(2, 3, 3)
    pose = torch.tensor([NOMINAL, NOMINAL], requires_grad=True)
    maps = detector(image, intrinsics, Extrinsics.unstack(pose))
    assert maps.shape == (2, 7, *GRID.shape)
    image[1] = 0.0
    alone = detector(image, intrinsics, Extrinsics.unstack(pose))
    torch.testing.assert_close(maps[0], alone[0])
    (gradient,) = torch.autograd.grad(maps[0].square().sum(), pose)
    assert gradient[0].abs().min() > 0
    assert not gradient[1].any()


@pytest.mark.slow
def test_the_experiment_runs_is_not_repeated_and_makes_its_table(folder, tmp_path, capsys):
    arguments = [
        "--config=configs/detector.yaml", f"--train={folder}", f"--test={folder}", f"--out={tmp_path}/run",
        "--steps=2", "--tuned_steps=1", "--seeds=[1]", "--batch_size=2", "--top=32",
        "--width=8", "--bev_width=8", "--grid.resolution=2.0", "--network_width=160", "--accelerator=cpu",
    ]  # fmt: skip
    main(arguments)
    results = sorted(path.name for path in (tmp_path / "run").glob("*.json"))
    assert results == [f"{arm}-1.json" for arm in ("noisy", "nominal", "online", "true", "tuned")]
    true = json.loads((tmp_path / "run/true-1.json").read_text())
    assert true["pose_rmse"] == [0.0] * 4
    assert len(true["off"]) == 3 * len(OFFSETS_DEG)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").glob("*.json")}
    main(arguments)
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "run").glob("*.json")}
    show([str(tmp_path / "run"), "--plot", str(tmp_path / "ap.svg")])
    out = capsys.readouterr().out
    assert "true pose" in out
    assert "won back" in out
    assert (tmp_path / "ap.svg").stat().st_size > 1000
    film([*arguments, f"--film={tmp_path}/film.mp4", "--film_frames=2"])
    with av.open(str(tmp_path / "film.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 2


def small(folder, out, **settings):
    """Return an experiment of four steps of two frames, the last two of "tuned" with the lane network."""
    fixed = {"steps": 4, "tuned_steps": 2, "batch_size": 2, "top": 32, "width": 8, "bev_width": 8}
    return Experiment(
        folder, folder, out, grid=GRID, network_width=160, accelerator="cpu", **{**fixed, **settings}
    )


def weights(module):
    return {name: part.clone() for name, part in module.detector.state_dict().items()}


@pytest.mark.slow
def test_the_tuned_arm_differs_from_the_online_one_by_the_lane_networks_training_alone(folder, tmp_path):
    frames = DriveFrames(folder, GRID)
    online = weights(train_arm(small(folder, tmp_path), "online", 1, frames))
    still = train_arm(small(folder, tmp_path, lane_rate=1e-12), "tuned", 1, frames)
    for name, part in weights(still).items():
        torch.testing.assert_close(part, online[name], atol=1e-4, rtol=1e-4)
    before = LaneBEV.from_pretrained(network_width=160).segmenter.state_dict()
    (tmp_path / "tuned-1/last.ckpt").unlink()
    moved = train_arm(small(folder, tmp_path, lane_rate=1e-4), "tuned", 1, frames)
    assert moved.trainer.global_step == 4
    change = {name: part - before[name] for name, part in moved.lanes.segmenter.state_dict().items()}
    assert 1e-6 < max(float(each.abs().max()) for each in change.values()) < 2.1e-4
    assert not any(each.any() for name, each in change.items() if "running" in name)


@pytest.mark.slow
def test_an_interrupted_training_ends_as_one_without_interruption(folder, tmp_path):
    frames = DriveFrames(folder, GRID)
    whole = weights(train_arm(small(folder, tmp_path), "noisy", 1, frames))
    (tmp_path / "noisy-1/step=2.ckpt").rename(tmp_path / "noisy-1/last.ckpt")
    again = weights(train_arm(small(folder, tmp_path), "noisy", 1, frames))
    for name, part in again.items():
        torch.testing.assert_close(part, whole[name], atol=0, rtol=0)


def test_the_last_steps_are_a_part_of_the_training(tmp_path):
    with pytest.raises(ValueError, match="tuned_steps: expected a divisor of steps 4 that is smaller, got 3"):
        small(tmp_path, tmp_path, tuned_steps=3)


@pytest.mark.slow
def test_the_tuned_arm_begins_with_the_online_one(folder, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([f"--train={folder}", f"--test={folder}", f"--out={tmp_path}", "--arms=[tuned]"])
    assert stop.value.code == 2
    assert "expected 'online' before 'tuned'" in capsys.readouterr().err
