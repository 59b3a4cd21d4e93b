"""Processes that a run on a GPU starts: a training, and a measurement beside it."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import IO, Any

import torch


class Training:
    """A training process and its checkpoints.

    Args:
        config: config of ``python -m train fit``.
        folder: folder of the run.
        log: file of what it says; that is printed too.
        options: further ones of the command line.
    """

    def __init__(self, config: Path, folder: Path, log: Path, options: Sequence[str]) -> None:
        self.config, self.folder, self.log, self.options = config, folder, log, list(options)
        self.batch_share = 1.0
        self._process: subprocess.Popen[str] | None = None
        self._echo: threading.Thread | None = None
        self._tail = ""

    def start(self, seconds: float) -> None:
        """Begin, or go on from the newest checkpoint, for so long in all."""
        duration = timedelta(seconds=max(1, round(seconds)))
        clock = f"{duration.days:02d}:" + str(duration - timedelta(days=duration.days)).zfill(8)
        command = [sys.executable, "-u", "-m", "train", "fit", "--config", str(self.config)]
        command += [f"--trainer.max_time={clock}", f"--trainer.default_root_dir={self.folder}"]
        command += [f"--trainer.logger.init_args.save_dir={self.folder}"]
        command += [f"--data.init_args.batch_share={self.batch_share}", *self.options]
        if (newest := self.checkpoint()) is not None:
            command.append(f"--ckpt_path={newest}")
        self._tail = ""
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert self._process.stdout is not None
        self._echo = threading.Thread(target=self._listen, args=(self._process.stdout,), daemon=True)
        self._echo.start()

    def _listen(self, pipe: IO[str]) -> None:
        with self.log.open("a") as log:
            for line in pipe:
                print(line, end="", flush=True)
                log.write(line)
                self._tail = (self._tail + line)[-4000:]

    def ended(self) -> int | None:
        """Return the exit status, or None while it runs."""
        assert self._process is not None
        status = self._process.poll()
        if status is not None and self._echo is not None:
            self._echo.join(5)
        return status

    def stop(self) -> None:
        """End it."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait(10)

    def out_of_memory(self) -> bool:
        """Return whether the last words were of memory."""
        return "out of memory" in self._tail.lower() or "OutOfMemoryError" in self._tail

    def checkpoint(self) -> Path | None:
        """Return the newest checkpoint."""
        found = [path for path in self.folder.rglob("*.ckpt") if path.is_file()]
        return max(found, key=lambda path: path.stat().st_mtime, default=None)

    def trained(self) -> float:
        """Return the seconds of training that the newest checkpoint has had."""
        newest = self.checkpoint()
        if newest is None:
            return 0.0
        timer = torch.load(newest, map_location="cpu", weights_only=True)["callbacks"].get("Timer", {})
        return float(timer.get("time_elapsed", {}).get("train", 0.0))


class Measurement:
    """A command that runs beside the training and prints lines of JSON."""

    def __init__(self, *command: str) -> None:
        self._name = command[0]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,  # so that its own processes end with it
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, 10)  # the training goes first

    def result(self, seconds: float) -> list[dict[str, Any]]:
        """Return what it printed, after so long at most."""
        complaint = ""
        try:
            said, complaint = self._process.communicate(timeout=max(0.1, seconds))
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            said, _ = self._process.communicate()
            complaint = "took too long"
        if self._process.returncode:
            print(f"gpu_run: {self._name}: {complaint[-1500:]}", flush=True)
        lines = [line for line in said.splitlines() if line.startswith("{") and line.endswith("}")]
        return [json.loads(line) for line in lines]
