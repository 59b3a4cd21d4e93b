"""The commands of train and tools: each says what it is, and what is wrong in one line."""

import importlib
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
COMMANDS = sorted(
    f"{folder}.{path.stem}"
    for folder in ("train", "tools")
    for path in (ROOT / folder).glob("*.py")
    if "\ndef main(" in path.read_text() and path.stem != "__main__"
)


def run(command, arguments, monkeypatch):
    """Exit status."""
    monkeypatch.setattr("sys.argv", [command, *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        importlib.import_module(command).main()
    return stopped.value.code


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, monkeypatch, capsys):
    assert run(command, ["--help"], monkeypatch) == 0
    assert "options:" in capsys.readouterr().out


def test_the_commands_are_all_of_them():
    assert {"train.pool", "train.evaluate_poses", "tools.evaluate_real", "tools.render_sheet"} < set(COMMANDS)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train.pool TMP/pool --size 8 8", "image_size >= (16, 16), got 8 and (8, 8)"),
        ("train.pool TMP/file/pool", "Not a directory"),
        ("train.extraction --size 8 8 --frames 8", "image_size >= (16, 16), got"),
        ("train.noise TMP/file --fps 0", "argument --fps: invalid PositiveFloat value"),
        (
            "train.export TMP/odd.ckpt TMP/out --seed 1 --commit x",
            "odd.ckpt: expected a network of this",
        ),
        ("train.average TMP/out TMP/misfit.ckpt", "misfit.ckpt: expected a network of this version"),
        ("tools.bench_calibration --quick --out TMP/file/out", "Not a directory"),
        ("tools.evaluate_real --data TMP", "give the folder with --data"),
        ("tools.label_noise --data TMP", "give the folder with --data"),
        ("tools.reproduce_table1 --runs 0", "argument --runs: invalid PositiveInt value"),
        ("tools.render_sheet --out TMP/x.png --count 0", "argument --count: invalid PositiveInt value"),
        ("tools.pseudo_ground_truth x --camera x --lane-width -3.7", "argument --lane-width: invalid"),
    ],
)
def test_bad_input_is_one_line(line, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("nothing")
    for name, network in (("odd", {"odd": 1}), ("misfit", {"base_width": 16})):
        weights = {"segmenter.x": torch.zeros(1)}
        checkpoint = {"state_dict": weights, "settings": {"network": network}, "global_step": 1}
        torch.save(checkpoint, tmp_path / f"{name}.ckpt")
    command, *arguments = line.replace("TMP", str(tmp_path)).split()
    assert run(command, arguments, monkeypatch) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("error: ") == 1
