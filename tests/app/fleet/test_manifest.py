"""The manifest of a fleet: rows, defaults, names, and paths that leave its folder."""

from pathlib import Path

import pytest
import yaml

from lanebev.app.fleet.fleet import in_order
from lanebev.app.fleet.manifest import UNKNOWN_DAY, read_manifest
from lanebev.cli import main


@pytest.fixture
def write(tmp_path):
    def written(text, name="manifest.yaml"):
        path = tmp_path / "fleet" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text if isinstance(text, str) else yaml.safe_dump(text))
        return path

    return written


def test_a_row_a_drive(write, tmp_path):
    path = write(
        "video,camera,camera_id,time,lane_width,rectified\n"
        "a/x.mp4,cam.yaml,front,2026-03-01T08:30:00,3.5,true\n"
        "b/x.mp4,cam.yaml,,,,\n",
        "manifest.csv",
    )
    first, second = read_manifest(path)
    assert (first.name, first.camera_id, first.day, first.time) == (
        "a-x",
        "front",
        "2026-03-01",
        "2026-03-01T08:30:00",
    )
    assert first.config.source == str(tmp_path / "fleet" / "a" / "x.mp4")
    assert first.config.camera == str(tmp_path / "fleet" / "cam.yaml")
    assert (first.config.lane_width, first.config.rectified) == (3.5, True)
    assert (second.name, second.camera_id, second.day, second.time) == ("b-x", "cam", UNKNOWN_DAY, "")
    assert (second.config.lane_width, second.config.rectified) == (None, False)


def test_a_table_with_semicolons_says_what_separates_columns(write):
    for sign, width in ((";", "3.5"), (";", "3,5"), ("\t", "3,5")):
        text = f"video,camera,lane_width\na.mp4,c.yaml,{width}\n"
        rows = text.replace(",", sign).replace(f"3{sign}5", "3,5")
        with pytest.raises(
            ValueError, match=r"got: columns separated by .*; write commas, and points in num"
        ):
            read_manifest(write(rows, "manifest.csv"))


def test_empty_rows_of_a_spreadsheet_are_passed_over(write):
    assert len(read_manifest(write("video,camera\na.mp4,c.yaml\n,\n\n,\n", "manifest.csv"))) == 1


def test_names_in_yaml_are_those_that_were_written(write):
    text = (
        "- {video: 007.mp4, camera: c.yaml, camera_id: 017, name: 8:30, stills: no, time: 2026-03-01T08:30Z}"
    )
    (drive,) = read_manifest(write(text))
    assert (drive.camera_id, drive.name, drive.time) == ("017", "8:30", "2026-03-01T08:30:00+00:00")
    assert Path(drive.config.source).name == "007.mp4"
    assert not drive.config.stills


def test_drives_are_in_order_of_time_in_any_time_zone(write):
    times = {"b": "2026-03-01T08:30+02:00", "c": "2026-03-01T07:00Z", "d": "2026-03-01T02:00-06:00", "a": ""}
    rows = [{"video": f"{name}.mp4", "camera": "c.yaml", "time": time} for name, time in times.items()]
    drives = read_manifest(write([{key: value for key, value in row.items() if value} for row in rows]))
    assert [drive.name for drive in in_order(drives[::-1])] == ["a", "b", "c", "d"]


def test_yaml_with_defaults_says_the_same(write):
    rows = [{"video": "a.mp4", "day": "2026-03-01"}, {"video": "b.mp4", "lane-width": 3.4, "name": "second"}]
    first, second = read_manifest(
        write({"defaults": {"camera": "c.yaml", "lane-width": 3.5}, "drives": rows})
    )
    assert (first.name, first.day, first.time, first.config.lane_width) == (
        "a",
        "2026-03-01",
        "2026-03-01",
        3.5,
    )
    assert (second.name, second.config.lane_width) == ("second", 3.4)
    listed = [{"camera": "c.yaml", "lane-width": 3.5, **row} for row in rows]
    assert read_manifest(write(listed)) == [first, second]


def test_a_topic_of_all_drives_is_that_of_the_bags(write):
    rows = [{"video": "a.mp4"}, {"video": "b.mcap"}, {"video": "c.bag", "topic": "/right"}]
    defaults = {"fov": 60, "topic": "/left", "speed_topic": "/odom"}
    drives = read_manifest(write({"defaults": defaults, "drives": rows}))
    assert [drive.config.topic for drive in drives] == [None, "/left", "/right"]
    assert [drive.config.speed_topic for drive in drives] == [None, "/odom", "/odom"]


@pytest.mark.parametrize("key", ["video", "camera", "lanes", "weights", "mount", "resume", "exported"])
@pytest.mark.parametrize("text", ["../x", "/etc/passwd", "a/../../x", "link/x"])
def test_a_path_that_leaves_the_folder_is_refused(write, tmp_path, key, text):
    row = {"video": "a.mp4", "camera": "c.yaml", key: text}
    if key == "weights":
        row.pop("lanes", None)
    path = write([row])
    (tmp_path / "outside").mkdir()
    (path.parent / "link").symlink_to(tmp_path / "outside")
    words = f"drive 1: {key}: expected a path inside of .*, which leaves it; move the file, or allow"
    with pytest.raises(ValueError, match=words):
        read_manifest(path)
    if text != "/etc/passwd":
        assert len(read_manifest(path, root=tmp_path)) == 1


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "at least one drive"),
        ([{"camera": "c.yaml"}], "drive 1: expected video, the drive's path, got only camera"),
        ([{"video": [1]}], r"drive 1: video: expected a path, got \["),
        ([{"video": "a.mp4"}], "drive 1: camera: expected"),
        ([{"video": "a.mp4", "camera": "c", "out": "x"}], "drive 1: expected video, .* got out"),
        ([{"video": "a.mp4", "camera": "c", "widht": 3}], "drive 1: expected one of .* got 'widht'"),
        ([{"video": "a.mp4", "camera": "c", "lane_width": 37}], "drive 1: lane width: expected 1 to 10"),
        ([{"video": "a.mp4", "camera": "c", "day": "monday"}], "drive 1: day: expected ISO 8601"),
        ([{"video": "a.mp4", "camera": "c", "name": "a/b"}], "drive 1: name: expected a name"),
        ([{"video": "a.mp4", "camera": "c", "name": ".."}], "drive 1: name: expected a name"),
        ([{"video": "a.mp4", "camera": "c", "camera_id": "x\ny"}], "drive 1: camera_id: expected a name"),
        ([{"video": "a.mp4", "camera": "c"}, {"video": "A.mp4", "camera": "c"}], "got 'a' twice; give name"),
        (
            [{"video": "a.mp4", "camera": "x/c"}, {"video": "b.mp4", "camera": "y/c"}],
            "expected one camera file a camera, .* give camera_id",
        ),
        ({"drive": []}, "expected drives and defaults, got 'drive'"),
        ("video", "expected a list of drives"),
        ("a: [", "not YAML"),
        ("- {video: a.mp4, camera: c, video: b.mp4}", "expected each key once, got 'video' twice"),
    ],
)
def test_a_bad_manifest_is_one_line(write, rows, words):
    with pytest.raises(ValueError, match=words) as caught:
        read_manifest(write(rows))
    assert "\n" not in str(caught.value)


def test_a_csv_row_with_too_many_cells_is_refused(write):
    for row in ("a.mp4,c.yaml,x", "a.mp4"):
        with pytest.raises(ValueError, match="a row with another number of columns"):
            read_manifest(write(f"video,camera\n{row}\n", "manifest.csv"))


def test_empty_columns_that_a_spreadsheet_adds_are_ignored(tmp_path):
    (tmp_path / "m.csv").write_text("video,camera,,\na.mp4,c.yaml,,\n")
    assert [drive.name for drive in read_manifest(tmp_path / "m.csv")] == ["a"]


@pytest.mark.parametrize("text", [",video,camera\n0,a.mp4,c.yaml\n", "video,camera,,\na.mp4,c.yaml,0,\n"])
def test_a_value_below_no_title_is_refused(tmp_path, text):
    (tmp_path / "drives.csv").write_text(text)
    with pytest.raises(ValueError, match="a column without a title, with '0'; give it a title, or leave it"):
        read_manifest(tmp_path / "drives.csv")


def test_a_csv_column_that_is_there_twice_is_refused(tmp_path):
    (tmp_path / "drives.csv").write_text("video,camera, video\na.mp4,c.yaml,b.mp4\n")
    with pytest.raises(ValueError, match="expected YAML or CSV, got: the column 'video' twice"):
        read_manifest(tmp_path / "drives.csv")


def test_the_command_says_it_in_a_line_and_status_2(write, tmp_path, capsys):
    path = write([{"video": "../a.mp4", "camera": "c.yaml"}])
    assert main(["fleet", str(path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "which leaves it" in said
    assert not (tmp_path / "out").exists()


def test_one_drive_under_two_names_is_refused(write, tmp_path):
    rows = [
        {"video": "a.mp4", "camera": "c.yaml", "name": "one"},
        {"video": "link.mp4", "camera": "c.yaml", "name": "two"},
    ]
    path = write(rows)
    (path.parent / "a.mp4").write_text("video")
    (path.parent / "link.mp4").symlink_to("a.mp4")
    with pytest.raises(ValueError, match=r"each drive once.* got 'one' and 'two' of the same"):
        read_manifest(path)
    rows[1]["start"] = "60"
    assert [drive.name for drive in read_manifest(write(rows))] == ["one", "two"]


@pytest.mark.parametrize("video", ["rtsp://user:secret@camera/1", "/dev/video0", "-"])
def test_a_stream_is_no_drive(write, video):
    with pytest.raises(ValueError, match=r"drive 1: video: expected a file .*; use lanebev run") as caught:
        read_manifest(write([{"video": video, "camera": "c.yaml"}]))
    assert "secret" not in str(caught.value)
