"""States on disk: whole and bit for bit, or refused with a reason."""

from typing import NamedTuple

import pytest
import torch
from safetensors.torch import save_file

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.mount import MountEstimator
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.io.state import VERSION, load_state, save_state
from lanebev.testing.moments import CAMERA, FPS, moments, observe
from tests.calibrators import CALIBRATORS


@pytest.fixture
def states():
    return {"calibrator": JointCalibrator().initial_state(2), "other": TwoStageCalibrator().initial_state(1)}


def test_round_trip_is_bit_for_bit(tmp_path, states):
    path = tmp_path / "state.safetensors"
    noisy = JointState(*(value + 1 if value.is_floating_point() else value for value in states["calibrator"]))
    save_state(path, {**states, "calibrator": noisy, "frame": 17, "source": "a.mp4", "alone": torch.ones(2)})
    loaded = load_state(path, like=states)
    assert loaded.problem is None
    assert isinstance(loaded.states["calibrator"], JointState)
    for before, after in zip(noisy, loaded.states["calibrator"], strict=True):
        assert torch.equal(before, after)
        assert before.dtype == after.dtype
    assert loaded.metadata == {"frame": 17, "source": "a.mp4"}
    assert torch.equal(loaded.states["alone"], torch.ones(2))
    assert [file.name for file in tmp_path.iterdir()] == ["state.safetensors"]  # no temporary left


def test_without_like_states_are_dicts(tmp_path, states):
    save_state(tmp_path / "s", states)
    assert set(load_state(tmp_path / "s").states["calibrator"]) == set(JointState._fields)


@pytest.mark.parametrize("length", [0, 5, 100, 2000])
def test_truncated_file_is_reported_and_ignored(tmp_path, states, length):
    path = tmp_path / "state.safetensors"
    save_state(path, states)
    path.write_bytes(path.read_bytes()[:length])
    loaded = load_state(path, like=states)
    assert loaded.states == {}
    assert "cut or not a state file" in loaded.problem
    assert "\n" not in loaded.problem


def test_missing_foreign_and_non_finite_files(tmp_path, states, monkeypatch):
    assert "no such file" in load_state(tmp_path / "none", like=states).problem
    save_state(tmp_path / "shut", states)
    with monkeypatch.context() as patched:
        patched.setattr("os.access", lambda *_: False)
        assert "no permission to read it" in load_state(tmp_path / "shut", like=states).problem
    save_file({"weights": torch.ones(3)}, tmp_path / "foreign")
    assert "not written by lanebev" in load_state(tmp_path / "foreign", like=states).problem
    (tmp_path / "text").write_text("pitch: 1\n")
    assert "cut or not a state file" in load_state(tmp_path / "text", like=states).problem
    bad = states["calibrator"]._replace(mean=torch.full_like(states["calibrator"].mean, torch.nan))
    with pytest.raises(
        ValueError, match=rf"calibrator.mean: expected finite numbers, got {bad.mean.numel()}"
    ):
        save_state(tmp_path / "bad", {"calibrator": bad})
    assert not (tmp_path / "bad").exists()
    header = {
        "format": "lanebev-state",
        "version": str(VERSION),
        "kinds": '{"calibrator": "JointState"}',
        "metadata": "{}",
    }
    tensors = {f"calibrator.{name}": value for name, value in bad._asdict().items()}
    save_file(tensors, tmp_path / "nan", metadata=header)
    loaded = load_state(tmp_path / "nan", like={"calibrator": states["calibrator"]})
    assert "calibrator.mean is not finite" in loaded.problem
    assert loaded.states == {}


def test_another_calibrator_batch_or_precision_is_refused(tmp_path, states):
    save_state(tmp_path / "s", {"calibrator": states["calibrator"]})
    other = {"calibrator": states["other"]}
    assert "is a JointState, expected TwoStageState" in load_state(tmp_path / "s", like=other).problem
    wider = {"calibrator": JointCalibrator().initial_state(3)}
    shape = tuple(wider["calibrator"].mean.shape)
    assert f"expected torch.float32 {shape}" in load_state(tmp_path / "s", like=wider).problem
    double = {"calibrator": JointCalibrator().initial_state(2, dtype=torch.float64)}
    assert "expected torch.float64" in load_state(tmp_path / "s", like=double).problem
    more = {**states, "mount": states["other"]}
    assert "expected other, mount" in load_state(tmp_path / "s", like=more).problem


def test_a_state_of_another_version_is_one_short_line(tmp_path, states):
    earlier = NamedTuple("JointState", [(name, torch.Tensor) for name in JointState._fields[:-1]])
    save_state(tmp_path / "s", {"calibrator": earlier(*states["calibrator"][:-1])})
    problem = load_state(tmp_path / "s", like={"calibrator": states["calibrator"]}).problem
    words = "expected a state of this version of lanebev, got one of another, whose JointState differs"
    assert problem == f"{tmp_path / 's'}: {words}"


def test_a_state_whose_shape_differs_asks_for_its_version(tmp_path, states):
    earlier = states["calibrator"]._replace(scatter=torch.zeros(2, 2, 3))  # without the boundaries' estimates
    save_state(tmp_path / "s", {"calibrator": earlier})
    problem = load_state(tmp_path / "s", like={"calibrator": states["calibrator"]}).problem
    assert problem.endswith("; is it of another version of lanebev, batch size or number of boundaries?")
    double = {"calibrator": JointCalibrator().initial_state(2, dtype=torch.float64)}
    save_state(tmp_path / "s", {"calibrator": states["calibrator"]})
    assert "another version" not in load_state(tmp_path / "s", like=double).problem


def test_failed_write_keeps_the_old_file(tmp_path, states):
    path = tmp_path / "s"
    save_state(path, {"frame": 1, **states})
    with pytest.raises(ValueError, match="frame: expected a NamedTuple of tensors"):
        save_state(path, {"frame": float("nan"), **states})
    with pytest.raises(ValueError, match="name: expected one without"):
        save_state(path, {"a.b": 1})
    assert load_state(path, like=states).metadata == {"frame": 1}
    with pytest.raises(OSError, match="No such file"):
        save_state(tmp_path / "nowhere" / "s", states)


def test_resuming_gives_bit_for_bit_what_an_uninterrupted_run_gives(tmp_path):
    calibrator, mount = JointCalibrator(), MountEstimator(block_time=0.1)
    frames = list(observe(moments(0.5), 2, 1.0, 8, 0, torch.float32))
    intrinsics = CAMERA.float().expand(2, 3, 3)

    def run(frames, states):
        for _, segments in frames:
            fast, after = calibrator(segments, intrinsics, states["calibrator"], 1 / FPS)
            slow, mounted = mount(fast, states["mount"], 1 / FPS, curvature=calibrator.curvature(after))
            states = {"calibrator": after, "mount": mounted}
        return fast, slow, states

    fresh = {"calibrator": calibrator.initial_state(2), "mount": mount.initial_state(2)}
    whole = run(frames, fresh)
    _, _, half = run(frames[:7], fresh)
    save_state(tmp_path / "s", half)
    loaded = load_state(tmp_path / "s", like=fresh)
    assert loaded.problem is None
    parts = run(frames[7:], loaded.states)
    assert torch.equal(parts[0].extrinsics.stack(), whole[0].extrinsics.stack())
    assert torch.equal(parts[1].extrinsics.stack(), whole[1].extrinsics.stack())
    for name in fresh:
        for one, other in zip(parts[2][name], whole[2][name], strict=True):
            assert torch.equal(one, other)


@CALIBRATORS
def test_every_calibrator_answers_its_interface(calibrator):
    """Callers need no type of their own: passes on a still, curvature or None, a state that detaches."""
    [(_, segments)] = observe(moments(1 / FPS), 2, 1.0, 8, 0, torch.float64)
    ends = segments.endpoints.requires_grad_()
    state = calibrator.initial_state(2, dtype=torch.float64)
    out, after = calibrator(segments._replace(endpoints=ends), CAMERA.expand(2, 3, 3), state, 1 / FPS)
    assert out.extrinsics.pitch.requires_grad
    cut = after.detach()
    assert type(cut) is type(after)
    assert not any(part.requires_grad for part in cut)
    assert all(map(torch.equal, cut, after))
    bend = calibrator.curvature(after)
    assert bend is None or bend.shape == (2,)
    assert calibrator.still_passes >= 1
