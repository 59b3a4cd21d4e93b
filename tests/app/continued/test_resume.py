"""A run that continues from the state of another: what it gives, and which states it refuses."""

import shutil

import pytest
import torch
import yaml
from safetensors import safe_open
from safetensors.torch import save_file

from lanebev.cli import main
from lanebev.io.state import load_state
from tests.app.straight_road import fails, lane_lines, run, table


@pytest.mark.slow
@pytest.mark.parametrize("calibrator", ["two-stage", "joint"])
def test_resuming_gives_what_an_uninterrupted_run_gives(data, tmp_path, calibrator, capsys):
    for part, numbers in (("whole", range(6)), ("first", range(3)), ("second", range(3, 6))):
        (tmp_path / part).mkdir()
        for i in numbers:
            shutil.copy(data / "images" / f"{i}.png", tmp_path / part / f"{i}.png")
        lines = "\n".join(lane_lines(f"{part}/{i}.png" for i in numbers))
        (tmp_path / part / "lanes.json").write_text(lines)
        resume = ["--resume", str(tmp_path / "out_first")] if part == "second" else []
        sources = {"source": tmp_path / part, "lanes": tmp_path / part / "lanes.json"}
        out = tmp_path / f"out_{part}"
        assert run(data, "--calibrator", calibrator, *resume, out=out, **sources) == 0
    estimates = slice(2, 11)  # after frame and time, up to the status
    whole, second = (
        [list(row.values())[estimates] for row in table(tmp_path / f"out_{part}")]
        for part in ("whole", "second")
    )
    assert whole[3:] == second
    one, other = (
        load_state(tmp_path / f"out_{part}" / "state.safetensors").states for part in ("whole", "second")
    )
    assert run(data, "--calibrator", calibrator, "--lane-width", "3.5", *resume, out=out, **sources) == 0
    assert "resume: the state was saved with lanes 3.7 m wide, now they are 3.5 m" in capsys.readouterr().out
    assert set(one) == {"calibrator", "mount"}
    for name in one:
        assert all(torch.equal(one[name][field], other[name][field]) for field in one[name])


@pytest.mark.parametrize(
    "given",
    [{"source": "drive.mp4", "lanes": "video_lanes.json"}, {"source": "images", "lanes": "lanes.json"}],
    ids=["video", "images"],
)
def test_frames_that_a_state_contains_already_are_noticed(data, tmp_path, capsys, given):
    out = tmp_path / "out"
    again = "problem: resume: the state contains frames of this source already, up to number 2, which now"
    for options, is_again in (
        (["--end", "0.09"], False),
        (["--resume", str(out), "--start", "0.09"], False),
        (["--end", "0.09"], False),
        (["--resume", str(out)], True),
    ):
        assert run(data, "--no-video", *options, out=out, **given) == 0
        assert (again in capsys.readouterr().out) == is_again


@pytest.mark.slow
def test_a_damaged_state_is_reported_and_a_missing_one_refused(data, tmp_path, capsys):
    assert run(data, source="images/[3].png", out=tmp_path / "out") == 0
    state, resume = tmp_path / "out" / "state.safetensors", ["--resume", str(tmp_path / "out")]
    with safe_open(state, "pt") as file:
        fields = {name: file.get_tensor(name) for name in file.keys() if "reasons" not in name}  # noqa: SIM118
        save_file(fields, state, file.metadata())  # of another version of lanebev
    assert run(data, *resume, "--lane-width", "3", source="images/3.png", out=tmp_path / "next") == 0
    said = capsys.readouterr().out
    assert "state ignored" in said
    assert "saved with lanes" not in said  # it is not used
    state.write_bytes(state.read_bytes()[:-5])
    assert run(data, *resume, source="images/3.png", out=tmp_path / "next") == 0
    assert "state ignored" in capsys.readouterr().out
    images, camera, lanes = data / "images", data / "camera.yaml", data / "lanes.json"
    arguments = ["run", images, "--camera", camera, "--lanes", lanes, "--out", tmp_path / "third"]
    fails(capsys, [*arguments, "--resume", data], "resume: expected the output folder", "state.safetensors")
    assert not (tmp_path / "third").exists()


@pytest.mark.slow
def test_the_state_of_the_other_calibrator_is_a_mistake(data, tmp_path, capsys):
    for one, other in (("joint", "two-stage"), ("two-stage", "joint")):
        folder = tmp_path / one
        assert run(data, "--calibrator", one, source="images/[3].png", out=folder) == 0
        capsys.readouterr()
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        arguments = ["run", data / "images", "--camera", data / "camera.yaml", "--lanes", data / "lanes.json"]
        for out in (folder, tmp_path / "next"):
            fails(
                capsys,
                [*arguments, "--calibrator", other, "--resume", folder, "--out", out],
                f"resume: expected a state of the {other} calibrator, got one of the {one} calibrator",
                f"give --calibrator {one} or leave out --resume",
            )
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
        assert not (tmp_path / "next").exists()


def test_the_state_of_another_camera_is_a_mistake(data, tmp_path, capsys):
    assert run(data, out=tmp_path / "out") == 0
    fields = yaml.safe_load((data / "camera.yaml").read_text())
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(fields | {"fx": fields["fx"] + 40}))
    arguments = ["run", data / "images", "--camera", other, "--lanes", data / "lanes.json"]
    arguments += ["--calibrator", "two-stage", "--resume", tmp_path / "out", "--out", tmp_path / "next"]
    capsys.readouterr()
    fails(capsys, arguments, "resume: expected a state of the camera in", "got another camera's")
    assert not (tmp_path / "next").exists()


@pytest.mark.slow
def test_resuming_with_the_camera_that_a_run_wrote(data, tmp_path):
    fields = yaml.safe_load((data / "camera.yaml").read_text())
    camera = tmp_path / "camera.yaml"
    camera.write_text(yaml.safe_dump(fields | {"distortion": [-0.001, 0.0001, 0.0, 0.0]}))
    fixed = ["--lanes", str(data / "lanes.json"), "--calibrator", "two-stage"]
    first = ["run", str(data / "images"), "--camera", str(camera), "--out", str(tmp_path / "one"), *fixed]
    assert main(first) == 0
    again = ["--camera", str(tmp_path / "one" / "calibration.yaml"), "--resume", str(tmp_path / "one")]
    assert main(["run", str(data / "images"), *again, "--out", str(tmp_path / "two"), *fixed]) == 0


@pytest.mark.slow
def test_a_refused_state_is_kept_beside_what_replaces_it(data, tmp_path, capsys):
    out, names = tmp_path / "out", ("state.safetensors", "calibration.yaml")
    (tmp_path / "link").symlink_to(out, target_is_directory=True)
    assert run(data, source="images/[3].png", out=out) == 0
    for number in ("", "1"):  # the second does not take the place of the first
        (out / names[0]).write_bytes((out / names[0]).read_bytes()[: -5 - len(number)])
        before = [(out / name).read_bytes() for name in names]
        assert run(data, "--resume", str(tmp_path / "link"), source="images/3.png", out=out) == 0
        kept = [f"{name}.refused{number}" for name in names]
        assert f"calibration starts anew; kept as {kept[0]}, {kept[1]}" in capsys.readouterr().out
        assert [(out / name).read_bytes() for name in kept] == before
        assert load_state(out / names[0]).problem is None
    (out / names[0]).write_bytes(before[0])
    assert run(data, "--resume", str(out), source="images/3.png", out=tmp_path / "next") == 0
    assert not list((tmp_path / "next").glob("*.refused*"))  # it stays where it is
    assert (out / names[0]).read_bytes() == before[0]
