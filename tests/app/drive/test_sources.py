"""Streams and the frames that are taken of a source, as a person uses them; only this machine is asked."""

import gc
import io
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from fractions import Fraction
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lanebev import Camera
from lanebev.app.config import RunConfig
from lanebev.app.config.options import parse_grid
from lanebev.app.drive.sources import first_image, make_source, source_of_run
from lanebev.app.summary import setting_words
from lanebev.camera.files import read_camera
from lanebev.cli import main
from lanebev.io.frames import Selection
from lanebev.io.images.pixels import write_png
from lanebev.io.live import open_live
from lanebev.io.opening import open_source
from lanebev.io.results import read_extrinsics
from lanebev.io.source_names import is_live, without_login
from lanebev.io.video.writer import VideoWriter
from lanebev.report.comparison import common_frames
from lanebev.report.run_folder import read_run
from tests.app.rtsp_server import RtspServer, transport_stream
from tools.stream_check import MjpegServer

SIZE = (120, 160)
CAMERA = Camera.from_fov(60.0, SIZE[1], SIZE[0])


def _image(number):
    return np.full((*SIZE, 3), 4 * (number % 60), np.uint8)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    CAMERA.to_file(root / "camera.yaml")
    with VideoWriter(root / "drive.mp4", Fraction(10)) as writer:
        for number in range(20):
            writer.write(_image(number))
    return root


def _fails(capsys, *arguments, word):
    assert main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert word in error, error


def test_what_is_taken_for_a_stream(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    live = ("/dev/video0", "rtsp://a/b", "HTTP://a/b.mp4", "-", str(tmp_path / "pipe"))
    assert all(map(is_live, live))
    assert not any(map(is_live, ("drive.mp4", "a://b", str(tmp_path), "http:/a")))


def test_some_frames_of_a_video(data):
    source = make_source(RunConfig(str(data / "drive.mp4"), "c", start=0.45, end=1.55, every=3))
    frames = list(source)
    assert [frame.source_number for frame in frames] == [6, 9, 12, 15]
    assert [frame.number for frame in frames] == [0, 1, 2, 3]
    assert [frame.time for frame in frames] == pytest.approx([0, 0.3, 0.6, 0.9])
    assert [frame.dt for frame in frames] == pytest.approx([0.3] * 4)
    assert [frame.image.mean() for frame in frames] == pytest.approx([24, 36, 48, 60], abs=3)
    assert source.taken_count == 4


def test_all_frames_are_as_they_were(data):
    frames = list(open_source(str(data / "drive.mp4")))
    assert [frame.source_number for frame in frames] == [None] * 20


def test_lanes_go_with_the_frames_that_are_taken(data, tmp_path):
    lines = [
        f'{{"raw_file": "{number}", "h_samples": [90, 100, 110], "lanes": [[{50 - number}, 45, 40]]}}'
        for number in range(20)
    ]
    (tmp_path / "lanes.json").write_text("\n".join(lines))
    fixed = ["run", f"{data}/drive.mp4", "--camera", f"{data}/camera.yaml", "--no-video", "--grid"]
    fixed += ["3:20,-5:5/0.25", "--lanes", f"{tmp_path}/lanes.json"]
    assert main([*fixed, "--start", "0.5", "--end", "1.1", "--every", "2", "--out", f"{tmp_path}/out"]) == 0
    rows = read_extrinsics(tmp_path / "out" / "extrinsics.csv")
    assert [row.time_s for row in rows] == pytest.approx([0, 0.2, 0.4])
    assert not {"bev.mp4", "overlay.mp4"} & {path.name for path in (tmp_path / "out").iterdir()}
    seen = (tmp_path / "out" / "lanes.json").read_text().splitlines()
    for line, number in zip(seen, (6, 8, 10), strict=True):
        assert f"[{50 - number}.0, 90.0]" in line


def test_the_lanes_of_a_part_of_a_video_fit_the_same_part(data, tmp_path, capsys):
    lines = [
        f'{{"raw_file": "{number}", "h_samples": [90, 100, 110], "lanes": [[{50 - number}, 45, 40]]}}'
        for number in range(20)
    ]
    (tmp_path / "lanes.json").write_text("\n".join(lines))
    fixed = [
        "run",
        f"{data}/drive.mp4",
        "--camera",
        f"{data}/camera.yaml",
        "--no-video",
        "--grid",
        "3:20,-5:5/0.25",
    ]
    part = ["--start", "0.5", "--end", "1.1", "--every", "2"]
    whole = [*fixed, "--lanes", f"{tmp_path}/lanes.json", "--out", f"{tmp_path}/whole"]
    first = [*fixed, *part, "--lanes", f"{tmp_path}/lanes.json", "--out", f"{tmp_path}/first"]
    again = [*fixed, *part, "--lanes", f"{tmp_path}/first/lanes.json", "--out", f"{tmp_path}/again"]
    for arguments in (whole, first, again):
        assert main(arguments) == 0
    assert (tmp_path / "first" / "extrinsics.csv").read_text() == (
        tmp_path / "again" / "extrinsics.csv"
    ).read_text()
    other = [*fixed, "--lanes", f"{tmp_path}/first/lanes.json", "--out", f"{tmp_path}/no"]
    _fails(capsys, *other, word="expected 20 entries")
    page = tmp_path / "page.html"
    assert main(["compare", f"{tmp_path}/whole", f"{tmp_path}/first", "--out", f"{page}"]) == 0
    assert capsys.readouterr().out.startswith("3 frames in common")
    pairs = common_frames(*(read_run(tmp_path / name) for name in ("whole", "first")))
    assert [(a.frame, b.frame) for a, b in pairs] == [(6, 0), (8, 1), (10, 2)]
    taken = replace(open_source(f"{data}/drive.mp4"), selection=read_run(tmp_path / "first").selection())
    assert [frame.source_number for frame in taken] == [6, 8, 10]
    assert float(setting_words(12345.678901)) == 12345.678901


def test_the_source_of_a_run_has_its_frame_rate(data, tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(8):
        write_png(tmp_path / "images" / f"{number}.png", _image(number))
    source = f"{tmp_path}/images"
    (tmp_path / "lanes.json").write_text('{"raw_file": "0.png", "h_samples": [90], "lanes": []}')
    fixed = ["run", source, "--camera", f"{data}/camera.yaml", "--no-video", "--grid", "3:20,-5:5/0.25"]
    part = ["--fps", "10", "--start", "0.25", "--end", "0.65", "--lanes", f"{tmp_path}/lanes.json"]
    assert main([*fixed, *part, "--out", f"{tmp_path}/out"]) == 0
    run = read_run(tmp_path / "out")
    assert (run.fps, run.topic) == (10.0, None)
    names = [Path(row.image).name for row in run.rows]
    assert names == [f"{number}.png" for number in (3, 4, 5, 6)]
    assert [Path(frame.name).name for frame in source_of_run(source, run)] == names


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--start", "2.5"), "got none; "),
        (("--start", "-1"), "start: expected 0 s or later"),
        (("--start", "2", "--end", "1"), "end: expected a time after --start 2"),
        (("--every", "0"), "every: expected 1 or more"),
    ],
)
def test_settings_that_take_nothing(data, tmp_path, capsys, arguments, word):
    fixed = ("run", data / "drive.mp4", "--camera", data / "camera.yaml", "--out", tmp_path / "out")
    _fails(capsys, *fixed, *arguments, word=word)
    assert not (tmp_path / "out").exists()


def test_the_first_image_of_a_source(data):
    source = open_source(str(data / "drive.mp4"))
    assert first_image(source).shape[:2] == source.image_size
    assert first_image(replace(source, selection=Selection(start=1e3))) is None


def test_a_grid_by_its_text():
    assert parse_grid("3:60, -10:10/0.05") == RunConfig("a", "b").grid
    for text, word in (("3:60", "NEAR:FAR"), ("60:3,-1:1/.1", "NEAR < FAR"), ("1:9,-5:5/1e-3", "NEAR:FAR")):
        with pytest.raises(ValueError, match=word):
            parse_grid(text)
    with pytest.raises(ValueError, match="16 to 4096 pixels"):
        parse_grid("3:60,-10:10/0.001")


def test_a_stream_drops_what_it_cannot_look_at():
    with MjpegServer([_image(number) for number in range(60)], 50.0) as server:
        source = open_live(server.address)
        delays = []
        for frame in source:
            time.sleep(0.1)  # five frames come meanwhile
            delays.append(source.figures.longest_delay)
            if frame.number == 7:
                source.stop()
    assert source.figures.seen == 8
    assert 16 <= source.figures.dropped <= 60
    assert max(delays) < 0.5
    assert frame.time == pytest.approx(0.7, abs=0.4)  # by arrival
    assert f"8 frames used, {source.figures.dropped} dropped" in source.figures.words()


def test_nothing_queues_before_a_stream_is_looked_at():
    images = [_image(number) for number in range(60)]
    with MjpegServer(images, 50.0) as server:
        source = open_live(server.address)
        time.sleep(0.6)  # as while a network is loaded: thirty frames come
        first = next(iter(source))
        newest = server.sent - 1
        source.stop()
    assert source.figures.dropped >= 15
    assert first.image.mean() == pytest.approx(4 * (newest % 60), abs=4 * 8)
    assert source.figures.longest_wait < 0.3


def test_an_unused_stream_is_closed():
    with MjpegServer([_image(0)], 50.0) as server:
        source = open_live(server.address)
        slot = source.slot
        del source
        gc.collect()
        assert slot.is_stopped


@pytest.mark.parametrize("breaks_at", [None, 20])
def test_an_rtsp_stream(breaks_at):
    content = transport_stream([_image(number) for number in range(40)], fps=20)
    with RtspServer(content, 1.0, breaks_at) as server:
        source = open_live(server.address)
        means = [frame.image.mean() for frame in source]
    figures = source.figures
    assert len(means) == figures.seen >= 2
    assert means == sorted(means)
    if breaks_at is None:
        assert 30 <= figures.seen + figures.dropped <= 40


def test_an_rtsp_stream_is_all_there_if_it_may_wait():
    content = transport_stream([_image(number) for number in range(40)], fps=20, bframes=2)
    with RtspServer(content, 0.2) as server:
        frames = list(open_live(server.address, keep_all=True))
    assert 36 <= len(frames) <= 40  # the connection ends before the last packets are known to be whole
    assert [frame.dt for frame in frames[:36]] == pytest.approx([0.05] * 36, abs=1e-4)
    means = [frame.image.mean() for frame in frames[:36]]
    assert means == pytest.approx([4 * number for number in range(36)], abs=4)


@pytest.mark.slow
def test_a_stream_that_ends_ends_the_run(data, tmp_path, capsys):
    with MjpegServer([_image(number) for number in range(12)], 60.0, limit=12) as server:
        fixed = ["--camera", f"{data}/camera.yaml", "--out", f"{tmp_path}/out", "--keep-all"]
        assert main(["run", server.address, *fixed]) == 0
    out = capsys.readouterr().out
    assert "0 dropped" in out
    rows = read_extrinsics(tmp_path / "out" / "extrinsics.csv")
    assert 10 <= len(rows) <= 12  # the demuxer learns of the last one's end at the next
    assert (tmp_path / "out" / "overlay.mp4").exists()


def _has_lines(folder):
    """Whether a run below this folder has looked at two frames."""
    return any(path.read_text().count("\n") >= 2 for path in folder.rglob("lanes.json"))


def _interrupt_when(begun, seconds=60.0):
    end = time.monotonic() + seconds
    while not begun() and time.monotonic() < end:
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.slow
def test_ctrl_c_is_the_normal_end_of_a_stream(data, tmp_path, capsys):
    with MjpegServer([_image(number) for number in range(60)], 30.0) as server:
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupter = threading.Thread(target=_interrupt_when, args=(lambda: _has_lines(tmp_path),))
        interrupter.start()
        try:
            status = main(
                ["run", server.address, "--camera", f"{data}/camera.yaml", "--out", f"{tmp_path}/out"]
            )
        finally:
            interrupter.join()
            signal.signal(signal.SIGINT, before)
    assert status == 0
    assert "dropped" in capsys.readouterr().out
    assert len(read_extrinsics(tmp_path / "out" / "extrinsics.csv")) > 1
    assert (tmp_path / "out" / "state.safetensors").exists()


@pytest.mark.slow
def test_a_pipe(data, tmp_path):
    command = [sys.executable, "-m", "lanebev", "run", "-", "--camera", f"{data}/camera.yaml", "--keep-all"]
    with VideoWriter(tmp_path / "drive.ts", Fraction(10)) as writer:
        for number in range(10):
            writer.write(_image(number))
    with open(tmp_path / "drive.ts", "rb") as file:
        command += ["--out", f"{tmp_path}/out"]
        done = subprocess.run(command, stdin=file, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    rows = read_extrinsics(tmp_path / "out" / "extrinsics.csv")
    assert [row.time_s for row in rows] == pytest.approx(np.arange(10) / 10, abs=1e-3)  # the stream's own


def _jpegs(cut):
    """Eight JPEG files one after another, of which some are halves."""
    noise = np.random.default_rng(0)
    for number in range(8):
        file = io.BytesIO()
        Image.fromarray(noise.integers(0, 255, (*SIZE, 3), dtype=np.uint8)).save(file, "JPEG")
        data = file.getvalue()
        yield data[: len(data) // 2] if number in cut else data


@pytest.mark.parametrize("cut", [(), (0,), (3,), (3, 4), (7,)])
def test_half_a_jpeg_on_a_pipe_is_no_frame(tmp_path, cut):
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=(b"".join(_jpegs(cut)),))
    writer.start()
    source = open_live(str(tmp_path / "pipe"), keep_all=True)
    assert len(list(source)) == 8 - len(cut)
    writer.join()
    assert (f" {len(cut)} damaged and left out," in source.figures.words()) == bool(cut)


@pytest.mark.parametrize(("fps", "interval"), [(Fraction(10), 0.1), (None, 0.04)])
def test_frames_without_times_on_a_pipe_have_the_stated_rate(tmp_path, fps, interval):
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=(b"".join(_jpegs(())),))
    writer.start()
    source = open_live(str(tmp_path / "pipe"), fps, keep_all=True)
    assert [frame.dt for frame in source] == pytest.approx([interval] * 8)
    writer.join()
    assert source.problem.endswith("" if fps else "has no times, and is taken for 25 frames per second")


def test_a_pipe_without_a_writer_is_one_line(tmp_path, capsys, data, monkeypatch):
    monkeypatch.setattr("lanebev.pipes._LONGEST_WAIT", 0.3)
    fixed = ("--camera", data / "camera.yaml", "--out", tmp_path / "out")
    os.mkfifo(tmp_path / "pipe")
    _fails(capsys, "run", tmp_path / "pipe", *fixed, word="pipe: expected frames, got nothing for 0.3 s")
    with open(os.open(tmp_path / "pipe", os.O_RDWR), "wb", buffering=0) as silent:  # a writer that is silent
        _fails(capsys, "run", tmp_path / "pipe", *fixed, word="pipe: expected frames, got nothing for 0.3 s")
        monkeypatch.setattr("lanebev.pipes._LONGEST_WAIT", 30.0)
        silent.write(next(_jpegs((0,))))
        closing = threading.Timer(0.5, silent.close)
        closing.start()
        _fails(capsys, "run", tmp_path / "pipe", *fixed, word="expected a whole frame, got damaged ones only")
        closing.join()
    assert not (tmp_path / "out").exists()


def test_files_may_not_be_pipes_without_a_writer(tmp_path, capsys, data, monkeypatch):
    monkeypatch.setattr("lanebev.pipes._LONGEST_WAIT", 0.3)
    os.mkfifo(tmp_path / "pipe")
    video, camera = data / "drive.mp4", data / "camera.yaml"
    word = "camera file {}: expected a readable camera file, got: nothing for 0.3 s"
    _fails(capsys, "run", video, "--camera", tmp_path / "pipe", word=word.format(tmp_path / "pipe"))
    word = "got: a pipe; write the lanes to a file"
    _fails(capsys, "run", video, "--camera", camera, "--lanes", tmp_path / "pipe", word=word)


def test_a_camera_comes_through_a_pipe(tmp_path, data):
    os.mkfifo(tmp_path / "pipe")
    written = (data / "camera.yaml").read_bytes()
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=(written,))
    writer.start()
    assert read_camera(tmp_path / "pipe") == read_camera(data / "camera.yaml")
    writer.join()


@pytest.mark.slow
def test_a_terminal_is_no_pipe(data, tmp_path):
    command = [sys.executable, "-m", "lanebev", "run", "-", "--camera", f"{data}/camera.yaml"]
    leader, terminal = os.openpty()
    try:
        done = subprocess.run(
            command, stdin=terminal, capture_output=True, text=True, timeout=120, check=False
        )
    finally:
        os.close(leader)
        os.close(terminal)
    assert done.returncode == 2
    assert done.stderr.endswith("stream standard input: expected a pipe, as from ffmpeg, got a terminal\n")


def test_a_stream_that_does_not_open(data, tmp_path, capsys):
    fixed = ("--camera", data / "camera.yaml", "--out", tmp_path / "out")
    _fails(
        capsys,
        "run",
        "http://127.0.0.1:9/none",
        *fixed,
        word="that opens, got: Connection refused",
    )
    _fails(capsys, "run", "/dev/video99", *fixed, word="that opens, got: No such file")
    _fails(capsys, "run", "-", *fixed, "--stills", word="expected no --stills with a stream")
    assert not (tmp_path / "out").exists()


def test_a_login_is_in_no_message_and_no_report(tmp_path, capsys, data):
    assert without_login("RTSP://user:a@b@cam.local:554/live?x=@") == "RTSP://cam.local:554/live?x=@"
    assert without_login("https://cam/a@b.mp4") == "https://cam/a@b.mp4"
    assert without_login("folder/a://user:b@c") == "folder/a://user:b@c"
    assert without_login("-") == "-"
    address = "HTTP://user:secret@127.0.0.1:9/none"
    for more in ((), ("--stills",), ("--start", "1")):
        assert main(["run", address, "--camera", f"{data}/camera.yaml", *more]) == 2
        error = capsys.readouterr().err
        assert "HTTP://127.0.0.1:9/none" in error
        assert "secret" not in error
    handler = partial(SimpleHTTPRequestHandler, directory=data)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"HTTP://user:secret@127.0.0.1:{server.server_port}/drive.mp4"
        live = open_live(address)
        assert len(list(live)) > 0
        server.shutdown()
    assert live.source == f"HTTP://127.0.0.1:{server.server_port}/drive.mp4"


def test_a_topic_is_of_a_bag(capsys, data, tmp_path):
    fixed = ("--camera", data / "camera.yaml", "--out", tmp_path / "out", "--topic", "/camera/image")
    _fails(capsys, "run", data / "drive.mp4", *fixed, word="topic: expected a bag as the source, got ")
    _fails(capsys, "run", "-", *fixed, word="expected no --topic with a stream")
    with pytest.raises(ValueError, match="got nothing there"):
        make_source(RunConfig(str(tmp_path / "bag"), fov=60.0, topic="/camera/image"))


def test_a_stream_is_not_cut(capsys, data):
    arguments = ("run", "-", "--camera", data / "camera.yaml", "--start", "1")
    _fails(capsys, *arguments, word="expected no --start, --end")


def test_images_much_higher_than_wide_are_refused(tmp_path, capsys):
    write_png(tmp_path / "a.png", np.zeros((61, 15, 3), np.uint8))
    arguments = ("run", tmp_path / "a.png", "--fov", 60, "--out", tmp_path / "out")
    _fails(capsys, *arguments, word="at most 4 times as high as wide, got 15 x 61 px")
    assert not (tmp_path / "out").exists()
