"""The output folder: all of it or nothing; extrinsics.csv exactly as promised."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from lanebev import Calibration, Extrinsics, Reason, Status
from lanebev.io.covariances import read_covariances, write_covariances
from lanebev.io.output.folder import OutputFolder, check_inputs_stay
from lanebev.io.results import CSV_COLUMNS, extrinsics_row, read_extrinsics, write_extrinsics

ROW = "7,0.5,1.25,-0.5,0.25,1.3,0.1,0.2,0.3,0.02,TRACKING,9,,,0.000000000"


def _row(frame=0, image="", reasons=Reason.NONE, curvature=-1.25e-5):
    pose = Extrinsics(*(torch.tensor([math.radians(v)]) for v in (1.0, -2.0, 3.0)), torch.tensor([1.5]))
    cov = torch.diag(torch.tensor([math.radians(0.1), math.radians(0.2), math.radians(0.3), 0.04]) ** 2)[None]
    status = torch.tensor([int(Status.TRACKING)])
    calibration = Calibration(pose, cov, status, torch.ones(1, 4))
    weight = torch.tensor([[1.0, 0.5, 0.0, 0.0]])
    vertical = None if curvature is None else torch.tensor([curvature])
    return extrinsics_row(frame, 0.04 * frame, calibration, weight, image, reasons, vertical)


def test_csv_is_as_promised(tmp_path):
    write_extrinsics(tmp_path / "e.csv", [_row(0), _row(1, "a,b.jpg")])
    lines = (tmp_path / "e.csv").read_text().splitlines()
    assert lines[0] == (
        "frame,time_s,pitch_deg,yaw_deg,roll_deg,height_m,pitch_std_deg,yaw_std_deg,roll_std_deg,"
        "height_std_m,status,segments,image,reasons,vertical_curvature_per_m"
    )
    expected = (
        "0,0.000000,1.000000,-2.000000,3.000000,1.500000,0.100000,0.200000,0.300000,0.040000,TRACKING,2,,,"
        "-0.000012500"
    )
    assert lines[1] == expected
    assert lines[2].endswith('TRACKING,2,"a,b.jpg",,-0.000012500')
    assert CSV_COLUMNS[12] == "image"  # the 13 columns up to it are promised; further ones come after them


def test_csv_tells_the_reasons_of_a_frame(tmp_path):
    row = _row(reasons=Reason.ROLL_UNSEEN | Reason.LANE_CHANGE)
    write_extrinsics(tmp_path / "e.csv", [row, _row(1)])
    assert (tmp_path / "e.csv").read_text().splitlines()[1].endswith(",ROLL_UNSEEN|LANE_CHANGE,-0.000012500")
    assert [row.reasons for row in read_extrinsics(tmp_path / "e.csv")] == ["ROLL_UNSEEN|LANE_CHANGE", ""]


@pytest.mark.parametrize("missing", [1, 2])
def test_csv_of_an_earlier_version_is_read(tmp_path, missing):
    """Without the vertical curvature, and without the reasons too."""
    write_extrinsics(tmp_path / "e.csv", [_row(0)])
    lines = (tmp_path / "e.csv").read_text().splitlines()
    (tmp_path / "old.csv").write_text("\n".join(line.rsplit(",", missing)[0] for line in lines))
    (expected,) = read_extrinsics(tmp_path / "e.csv")
    assert expected.vertical_curvature_per_m == -1.25e-5
    assert read_extrinsics(tmp_path / "old.csv") == [expected._replace(vertical_curvature_per_m=None)]


def test_csv_has_no_vertical_curvature_of_a_plane_road(tmp_path):
    write_extrinsics(tmp_path / "e.csv", [_row(0, curvature=None)])
    assert (tmp_path / "e.csv").read_text().splitlines()[1].endswith("TRACKING,2,,,")
    assert read_extrinsics(tmp_path / "e.csv")[0].vertical_curvature_per_m is None


def test_csv_keeps_a_file_name_that_is_no_text(tmp_path):
    name = os.fsdecode(b"b\xffd.jpg")
    write_extrinsics(tmp_path / "e.csv", [_row(0, name)])
    assert b"b\xffd.jpg" in (tmp_path / "e.csv").read_bytes()
    assert read_extrinsics(tmp_path / "e.csv")[0].image == name


def test_csv_round_trip(tmp_path):
    write_extrinsics(tmp_path / "e.csv", [_row(0), _row(1, "a,b.jpg")])
    rows = read_extrinsics(tmp_path / "e.csv")
    assert [row.frame for row in rows] == [0, 1]
    assert rows[1].image == "a,b.jpg"
    assert rows[0].yaw_deg == -2.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the columns"),
        ("a,b\n1,2\n", "expected the columns"),
        ("0,1\n", "line 2: expected 15 values"),
        (f"{ROW}\n\n{ROW.replace('7,', '6,', 1)}\n", "line 4: expected frames in order, got 6 after 7; were"),
        (
            f"{ROW}\n{ROW}\n",
            "line 3: expected frames in order, got 7 after 7; were the rows sorted or copied",
        ),
        (ROW.replace("7,", "7.0,", 1), "line 2: frame: expected a value as the run wrote it, got '7.0'"),
        (ROW.replace("0.5", "00:00:00.5"), "line 2: time_s: expected a value as the run wrote it"),
        (ROW.replace("TRACKING", "tracking"), "line 2: status: expected a value as the run wrote it"),
        (ROW[:40], "line 2: expected 15 values, got .*; is the file cut?"),
    ],
)
def test_foreign_csv(tmp_path, text, message):
    header = ",".join(CSV_COLUMNS) + "\n" if "line " in message else ""
    (tmp_path / "e.csv").write_text(header + text)
    with pytest.raises(ValueError, match=message):
        read_extrinsics(tmp_path / "e.csv")
    with pytest.raises(ValueError, match="No such file"):
        read_extrinsics(tmp_path / "none.csv")


def test_csv_with_a_byte_order_mark_and_empty_lines_is_read(tmp_path):
    text = ",".join(CSV_COLUMNS) + f"\r\n{ROW}\r\n\r\n"
    (tmp_path / "e.csv").write_bytes(("\ufeff" + text).encode())
    (row,) = read_extrinsics(tmp_path / "e.csv")
    assert (row.frame, row.pitch_deg, row.status, row.vertical_curvature_per_m) == (7, 1.25, "TRACKING", 0.0)


def test_csv_of_a_spreadsheet_says_whose_to_take(tmp_path):
    for sign, code in ((";", "utf-8"), ("\t", "utf-8"), (",", "utf-16")):
        (tmp_path / "e.csv").write_bytes((sign.join(CSV_COLUMNS) + "\n").encode(code))
        with pytest.raises(ValueError, match="if another program saved it, take the run's own file") as error:
            read_extrinsics(tmp_path / "e.csv")
        assert "\n" not in str(error.value)


def test_covariances_out_of_order_are_refused(tmp_path):
    write_covariances(tmp_path / "c.csv", np.eye(4)[None] * np.arange(1.0, 4.0)[:, None, None])
    header, *rows = (tmp_path / "c.csv").read_text().splitlines()
    assert read_covariances(tmp_path / "c.csv")[:, 0, 0].tolist() == [1, 2, 3]
    for order in ((2, 1, 0), (0, 0, 1)):
        (tmp_path / "c.csv").write_text("\n".join([header, *(rows[place] for place in order)]))
        with pytest.raises(ValueError, match=r"line [34]: expected frames in order, got"):
            read_covariances(tmp_path / "c.csv")


def test_folder_appears_whole(tmp_path):
    with OutputFolder(tmp_path / "a" / "out") as out:
        (out / "extrinsics.csv").write_text("1")
        assert not (tmp_path / "a" / "out").exists()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["out"]
    assert (tmp_path / "a" / "out" / "extrinsics.csv").read_text() == "1"
    assert os.access(tmp_path / "a" / "out", os.R_OK)


def test_nothing_is_left_after_an_error(tmp_path):
    def fail():
        with OutputFolder(tmp_path / "a" / "b" / "out") as out:
            (out / "extrinsics.csv").write_text("half")
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_run_is_replaced_or_untouched(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    for name in ("extrinsics.csv", "bev.mp4", "mine.txt"):
        (folder / name).write_text("old")

    def run(fail):
        with OutputFolder(folder) as out:
            (out / "extrinsics.csv").write_text("new")
            (out / "bev.png").write_text("new")
            if fail:
                raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        run(fail=True)
    assert {path.name: path.read_text() for path in folder.iterdir()} == {
        "extrinsics.csv": "old", "bev.mp4": "old", "mine.txt": "old",
    }  # fmt: skip
    run(fail=False)
    assert {path.name: path.read_text() for path in folder.iterdir()} == {
        "extrinsics.csv": "new", "bev.png": "new", "mine.txt": "old",
    }  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_unwritable_folder_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("I am a file")
    for folder in (tmp_path / "file", tmp_path / "file" / "out", tmp_path / "file" / "a" / "out"):
        with pytest.raises(ValueError, match="expected one that can be written") as error:
            OutputFolder(folder).__enter__()
        assert "\n" not in str(error.value)
        assert "--out" in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_link_to_a_folder_elsewhere_is_filled_there(tmp_path, monkeypatch):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk", target_is_directory=True)
    (tmp_path / "new").symlink_to(tmp_path / "disk" / "new", target_is_directory=True)
    replace = Path.replace

    def on_one_disk(self, target):
        if self.resolve().is_relative_to(tmp_path / "disk") and target.resolve().is_relative_to(
            tmp_path / "disk"
        ):
            return replace(self, target)
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(Path, "replace", on_one_disk)
    monkeypatch.setattr(Path, "rename", on_one_disk)
    for folder in (tmp_path / "link", tmp_path / "new"):
        with OutputFolder(folder) as out:
            (out / "extrinsics.csv").write_text("new")
        assert folder.is_symlink()
        assert (folder / "extrinsics.csv").read_text() == "new"
    names = sorted(path.name for path in (tmp_path / "disk").iterdir())
    assert names == ["extrinsics.csv", "new"]


def test_a_folder_where_an_output_goes_is_refused_before_the_work(tmp_path):
    (tmp_path / "report.html").mkdir()
    (tmp_path / "extrinsics.csv").write_text("old")
    with pytest.raises(ValueError, match=r"a folder report\.html in it, where a file goes; .* --out"):
        OutputFolder(tmp_path).__enter__()
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "extrinsics.csv"}


def test_inputs_are_not_outputs(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "lanes.json").write_text("mine")
    (tmp_path / "link.json").symlink_to(out / "lanes.json")
    check_inputs_stay(out, [tmp_path / "lanes.json", out / "drive.mp4", out / "drive" / "bev.mp4"])
    check_inputs_stay(tmp_path / "other", [out / "lanes.json"])
    for path in (out / "lanes.json", tmp_path / "link.json", tmp_path / "a" / ".." / "out" / "bev.mp4"):
        with pytest.raises(ValueError, match=r"expected a file that the run does not replace, .* --out"):
            check_inputs_stay(out, [tmp_path / "drive.mp4", path])
