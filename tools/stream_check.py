"""Check that a run on a stream keeps up: bounded delay, constant memory, counted dropped frames.

    python -m tools.stream_check --minutes 10

A server on a loopback address plays a rendered drive at a fixed rate as MJPEG over HTTP, and ``lanebev run``
looks at it in a process of its own until it is interrupted. Passed is what has

- every frame handed on within 0.5 s of its arrival, and its result there within 2 s: how long one frame takes
  to look at is the machine's;
- at most 1 s of frames underway, which the server has sent and the run has not received;
- as many frames used as rows written, and the others counted as dropped;
- resident memory of its own, without that of mapped files, that grows by 10 % at most after the first half
  minute.

Prints the figures, problems, and at the end all of it as a line of JSON.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lanebev.io.results import read_extrinsics
from lanebev.numbers import parse_size
from lanebev.observation.frames import image_bytes
from train.commands import command_parser

_BOUNDARY = "frame"
_WARM_UP = 30.0  # s, in which buffers fill; memory is compared from then on
_PATIENCE = 120.0  # s, until a run has looked at its first frames
_MOST_DELAY, _MOST_WAIT, _MOST_UNDERWAY = 2.0, 0.5, 1.0  # s
_MOST_GROWTH = 1.1  # resident memory at the end over that after the warm-up


@dataclass(frozen=True)
class StreamFigures:
    """Statistics of a run on a stream.

    Attributes:
        seconds: duration of the observation.
        fps: frames a second that the server sends.
        sent: frames that the server had sent when the run was told to end.
        used, dropped: frames of which the run says so.
        rows: rows of extrinsics.csv.
        wait: s at most from a frame's arrival to when it was handed on.
        delay: s at most from a frame's arrival to its result.
        memory: MiB, resident, every second after the warm-up.
    """

    seconds: float
    fps: float
    sent: int
    used: int
    dropped: int
    rows: int
    wait: float
    delay: float
    memory: tuple[float, ...]

    @property
    def underway(self) -> float:
        """Frames that were sent and had not come, as s of the stream."""
        return max(0, self.sent - self.used - self.dropped) / self.fps

    @property
    def growth(self) -> float:
        """Resident memory at the end over that after the warm-up."""
        return self.memory[-1] / self.memory[0]

    def problems(self) -> list[str]:
        """Return what is out of bounds, a line each."""
        bounds = (
            ("delay from arrival to result", self.delay, _MOST_DELAY, "s"),
            ("wait from arrival to use", self.wait, _MOST_WAIT, "s"),
            ("frames underway", self.underway, _MOST_UNDERWAY, "s"),
            ("memory at the end over that after the warm-up", self.growth, _MOST_GROWTH, ""),
        )
        found = [
            f"{name}: expected {most:g} {unit} at most, got {value:.2f}".replace("  ", " ")
            for name, value, most, unit in bounds
            if not value <= most
        ]
        if self.rows != self.used or not self.used:
            found.append(f"rows: expected one a frame of the {self.used} used, got {self.rows}")
        return found


class MjpegServer:
    """Plays images over and over as MJPEG over HTTP, on a loopback address.

    Args:
        images: (H, W, 3) RGB.
        fps: frames per second.
        limit: frames after which a stream ends, None for never.
    """

    def __init__(self, images: Sequence[NDArray[np.uint8]], fps: float, limit: int | None = None) -> None:
        pictures = [cv2.imencode(".jpg", image[..., ::-1])[1].tobytes() for image in images]
        self.sent = 0
        owner, interval = self, 1 / fps

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
                self.end_headers()
                begin, number = time.monotonic(), 0
                try:
                    while not owner._stop and (limit is None or number < limit):
                        time.sleep(max(0.0, begin + number * interval - time.monotonic()))
                        picture = pictures[number % len(pictures)]
                        head = f"--{_BOUNDARY}\r\nContent-Length: {len(picture)}\r\n"
                        self.wfile.write(
                            f"{head}Content-Type: image/jpeg\r\n\r\n".encode() + picture + b"\r\n"
                        )
                        number, owner.sent = number + 1, owner.sent + 1
                except OSError:
                    return  # the reader has gone

            def log_message(self, *_: object) -> None:
                pass

        self._stop = False
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/stream"

    def __enter__(self) -> MjpegServer:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop = True
        self._server.shutdown()
        self._server.server_close()


def resident_mib(process: int) -> float:
    """Return the resident memory (MiB) of a process that no file backs, by Linux's ``/proc``."""
    match = re.search(r"RssAnon:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())
    return 0.0 if match is None else int(match[1]) / 1024


def main(arguments: Sequence[str] | None = None) -> int:
    """Play the stream, run on it, print; return 1 if a figure is out of bounds."""
    parser = command_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument(
        "--size", type=parse_size, default=(360, 640), metavar="WxH", help="size of the frames (640x360)"
    )
    options = parser.parse_args(arguments)
    found = watch(60 * options.minutes, options.fps, options.size)
    print(f"{options.minutes:g} minutes at {options.fps:g} fps on {os.cpu_count()} cores")
    rate = found.used / found.seconds
    print(f"frames: {found.sent} sent, {found.used} used ({rate:.1f} a second), {found.dropped} dropped")
    print(f"delay from arrival to result: at most {found.delay:.2f} s, {found.wait:.2f} s of them waiting")
    print(f"underway at the end: {found.underway:.2f} s")
    low, high = found.memory[0], found.memory[-1]
    print(f"resident memory: {low:.0f} MiB after the warm-up, {high:.0f} MiB at the end")
    problems = found.problems()
    print("\n".join(problems) if problems else "passed")
    figures = asdict(found) | {"memory": [low, high], "underway": found.underway, "problems": problems}
    print(json.dumps(figures))
    return int(bool(problems))


def watch(seconds: float, fps: float, size: tuple[int, int]) -> StreamFigures:
    """Run on a stream of rendered images of a size (height, width) px; what was seen of it.

    Raises:
        RuntimeError: the run did not begin, or ended before it was told to.
    """
    from lanebev.render import Drive

    drive = Drive(10, size, 60, fps)
    images = [image_bytes(drive.frame(number).image[0]) for number in range(len(drive))]
    with tempfile.TemporaryDirectory() as temporary, MjpegServer(images, fps) as server:
        folder = Path(temporary)
        drive.camera.to_file(folder / "camera.yaml")
        command = [sys.executable, "-m", "lanebev", "run", server.address]
        command += ["--camera", str(folder / "camera.yaml"), "--out", str(folder / "out")]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
            _wait_for_lines(run, folder)
            memory = _memory(run, seconds)
            sent = server.sent
            run.send_signal(signal.SIGTERM)  # SIGINT is ignored where nohup or & began this
            said = run.communicate()[0]
        words = r"(\d+) frames used, (\d+) dropped, at most ([\d.]+) s .*?, ([\d.]+) s of them waiting"
        match = re.search(words, said)
        if run.returncode or match is None:
            raise RuntimeError(
                f"run: expected it to end well when told to, got status {run.returncode}: {said}"
            )
        rows = len(read_extrinsics(folder / "out" / "extrinsics.csv"))
    used, dropped = int(match[1]), int(match[2])
    wait, delay = float(match[4]), float(match[3])
    return StreamFigures(seconds, fps, sent, used, dropped, rows, wait, delay, tuple(memory))


def _wait_for_lines(run: subprocess.Popen[str], folder: Path) -> None:
    """Wait until a run below this folder has looked at two frames."""
    begin = time.monotonic()
    while time.monotonic() - begin < _PATIENCE and run.poll() is None:
        if any(path.read_text().count("\n") >= 2 for path in folder.rglob("lanes.json")):
            return
        time.sleep(0.1)
    run.kill()
    raise RuntimeError(f"run: expected two frames within {_PATIENCE:g} s, got fewer")


def _memory(run: subprocess.Popen[str], seconds: float) -> list[float]:
    """Return the resident memory (MiB) after the warm-up and every second from then on."""
    begin, memory = time.monotonic(), []
    warm_up = min(_WARM_UP, seconds / 2)
    while (passed := time.monotonic() - begin) < seconds and run.poll() is None:
        time.sleep(min(1.0, seconds - passed))
        if time.monotonic() - begin >= warm_up and run.poll() is None:
            memory.append(resident_mib(run.pid))
    return memory or [resident_mib(run.pid)]


if __name__ == "__main__":
    sys.exit(main())
