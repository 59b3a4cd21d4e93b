"""Two runs side by side: frames in common, differences with known answers, what is read from a folder."""

import re

import numpy as np
import pytest

from lanebev.cli import main
from lanebev.io.results import write_extrinsics
from lanebev.report.comparison import (
    common_frames,
    comparison_summary,
    differences,
    differing,
    render_comparison,
)
from lanebev.report.page import write_report
from lanebev.report.run_folder import FIRST_NUMBER, RunFolder, read_run
from tests.report.report_data import FRAMES, eventful_report, eventful_rows

HOSTILE = "</script><script>alert(1)</script>\"'<img src=x onerror=alert(2)>"
QUIET = [eventful_rows()[20]._replace(frame=i, time_s=i / 20) for i in range(50)]


def _changed(rows, **by):
    """The rows with numbers added to their fields."""
    return [row._replace(**{name: getattr(row, name) + value for name, value in by.items()}) for row in rows]


def _write_run(folder, report):
    folder.mkdir()
    write_report(folder / "report.html", report)
    write_extrinsics(folder / "extrinsics.csv", list(report.rows))
    return folder


def test_frames_are_matched_by_number():
    pairs = common_frames(RunFolder("a", QUIET[:30]), RunFolder("b", QUIET[20:]))
    assert [(a.frame, b.frame) for a, b in pairs] == [(i, i) for i in range(20, 30)]
    with pytest.raises(ValueError, match="expected two runs with frames in common, got none"):
        common_frames(RunFolder("a", QUIET[:10]), RunFolder("b", QUIET[20:]))


def test_frames_of_parts_of_a_source_are_matched_by_their_number_in_it():
    """Run a took every fourth frame from 0 on, run b all from 6 on."""
    a = RunFolder("a", QUIET[:10], {"--every": "4", FIRST_NUMBER: "0"})
    b = RunFolder("b", QUIET[:12], {"--every": "1", FIRST_NUMBER: "6"})
    assert [(x.frame, y.frame) for x, y in common_frames(a, b)] == [(2, 2), (3, 6), (4, 10)]


def test_images_are_matched_by_the_name_of_their_file():
    first = [row._replace(image=f"/a/{row.frame}.jpg") for row in QUIET[:4]]
    second = [row._replace(frame=i, image=f"/b/{row.frame}.jpg") for i, row in enumerate(QUIET[2:6])]
    assert [(a.frame, b.frame) for a, b in common_frames(RunFolder("a", first), RunFolder("b", second))] == [
        (2, 0),
        (3, 1),
    ]
    alike = [row._replace(image=f"/{row.frame}/same.jpg") for row in QUIET[:4]]
    assert len(common_frames(RunFolder("a", alike), RunFolder("b", alike))) == 4


def test_images_of_the_same_name_are_matched_by_as_much_of_their_path_as_tells_them_apart():
    def run(*images):
        return RunFolder(
            "r", [row._replace(image=image) for row, image in zip(eventful_rows(), images, strict=False)]
        )

    both, second = run("all/a/0.jpg", "all/a/1.jpg", "all/b/0.jpg"), run("b/0.jpg", "b/1.jpg")
    assert [(a.image, b.image) for a, b in common_frames(both, second)] == [("all/b/0.jpg", "b/0.jpg")]


def test_differences_have_the_known_answer():
    second = _changed(QUIET, pitch_deg=0.1, height_m=-0.02)
    second[7] = second[7]._replace(pitch_deg=QUIET[7].pitch_deg - 1.0)
    found = {each.axis: each for each in differences(list(zip(QUIET, second, strict=True)))}
    pitch = found["pitch"]
    assert (pitch.count, pitch.at) == (50, 7)
    assert pitch.mean == pytest.approx((49 * 0.1 - 1.0) / 50)
    assert pitch.rms == pytest.approx(np.sqrt((49 * 0.01 + 1.0) / 50))
    assert pitch.largest == pytest.approx(-1.0)
    assert pitch.beyond == pytest.approx(1 / 50)  # 2 · hypot(0.05, 0.05) = 0.14°
    assert found["height"].words == ["-2.0 cm", "+2.0 cm", "-2.0 cm"]
    assert found["height"].beyond == 1.0
    assert found["yaw"].rms == 0.0


def test_frames_that_one_run_does_not_measure_are_left_out():
    second = [row._replace(reasons="ROLL_UNSEEN") if row.frame < 30 else row for row in QUIET]
    second[40] = second[40]._replace(status="LOST")
    counts = {each.axis: each.count for each in differences(list(zip(QUIET, second, strict=True)))}
    assert counts == {"pitch": 49, "yaw": 49, "roll": 19, "height": 49}
    lost = [row._replace(status="LOST") for row in QUIET]
    assert differences(list(zip(QUIET, lost, strict=True))) == []


def test_settings_that_differ():
    assert differing({"a": "1", "b": "2", "c": "3"}, {"a": "1", "b": "5", "d": "4"}) == {
        "b": ("2", "5"), "c": ("3", "–"), "d": ("–", "4"),
    }  # fmt: skip


def test_a_folder_is_read_back(tmp_path):
    report = eventful_report(facts={"calibrator": "joint", "mount": "CALIBRATED"})
    run = read_run(_write_run(tmp_path / "run", report))
    assert (run.name, len(run.rows)) == ("run", FRAMES)
    assert run.settings == {"calibrator": "joint"}
    assert run.lens["distortion k1"] == "-0.31"
    assert list(run.pictures) == list(range(0, FRAMES, 20))
    assert run.pictures[20]["image"].startswith("data:image/jpeg;base64,")


def _script(name, text):
    return f'<script type="application/json" id="{name}">{text}</script>'


@pytest.mark.parametrize(
    "data",
    [
        "no page at all",
        _script("data", '{"place": [0], "frame": [0], "pictures": 3}'),
        _script("data", "[1") + _script("run", "7"),
        _script("data", '{"place": [0], "frame": [0], "pictures": {"0": {"image": "javascript:alert(1)"}}}'),
    ],
)
def test_a_page_that_is_not_ours_gives_no_pictures_and_settings(tmp_path, data):
    run = read_run(_write_run(tmp_path / "run", eventful_report()))
    assert run.pictures
    (tmp_path / "run" / "report.html").write_text(data)
    run = read_run(tmp_path / "run")
    assert not any(run.pictures.values())
    assert run.settings == {}
    (tmp_path / "run" / "report.html").unlink()
    assert read_run(tmp_path / "run").rows == run.rows


@pytest.mark.slow
def test_the_page_shows_both_and_escapes_them(tmp_path):
    rows = [row._replace(image=f"{row.frame} {HOSTILE}") for row in eventful_rows()]
    first = read_run(_write_run(tmp_path / "a", eventful_report(rows=rows, facts={HOSTILE: HOSTILE})))
    second = RunFolder(HOSTILE, _changed(rows, yaw_deg=0.2), {HOSTILE: "x"}, first.lens, first.pictures)
    page = render_comparison(first, second)
    assert page.count("<script") == render_comparison(first, first).count("<script")
    assert "<img src=x" not in page
    assert "alert(2)&gt;" in page
    assert "+0.200°" in page
    assert re.search(r"Settings that differ.*\bx</td>", page, re.S)
    assert page.count('src="data:image/jpeg') >= 4
    assert not re.findall(r"[\"'`]https?://(?!www\.w3\.org/)", page)


def test_one_common_frame_makes_a_page():
    page = render_comparison(RunFolder("a", QUIET[:1]), RunFolder("b", QUIET[:3]))
    assert "common frames: 1" in page
    assert "a report.html is missing" in page
    assert len(page) < 60_000  # without Bokeh


def test_images_on_their_own_are_compared():
    first = [row._replace(image=f"{row.frame}.jpg", time_s=0.0) for row in QUIET]
    page = render_comparison(RunFolder("a", first), RunFolder("b", _changed(first, roll_deg=1.0)))
    assert "50 of 50 images calibrated" in page


@pytest.mark.slow
def test_command(tmp_path, capsys):
    _write_run(tmp_path / "a", eventful_report())
    _write_run(tmp_path / "b", eventful_report(rows=_changed(eventful_rows(), height_m=0.1)))
    out = tmp_path / "new" / "page.html"
    arguments = ["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(out)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "240 frames in common; b minus a:" in printed
    assert "height: mean +10.0 cm, rms 10.0 cm, largest +10.0 cm" in printed
    assert printed.splitlines()[-1] == str(out)
    assert "a and b" in out.read_text(encoding="utf-8")
    assert [path.name for path in out.parent.iterdir()] == ["page.html"]
    assert main([*arguments[:-1], str(tmp_path)]) == 2
    assert (
        "expected a file that can be written, got: a folder; give another with --out"
        in capsys.readouterr().err
    )
    (tmp_path / "empty").mkdir()
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "empty")]) == 2
    assert "extrinsics.csv: expected a readable" in capsys.readouterr().err


def test_a_run_without_frames_is_refused(tmp_path):
    write_extrinsics(tmp_path / "extrinsics.csv", [])
    with pytest.raises(ValueError, match="expected a row per frame, got none"):
        read_run(tmp_path)


def test_summary_names_the_settings():
    runs = RunFolder("a", QUIET, {"calibrator": "joint"}), RunFolder("b", QUIET, {"calibrator": "two-stage"})
    assert comparison_summary(*runs).splitlines()[-1] == "calibrator: joint | two-stage"
