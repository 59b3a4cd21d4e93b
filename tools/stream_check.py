"""Check that a run on a stream keeps up: a bounded delay, flat memory, and dropped frames that are counted.

    python -m tools.stream_check --minutes 10

A server on a loopback address plays a rendered drive at a fixed rate as MJPEG over HTTP, and ``lanebev run``
looks at it in a process of its own until it is interrupted. Printed are the delay from a frame's arrival to
its result, the frames that came, were used and dropped, and the process's resident memory over time.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

_BOUNDARY = "frame"
_WARM_UP = 30.0  # s, in which buffers fill; memory is compared from then on
_MOST_DELAY = 2.0  # s
_MOST_GROWTH = 1.2  # resident memory at the end over that after the warm-up
_SMALL_IMAGE = (360, 640)


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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop = True
        self._server.shutdown()
        self._server.server_close()


def resident_mib(process: int) -> float:
    """Return the resident memory (MiB) of a process, by Linux's ``/proc``."""
    match = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())
    return 0.0 if match is None else int(match[1]) / 1024


def main(arguments: Sequence[str] | None = None) -> int:
    """Play, look, print; 1 if the delay is not bounded or memory is not flat."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--fps", type=float, default=30.0)
    options = parser.parse_args(arguments)
    from lanebev.render import Drive

    drive = Drive(10, _SMALL_IMAGE, 60, options.fps)
    pictures = (drive.frame(number).image[0] for number in range(len(drive)))
    images = [(255 * each.permute(1, 2, 0)).round().byte().contiguous().numpy() for each in pictures]
    with tempfile.TemporaryDirectory() as folder, MjpegServer(images, options.fps) as server:
        drive.camera.to_file(f"{folder}/camera.yaml")
        camera = f"{folder}/camera.yaml"
        command = [sys.executable, "-m", "lanebev", "run", server.address, "--camera", camera]
        with subprocess.Popen([*command, "--out", f"{folder}/out"], stdout=subprocess.PIPE, text=True) as run:
            memory = _watch(run, 60 * options.minutes)
            run.send_signal(signal.SIGINT)
            said = run.communicate()[0]
        sent = server.sent
    found = re.search(r"(\d+) frames used, (\d+) dropped, at most ([\d.]+) s", said)
    if run.returncode or found is None:
        print(said)
        return 1
    used, dropped, delay = int(found[1]), int(found[2]), float(found[3])
    rate, growth = used / (60 * options.minutes), memory[-1] / memory[0]
    print(f"{options.minutes:g} minutes at {options.fps:g} fps on {os.cpu_count()} cores")
    print(f"frames: {sent} sent, {used} used ({rate:.1f} a second), {dropped} dropped")
    print(f"delay from arrival to result: at most {delay:.2f} s")
    print(f"resident memory: {memory[0]:.0f} MiB after the warm-up, {memory[-1]:.0f} MiB at the end")
    return int(delay > _MOST_DELAY or growth > _MOST_GROWTH)


def _watch(run: subprocess.Popen[str], seconds: float) -> list[float]:
    """Return the resident memory (MiB) after the warm-up and every second from then on."""
    begin, memory = time.monotonic(), []
    warm_up = min(_WARM_UP, seconds / 2)
    while (passed := time.monotonic() - begin) < seconds and run.poll() is None:
        time.sleep(min(1.0, seconds - passed))
        if time.monotonic() - begin >= warm_up and run.poll() is None:
            memory.append(resident_mib(run.pid))
    return memory or [0.0]


if __name__ == "__main__":
    sys.exit(main())
