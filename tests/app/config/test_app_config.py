"""Settings of a run: from options, from a YAML file, and both; what the command line says of them."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from lanebev.app.config import RunConfig
from lanebev.app.config.arguments import RUN_GROUPS
from lanebev.app.config.export import ExportConfig
from lanebev.app.config.file import read_settings
from lanebev.app.summary import setting_words
from lanebev.cli import main, parser


def _file(folder, text):
    (folder / "run.yaml").write_text(text)
    return str(folder / "run.yaml")


def test_settings_of_a_file_are_those_of_the_command_line(tmp_path):
    text = "source: a.mp4\ncamera: c.yaml\nlane-width: 3.5\nstills: true\nlanes_size: 640x360\nfps: 12\n"
    text += "lanes: l.json\nlanes-crop: 640x240+0+120\n"
    config = RunConfig(**read_settings(_file(tmp_path, text)))
    assert config == RunConfig(
        "a.mp4",
        "c.yaml",
        lane_width=3.5,
        stills=True,
        fps=12.0,
        lanes="l.json",
        lanes_size=(360, 640),
        lanes_crop=(120, 0, 240, 640),
    )


def test_the_home_folder_may_be_written_as_in_a_shell(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    given = read_settings(_file(tmp_path, "source: ~/a/*.jpg\nout: ~/b\ncamera: a~/~.yaml\n"))
    assert given == {"source": f"{tmp_path}/a/*.jpg", "out": f"{tmp_path}/b", "camera": "a~/~.yaml"}
    assert vars(parser().parse_args(["demo", "--out=~/run"]))["out"] == f"{tmp_path}/run"


def test_numbers_of_a_file_are_decimal_and_names_stay_as_they_are(tmp_path):
    """YAML 1.1 would read 8 s, 61 s and a flag."""
    text = "source: No\ncamera: 017\nstart: 010\nend: 12e1\nresume: 1:01\nno-video: yes\n"
    given = read_settings(_file(tmp_path, text))
    assert given == {
        "source": "No", "camera": "017", "start": 10.0, "end": 120.0, "resume": "1:01", "no_video": True,
    }  # fmt: skip


def test_paths_may_be_paths_and_numbers_of_numpy(tmp_path):
    config = RunConfig(
        Path("a.mp4"), Path("c.yaml"), tmp_path, lane_width=np.float32(3.5), every=np.int64(2),
        grid=[3, 30, -5, 5, 0.1], formats=["jsonl"],
    )  # fmt: skip
    assert (config.source, config.camera, config.out) == ("a.mp4", "c.yaml", str(tmp_path))
    assert (config.grid, config.formats) == ((3, 30, -5, 5, 0.1), ("jsonl",))
    assert ExportConfig(Path("c.yaml")).camera == "c.yaml"


def test_numbers_of_numpy_are_kept_as_those_of_python():
    lanes = {"source": "a", "camera": "c.yaml", "lanes": "l.json"}
    given = RunConfig(
        **lanes, fps=np.float32(30), every=np.int64(2), lanes_size=(np.int64(720), 1280),
        grid=tuple(np.float32([3, 30, -5, 5, 0.25])),
    )  # fmt: skip
    of_python = RunConfig(
        **lanes, fps=30.0, every=2, lanes_size=(720, 1280), grid=(3.0, 30.0, -5.0, 5.0, 0.25)
    )
    assert repr(given) == repr(of_python)
    assert given.frame_rate == 30
    whole = RunConfig("a", "c.yaml", fps=30)
    assert repr(whole.fps) == "30.0"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"source": 3}, "source: expected a text or a path, got 3"),
        ({"lane_width": "3.7"}, "lane width: expected a number, got '3.7'"),
        ({"fps": True}, "fps: expected a number, got True"),
        ({"every": 1.5}, "every: expected a whole number, got 1.5"),
        ({"stills": "yes"}, "stills: expected True or False, got 'yes'"),
        ({"formats": "parquet"}, "formats: expected a tuple, got 'parquet'"),
        ({"camera": None}, "camera: expected a text or a path, got None"),
    ],
)
def test_settings_of_other_types_are_named(settings, message):
    with pytest.raises(TypeError, match=message):
        RunConfig(**{"source": "a.mp4", "camera": "c.yaml", **settings})
    with pytest.raises(TypeError, match="int8: expected True or False, got 1"):
        ExportConfig("c.yaml", int8=1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"lanes_crop": (0, 0, -1, 5)}, r"lanes crop: expected whole px .*\(top, left, height, width\), got"),
        ({"lanes_crop": (0, 0, 240)}, r"got \(0, 0, 240\)"),
        ({"lanes_crop": (0.5, 0, 240, 320)}, r"got \(0\.5, 0, 240, 320\)"),
        ({"lanes_size": (True, 640)}, r"got \(True, 640\)"),
        ({"lanes_size": (0, 640)}, r"lanes size: expected whole px of an image, \(height, width\), got \(0,"),
        ({"formats": ("csv",)}, "formats: expected some of parquet, .*, got 'csv'"),
        ({"grid": (3, 60, -10)}, r"grid: expected the numbers \(near, far, left, right, resolution\), got"),
        ({"grid": (3, 60, 10, -10, 0.05)}, "grid: expected 0 < NEAR < FAR, LEFT < RIGHT and a STEP above 0"),
    ],
)
def test_settings_are_checked_when_they_are_made(settings, message):
    with pytest.raises(ValueError, match=message):
        RunConfig("a.mp4", "c.yaml", lanes="l.json", **settings)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lane_widht: 3", r"expected one of source, .*, got 'lane_widht'; is lane_width meant\?"),
        ("every:\t2", "expected a YAML .*, got: not YAML at line 1; write spaces instead of a tab"),
        ("fps: 10 Hz", "fps: expected a number such as 29.97 or 30000/1001, got '10 Hz'"),
        ("fps: 10/0", "fps: expected a number such as 29.97 or 30000/1001, got '10/0'"),
        ("lane_width: wide", "lane_width: expected a number, got 'wide'"),
        ("lane_width: 3,5", "lane_width: expected a number, got '3,5'"),
        ("every: 1.5", "every: expected a whole number, got '1.5'"),
        (
            "lane_width: 3.5\nlane_width: 3.6",
            "expected a YAML file .*, got: expected each key once, got 'lane_width' twice",
        ),
        ("lane_width: 3\n---\nlane_width: 4\n", "expected a YAML .*, got: expected one YAML document, got 2"),
        ("lane_width: 3.5\nlane-width: 3.6", "lane-width: expected it once, got it with - and with _"),
        ("stills: 1", "stills: expected true or false, got '1'"),
        ("lane_width: true", "lane_width: expected a text or number, got True"),
        ("source: [1]", r"source: expected a text or number, got \['1'\]"),
        ("lanes_size: 3", "lanes_size: .*expected WIDTHxHEIGHT"),
        ("- 1", "expected a YAML file of settings, got list"),
        ("# lane_width: 3.5", "expected a YAML file of settings, got none; is it empty"),
        ("{", "expected a YAML file of settings, got: not YAML"),
        ("formats: [csv]", "formats: .*got 'csv'"),
    ],
)
def test_a_bad_file_is_one_line_that_names_it(tmp_path, text, message):
    with pytest.raises(ValueError, match=rf"config .*run.yaml: {message}"):
        read_settings(_file(tmp_path, text))
    with pytest.raises(ValueError, match=r"config .*none.yaml: expected a YAML file"):
        read_settings(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lane_width": 37.0}, "lane width: expected 1 to 10 m, got 37"),
        ({"fps": 0.0}, "fps: expected"),
        ({"calibrator": "x"}, "calibrator: expected joint or two-stage, got 'x'"),
        ({"camera": ""}, "camera: expected --camera FILE, or --fov DEG .*, got none"),
        ({"source": ""}, "source: expected a path, got none"),
        ({"lanes_size": (360, 640)}, "lanes size: expected --lanes too, got none"),
        ({"lanes_crop": (0, 0, 360, 640)}, "lanes crop: expected --lanes too, got none"),
        ({"lanes": "l.json", "weights": "w"}, "weights: expected lanes of the network, got --lanes too"),
    ],
)
def test_settings_check_themselves(values, message):
    with pytest.raises(ValueError, match=message):
        RunConfig(**{"source": "a", "camera": "b", **values})


def test_rates_may_be_fractions_and_names_a_list(tmp_path):
    given = read_settings(_file(tmp_path, "fps: 30000/1001\nformats: [jsonl, kitti]\n"))
    assert given == {"fps": 30000 / 1001, "formats": ("jsonl", "kitti")}


def test_options_override_a_file(tmp_path, capsys):
    path = _file(tmp_path, "source: here.mp4\ncamera: c.yaml\nlane-width: 37\n")
    assert main(["run", "--config", path]) == 2
    assert "lane width: expected 1 to 10 m, got 37" in capsys.readouterr().err
    assert main(["run", str(tmp_path / "none.mp4"), "--config", path, "--lane-width", "3.5"]) == 2
    assert "none.mp4: expected a video" in capsys.readouterr().err


def test_every_setting_is_an_option_that_says_its_default():
    known = parser()
    given = vars(known.parse_args(["run", "a"]))
    assert set(given) == {"source", "config", "command", "verbose"}  # defaults are those of RunConfig alone
    (commands,) = (action for action in known._actions if action.dest == "command")
    words = commands.choices["run"].format_help()
    for setting in fields(RunConfig):
        assert setting.name == "source" or f"--{setting.name.replace('_', '-')}" in words
        if setting.metadata["help"].endswith(")") and setting.default:
            assert str(setting.default) in setting.metadata["help"]


def test_device_that_is_not_there_is_one_line(tmp_path, capsys):
    from PIL import Image

    Image.new("RGB", (64, 32)).save(tmp_path / "a.png")
    camera = tmp_path / "camera.yaml"
    camera.write_text("{fx: 60, fy: 60, cx: 31.5, cy: 15.5, width: 64, height: 32}")
    out = tmp_path / "out"
    for device in ("magic", "cuda:99"):
        arguments = [str(tmp_path / "a.png"), "--camera", str(camera), "--out", str(out), "--device", device]
        assert main(["run", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert f"device: expected one that torch can use here, got {device}" in error
    assert not out.exists()


def test_every_setting_of_a_run_is_in_one_group_of_its_help():
    grouped = [name for names in RUN_GROUPS.values() for name in names]
    assert sorted(grouped) == sorted(field.name for field in fields(RunConfig))


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(arguments):
    script = f"import sys, runpy; sys.argv = ['lanebev', *{arguments!r}]\n"
    script += "try: runpy.run_module('lanebev', run_name='__main__')\n"
    script += "except SystemExit as done: assert not done.code\n"
    script += "assert not {'torch', 'cv2', 'matplotlib', 'av', 'numpy'} & set(sys.modules)\n"
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_settings_in_the_report_are_as_given():
    """0 and 1 are no flags, though they equal them."""
    cases = {
        0.0: "0",
        1: "1",
        3.5: "3.5",
        None: "not given",
        (): "none",
        ("parquet", "mcap"): "parquet, mcap",
    }
    assert {value: setting_words(value) for value in cases} == cases
    assert [setting_words(value) for value in (True, False, "cpu")] == ["yes", "no", "cpu"]
