"""Files of the source, or the output folder, change during a run."""

import errno
import os
import shutil
import signal
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lanebev.app.config import RunConfig
from lanebev.app.continued.source_changes import changes_remark, count_remark, files_of
from lanebev.app.fleet import worker
from lanebev.app.fleet.plan import Task, earlier_outcome, write_mark
from lanebev.app.run import run
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import Selection
from lanebev.io.opening import open_source
from lanebev.io.output.folder import OutputFolder, OutputFolderError
from tests.app.noise_drive import HEIGHT, WIDTH, write_drive
from tests.app.rtsp_server import transport_stream

COUNT = 14


def _when(number, act, passes=1):
    """Return a progress that acts after some frames of the last pass."""
    begun = []

    def progress(frames, total):
        begun.append(total)
        for index, item in enumerate(frames):
            if index == number and len(begun) == passes:
                act()
            yield item
        if number is None and len(begun) == passes:
            act()

    return progress


@pytest.fixture
def images(tmp_path):
    """A camera, a folder of images, and lanes for each."""
    folder = write_drive(tmp_path, COUNT)
    (folder / "images").mkdir()
    for number in range(COUNT):
        _write(folder / "images" / f"{number}.png")
    text = (folder / "drive.json").read_text()
    (folder / "drive.json").write_text(text.replace('"x/', '"images/').replace('", "h_', '.png", "h_'))
    return folder


def _write(path, value=70):
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), value, np.uint8)).save(path)


def _config(folder, source, **settings):
    settings = {"lanes": str(folder / "drive.json"), "no_video": True, "fps": 10.0} | settings
    return RunConfig(str(folder / source), str(folder / "camera.yaml"), str(folder / "out"), **settings)


def _change(folder):
    (folder / "images" / f"{COUNT - 1}.png").unlink()
    _write(folder / "images" / f"{COUNT - 2}.png", 80)
    whole = (folder / "images" / f"{COUNT - 3}.png").read_bytes()
    (folder / "images" / f"{COUNT - 3}.png").write_bytes(whole[: len(whole) // 2])
    for number in range(3):
        _write(folder / "images" / f"{COUNT + number}.png")


def test_images_that_come_go_or_change_during_a_run_are_told(images):
    report = run(_config(images, "images"), _when(2, lambda: _change(images)))
    assert len(report.rows) == COUNT
    assert [row.segments > 0 for row in report.rows] == [True] * (COUNT - 3) + [False, True, False]
    told = [problem for problem in report.problems if "changed during the run" in problem]
    counts = "3 new, 1 deleted, 2 written again"
    assert told == [f"{images}/images: files changed during the run: {counts}; run again when it is complete"]
    assert any(
        f"{COUNT - 1}.png: expected a whole image, got: no such file" in each for each in report.problems
    )
    quiet = run(_config(images, "images"))
    assert len(quiet.rows) == COUNT + 2
    assert not any("changed" in problem for problem in quiet.problems)


def test_a_glob_that_grows_is_told(images):
    source = open_source(f"{images}/images/*.png")
    before = files_of(source)
    assert changes_remark(source, before) == ""
    _write(images / "images" / "new.png")
    assert "during the run: 1 new;" in changes_remark(source, before)


def test_an_output_folder_in_a_bag_is_no_change(tmp_path):
    bag = FrameSource(str(tmp_path), (), Fraction(10), 1, (HEIGHT, WIDTH))
    (tmp_path / "0.mcap").touch()
    (tmp_path / "out").mkdir()
    before = files_of(bag)
    (tmp_path / "out" / "report.html").touch()
    (tmp_path / "other").mkdir()
    assert changes_remark(bag, before) == ""
    (tmp_path / "1.mcap").touch()
    assert "during the run: 1 new;" in changes_remark(bag, before)


@pytest.mark.parametrize("formats", [(), ("mcap",)])
def test_a_video_that_grows_between_two_passes_ends_where_it_ended(images, formats):
    if formats:
        pytest.importorskip("mcap")
    noise = np.random.default_rng(0)
    frames = [noise.integers(60, 90, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(COUNT + 8)]
    whole = transport_stream(frames, fps=10)
    path = images / "drive.ts"
    path.write_bytes(whole[: len(whole) * COUNT // len(frames) // 188 * 188])
    count = len(list(open_source(str(path))))
    assert 5 < count < COUNT + 4
    lines = (images / "drive.json").read_text().splitlines()
    (images / "drive.json").write_text("\n".join((2 * lines)[:count]))
    config = _config(images, "drive.ts", smooth=True, formats=formats, fps=None)
    report = run(config, _when(None, lambda: path.write_bytes(whole)))
    assert len(list(open_source(str(path)))) > count
    assert len(report.rows) == count
    assert any("drive.ts: files changed during the run: 1 written again" in each for each in report.problems)


@pytest.mark.parametrize("is_there", [False, True])
def test_an_output_folder_that_is_deleted_during_a_run_is_one_line(images, is_there):
    out = images / "out"
    if is_there:
        out.mkdir()
    partial = out / ".out.partial" if is_there else images / ".out.partial"
    with pytest.raises(
        OutputFolderError, match=r"out: expected it to stay until .* deleted meanwhile; begin"
    ):
        run(_config(images, "images"), _when(5, lambda: shutil.rmtree(out if is_there else partial)))
    assert not out.exists()
    assert not partial.exists()


def test_a_file_in_the_place_of_the_output_folder_is_one_line(tmp_path):
    out = OutputFolder(tmp_path / "out").__enter__()
    (out / "extrinsics.csv").write_text("new")
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputFolderError, match="can be written, got: Not a directory; give another"):
        out.__exit__(None, None, None)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_outputs_are_moved_leaves_none_of_an_earlier_run(tmp_path, monkeypatch, number):
    names = ["extrinsics.csv", "lanes.json", "report.html"]
    replace_file, heard = Path.replace, []

    def replace_and_send(path, target):
        os.kill(os.getpid(), number)
        return replace_file(path, target)

    def write(text):
        with OutputFolder(tmp_path / "out") as out:
            for name in names:
                (out / name).write_text(text)
            if text == "new":
                monkeypatch.setattr(Path, "replace", replace_and_send)

    before = signal.signal(number, lambda *_: heard.append(number))
    try:
        write("old")
        write("new")
        assert not heard
        os.kill(os.getpid(), number)
        assert heard == [number]  # as before
    finally:
        signal.signal(number, before)
    assert [(tmp_path / "out" / name).read_text() for name in names] == ["new"] * 3


def test_a_drive_whose_mark_has_no_room_fails_alone_and_is_run_again(images, monkeypatch):
    base = _config(images, "images", device="cpu")
    tasks = [Task(name, replace(base, out=str(images / "drives" / name)), "f") for name in "ab"]
    full = OSError(errno.ENOSPC, "No space left on device")
    room = set("b")

    def write(task, outcome):
        if task.name not in room:
            raise full
        write_mark(task, outcome)

    monkeypatch.setattr(worker, "write_mark", write)
    first, second = worker.run_tasks(tasks)
    assert "No space left on device" in first.failure
    assert not first.is_final
    assert second.frames == COUNT
    assert earlier_outcome(tasks[0]) is None
    room.add("a")
    assert [outcome.frames for outcome in worker.run_tasks(tasks)] == [COUNT, COUNT]


def test_a_mark_without_room_leaves_nothing_half_written(tmp_path, monkeypatch):
    task = Task("a", RunConfig("a", "c", str(tmp_path / "drives" / "a")), "f")
    write_mark(task, worker.Outcome("a", frames=3))
    (tmp_path / "drives" / "a" / "extrinsics.csv").touch()

    def replace_fails(self, target):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", replace_fails)
    with pytest.raises(OSError, match="No space"):
        write_mark(task, worker.Outcome("a", frames=4))
    assert earlier_outcome(task).frames == 3
    assert sorted(path.name for path in (tmp_path / "drives" / "a").iterdir()) == [
        "extrinsics.csv",
        "fleet.json",
    ]


def test_a_video_that_yields_another_number_of_frames_is_remarked_on_unless_the_number_is_an_estimate():
    whole = FrameSource("drive.mp4", (), Fraction(25), 21, (720, 1280))
    assert count_remark(whole, 21) == ""
    assert "expected 21 frames by its packets, got 20" in count_remark(whole, 20)
    part = replace(whole, selection=Selection(end=0.4))  # its times are not known, so neither are the frames
    assert count_remark(part, 9) == ""
    timed = replace(part, times=tuple(index / 25 for index in range(21)))
    assert count_remark(timed, 10) == ""
    assert "expected 10 frames" in count_remark(timed, 9)
    spaced = replace(part, has_times=False)
    assert "expected 10 frames" in count_remark(spaced, 9)
