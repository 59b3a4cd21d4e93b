"""LaneBEV, Session and a run with a far view: where it is, and when there is none."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from lanebev import Camera, FarView, JointCalibrator, LaneBEV, Status
from lanebev.app.config import RunConfig
from lanebev.app.drive.observers import FarViewObserver
from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.app.fleet.manifest import Drive as FleetDrive
from lanebev.app.fleet.plan import tasks_of
from lanebev.app.run import run
from lanebev.estimation.expected_view import expected_vanishing_point
from lanebev.estimation.joint.frame_prior import prior_of_mount
from lanebev.estimation.tracker import Tracker
from lanebev.export.parts import make_part
from lanebev.geometry.vanishing_point import vanishing_point
from lanebev.io.frames import Frame
from lanebev.io.images.pixels import write_png
from lanebev.render import Drive
from tests.calibrators import CALIBRATORS

DT, WIDTH = 0.05, 3.6


@pytest.fixture(scope="module")
def drive():
    """Three rendered images (3, 3, H, W) and their camera."""
    made = Drive(10, (180, 320), 3, 20.0)
    return torch.cat([made.frame(i).image for i in range(3)]), made.camera


@pytest.fixture(scope="module")
def models():
    """Without and with a far view, of one network at a small size."""
    return [LaneBEV.from_pretrained(network_width=320, far_view=each).eval() for each in (None, FarView())]


def after_one_frame(model, image, camera, rows=1):
    with torch.inference_mode():
        out, state = model(
            image.expand(rows, -1, -1, -1), camera.intrinsics.expand(rows, 3, 3), lane_width=WIDTH, bev=False
        )
    return out, state


def test_a_start_has_the_whole_image_alone_and_the_next_frame_a_far_view(drive, models):
    images, camera = drive
    (plain, _), (far, state) = (after_one_frame(model, images[:1], camera) for model in models)
    count = plain.segments.weight.gt(0).sum()
    assert far.segments.weight.gt(0).sum() == count
    torch.testing.assert_close(far.calibration.extrinsics, plain.calibration.extrinsics)
    assert int(state.status) == Status.TRACKING
    with torch.inference_mode():
        second, _ = models[1](images[1:2], camera.intrinsics[None], state, DT, WIDTH, bev=False)
        alone, _ = models[0](images[1:2], camera.intrinsics[None], state, DT, WIDTH, bev=False)
    assert not torch.equal(
        second.segments.endpoints[:, : alone.segments.endpoints.shape[1]], alone.segments.endpoints
    )
    lost = state._replace(status=torch.full_like(state.status, int(Status.LOST)))
    with torch.inference_mode():
        again = models[1].observe(
            images[1:2], camera.intrinsics[None],
            vanishing_point=expected_vanishing_point(models[1].calibrator, lost, camera.intrinsics[None]),
        )[1]  # fmt: skip
    assert again.weight.gt(0).sum() == alone.segments.weight.gt(0).sum()


def test_clips_are_as_frame_by_frame_and_rows_do_not_influence_each_other(drive, models):
    """In the second row the drive starts anew at the last frame."""
    images, camera = drive
    model = models[1]
    clips = torch.stack([images, images.flip(0)])
    reset = torch.tensor([[True, False, False], [True, False, True]])
    lens = camera.intrinsics.expand(2, 3, 3)
    with torch.inference_mode():
        together, _ = model(clips, lens, dt=DT, lane_width=WIDTH, reset=reset, bev=False)
        for row in range(2):
            state = None
            for step in range(3):
                state = None if bool(reset[row, step]) else state
                alone, state = model(clips[row : row + 1, step], lens[:1], state, DT, WIDTH, bev=False)
                for one, other in zip(
                    together.calibration.extrinsics, alone.calibration.extrinsics, strict=True
                ):
                    torch.testing.assert_close(one[row, step], other[0], atol=1e-4, rtol=1e-4)


def test_gradients_flow_through_both_views(drive, models):
    images, camera = drive
    model = models[1]
    image = images[:1].clone().requires_grad_()
    point = torch.tensor([[160.0, 70.0]])
    _, segments = model.observe(image, camera.intrinsics[None].float(), vanishing_point=point)
    segments.endpoints.square().sum().backward()
    assert image.grad.isfinite().all()
    assert image.grad.abs().sum() > 0


def test_the_expected_vanishing_point_is_that_of_the_state(drive, models):
    images, camera = drive
    out, state = after_one_frame(models[1], images[:1], camera)
    pitch, yaw = out.calibration.extrinsics[:2]
    found = expected_vanishing_point(models[1].calibrator, state, camera.intrinsics[None])
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    expected = [cx + fx * float(yaw.tan() / pitch.cos()), cy - fy * float(pitch.tan())]
    assert found[0].tolist() == pytest.approx(expected, abs=0.1)


@CALIBRATORS
def test_it_is_not_known_where_the_state_is_not_sure(calibrator):
    lens = Camera.from_fov(60.0, 320, 180).intrinsics.expand(3, 3, 3)
    state = calibrator.initial_state(3, torch.float64)
    assert not bool(expected_vanishing_point(calibrator, state, lens).isfinite().any())
    tracking = state._replace(status=torch.full_like(state.status, int(Status.TRACKING)))
    name = "cov" if hasattr(state, "cov") else "direction_cov"
    sure = tracking._replace(**{name: 1e-6 * getattr(state, name)})
    assert bool(expected_vanishing_point(calibrator, sure, lens).isfinite().all())
    yaw = getattr(sure, name).clone()
    yaw[1, 1, 1] = 0.01**2
    coasting = sure.status.clone()
    coasting[2] = int(Status.COASTING)
    found = expected_vanishing_point(calibrator, sure._replace(**{name: yaw, "status": coasting}), lens)
    assert found.isfinite().all(-1).tolist() == [True, False, False]


def test_a_known_mount_places_the_horizon_before_the_first_frame():
    camera = Camera.from_fov(60.0, 320, 180)
    prior = prior_of_mount((0.05, 0.0, 0.0, 1.4), (0.002, 0.002, 0.01, 0.02))
    tracker = Tracker(JointCalibrator(prior=prior), camera, WIDTH)
    expected = 89.5 - camera.intrinsics[1, 1] * torch.tan(torch.tensor(0.05))
    assert float(tracker.vanishing_point()[0, 1]) == pytest.approx(float(expected), abs=0.01)
    assert bool(Tracker(JointCalibrator(), camera, WIDTH).vanishing_point().isnan().all())


def test_a_far_view_is_refused_where_it_has_no_effect(drive, models):
    _, camera = drive
    with pytest.raises(ValueError, match="far view: expected another part than the extractor, which takes"):
        make_part("extractor", models[1], camera)
    with pytest.raises(ValueError, match="far view: expected lanes of the network"):
        RunConfig("drive.mp4", camera="camera.yaml", far_view=True, lanes="lanes.json")


def test_drives_of_a_fleet_with_far_views_are_not_cut(tmp_path, monkeypatch):
    """A part of a drive does not know the estimate of the frame before it."""
    video = tmp_path / "drive.mp4"
    video.touch()
    monkeypatch.setattr("lanebev.app.fleet.plan.duration", lambda _: 600.0)
    config = RunConfig(str(video), camera="camera.yaml")
    both = {"whole": replace(config, far_view=True), "cut": config}
    drives = [FleetDrive(name, "camera", "2026-03-01", "", each) for name, each in both.items()]
    tasks = tasks_of(drives, tmp_path, 60.0)
    assert [len(tasks[name].parts) for name in ("whole", "cut")] == [0, 10]


def test_the_far_view_of_a_still_is_about_the_horizon_of_its_whole_image(drive, models):
    images, camera = drive
    frame = Frame(0, 0.0, DT, "", (255 * images[0].permute(1, 2, 0)).byte().numpy())
    tracker = Tracker(JointCalibrator(), camera, WIDTH)
    observer = FarViewObserver(models[0], tracker, camera, stills=True)
    assert observer.workers > 0, "expected images on their own not to wait for each other"
    seen = observer(frame).vertices
    image = torch.from_numpy(frame.image).permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        _, whole = models[1].whole_vertices(image)
        pose = tracker.still(whole, 1.0).calibration.extrinsics
        point = vanishing_point(pose.pitch, pose.yaw, camera.intrinsics[None])
        _, expected = models[1].boundary_vertices(image, point)
    for one, other in zip(seen, expected, strict=True):
        torch.testing.assert_close(one, other)
    assert int(tracker.state.status) == Status.UNINITIALISED


def test_far_views_of_several_drives_form_a_batch(drive, models):
    """Frames with a far view and without one are in batches of their own."""
    images, _ = drive
    shared = SharedNetwork(models[0], most=4)
    points = [torch.tensor([[x, 70.0]]) for x in (120.0, 160.0, 200.0)]
    wanted = [*((images[:1], point) for point in points), (images[:1], None)]
    with shared._looking, ThreadPoolExecutor(4) as pool, torch.inference_mode():
        waiting = [pool.submit(shared.vertices, *each) for each in wanted]
        while len(shared._waiting) < 4:
            time.sleep(0.01)
        shared._looking.release()
        seen = [each.result() for each in waiting]
        shared._looking.acquire()
    assert (shared.batches, shared.frames) == (2, 4)
    for (image, point), found in zip(wanted, seen, strict=True):
        with torch.inference_mode():
            _, alone = models[0].boundary_vertices(image, point)
        for one, other in zip(found, alone, strict=True):
            torch.testing.assert_close(one, other, atol=1e-3, rtol=1e-3)


@pytest.mark.slow
def test_a_smoothed_run_sees_what_a_run_sees(drive, tmp_path):
    """Its first pass places the far view of a frame by the frames before it."""
    images, camera = drive
    camera.to_file(tmp_path / "camera.yaml")
    for number, image in enumerate(images):
        write_png(tmp_path / f"{number}.png", (255 * image.permute(1, 2, 0)).byte().numpy())
    config = RunConfig(
        str(tmp_path / "*.png"), str(tmp_path / "camera.yaml"), str(tmp_path / "out"), WIDTH, fps=20.0,
        far_view=True, no_video=True,
    )  # fmt: skip
    first = run(config)
    run(replace(config, out=str(tmp_path / "smooth"), smooth=True))
    one, other = (
        [json.loads(line)["seen"] for line in (tmp_path / name / "lanes.json").read_text().splitlines()]
        for name in ("out", "smooth")
    )
    assert one == other
    plain = run(replace(config, out=str(tmp_path / "plain"), far_view=False))
    assert plain.rows[0][2:10] == pytest.approx(first.rows[0][2:10], abs=1e-9)
    assert plain.rows[2][2:10] != pytest.approx(first.rows[2][2:10], abs=1e-6)
