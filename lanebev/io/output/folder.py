"""The output folder of a run: written completely or not at all, by one run at a time."""

from __future__ import annotations

import errno
import os
import shutil
import signal
from collections.abc import Iterable
from itertools import count
from pathlib import Path

from lanebev.io.formats.names import FORMATS
from lanebev.io.output.lock import LOCK_NAME, FolderLock
from lanebev.signals import handlers_kept

_OF_RUNS = ("extrinsics.csv", "state.safetensors")  # one of them is in a folder of a run
_OWN_NAMES = (
    *_OF_RUNS, "filtered.csv", "lanes.json", "bev.mp4", "bev.png", "overlay.mp4", "overlay.png",
    "report.html", "calibration.yaml", "covariance.csv",
)  # fmt: skip
OUTPUT_NAMES = (*_OWN_NAMES, *(known.file for known in FORMATS.values()))

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # errors of a disk without room


def check_inputs_stay(folder: str | Path, inputs: Iterable[str | Path]) -> None:
    """Raise if an output of the run would replace a file that it reads.

    Args:
        folder: output folder.
        inputs: files that the run reads, its state to resume with left out: that one is meant to be renewed.
    """
    outputs = {os.path.join(os.path.realpath(folder), name) for name in OUTPUT_NAMES}
    for path in map(Path, inputs):
        # Path.resolve raises RuntimeError where a link leads to itself
        if {os.path.realpath(path), os.path.join(os.path.realpath(path.parent), path.name)} & outputs:
            raise ValueError(
                f"input {path}: expected a file that the run does not replace, got one of the outputs in "
                f"{folder}; give another folder with --out"
            )


def check_new_or_of_run(folder: str | Path) -> None:
    """Raise if a folder has files with names of outputs, which a run replaces or removes, but is no run's."""
    found = next((name for name in OUTPUT_NAMES if os.path.lexists(Path(folder) / name)), None)
    if found is not None and found not in _OF_RUNS:
        raise ValueError(
            f"output folder {folder}: expected a new one or an earlier run's, got one with a file {found} "
            f"and no {_OF_RUNS[0]}; give another with --out, or move that file"
        )


def check_result(path: str | Path, runs: Iterable[str | Path], inputs: Iterable[str | Path] = ()) -> None:
    """Raise if the file that a command writes would replace one that it reads.

    Args:
        path: path of the file.
        runs: output folders of runs, whose own outputs stay; those in other formats are meant to be renewed.
        inputs: other files that it reads.
    """
    kept = {Path(os.path.realpath(run)) / name for run in runs for name in _OWN_NAMES}
    kept |= {Path(os.path.realpath(each)) for each in inputs}
    if Path(os.path.realpath(path)) in kept:
        raise ValueError(
            f"out {path}: expected a file that the command does not read, got one of its inputs; give "
            "another with --out"
        )


class OutputFolderError(ValueError):
    """The output folder cannot be used: no space, no permission, or another run writes into it."""


class OutputFolder:
    """A folder whose files appear all together when the work is done, or not at all.

    Files are written into a hidden temporary folder in it, or beside it if it is new, so on the same disk.
    On success they are moved into place, and outputs of an earlier run that this one did not write are
    removed; files of other names in an existing folder stay. On any error the folder is unchanged. Only one
    process at a time has the temporary folder. A killed process leaves it behind, for the next one to reuse
    or replace. Hidden files in it serve that purpose and are no outputs.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._target = Path(os.path.realpath(folder))  # of a link, its target

    def __enter__(self) -> OutputFolder:
        """Make the temporary folder.

        Raises:
            OutputFolderError: the folder cannot be made or written, a folder is where an output goes, or
                another process is writing into it.
        """
        target = self._target
        self._made = [parent for parent in target.parents if not parent.exists()]
        try:
            if os.path.lexists(target) and not target.is_dir():
                raise NotADirectoryError(0, "a file of that name is there")
            for path in map(target.joinpath, OUTPUT_NAMES):
                if path.is_dir() and not path.is_symlink():
                    raise IsADirectoryError(0, f"a folder {path.name} in it, where a file goes")
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.is_dir() and not os.access(target, os.W_OK | os.X_OK):
                raise PermissionError(0, "no permission to write in it")
            beside = target if target.is_dir() else target.parent
            self._partial = beside / f".{target.name}.partial"
            self._lock = FolderLock(self._partial)
            if not self._lock.acquire():
                raise BlockingIOError(0, "another run writes into it now")
            for path in self._partial.iterdir():
                if not path.name.startswith("."):
                    path.replace(self.left(path.name))
        except OSError as error:
            self._remove_parents()
            raise OutputFolderError(
                f"output folder {self.folder}: expected one that can be written, got: {error.strerror}; "
                "give another with --out"
            ) from error
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        is_there, failure = self._partial.is_dir(), error
        try:
            if error is None:
                # a signal would leave some outputs of this run beside others of an earlier one
                with handlers_kept() as handlers:
                    for number in handlers:
                        signal.signal(number, signal.SIG_IGN)
                    self._publish()
        except OSError as unpublished:
            failure = unpublished
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)
            self._lock.release()
            if failure is not None:
                self._remove_parents()
        if isinstance(failure, OSError) and (words := self._words(failure, is_there, error is None)):
            raise OutputFolderError(f"output folder {self.folder}: {words}") from failure

    def _words(self, failure: OSError, is_there: bool, is_ours: bool) -> str:
        """Return what was expected of the folder and what was got; empty of an error elsewhere.

        Args:
            failure: what failed.
            is_there: whether the temporary folder was there at the end.
            is_ours: whether the outputs were moved into place then.
        """
        reason = failure.strerror
        if failure.errno in _FULL:
            return f"expected room for the outputs, got: {reason}; make room or give another with --out"
        if isinstance(failure, FileNotFoundError) and not is_there:
            return "expected it to stay until the outputs are written, got: deleted meanwhile; begin again"
        return f"expected one that can be written, got: {reason}; give another with --out" if is_ours else ""

    def __truediv__(self, name: str) -> Path:
        """Return where to write the file of this name until the work is done."""
        return self._partial / name

    def left(self, name: str) -> Path:
        """Return the path that a file of this name has after its process was killed."""
        return self._partial / f".{name}.left"

    def keep(self, name: str, why: str) -> str:
        """Copy an earlier run's file to ``name.why``, numbered if that exists, and return the new name."""
        names = (f"{name}.{why}{number or ''}" for number in count())
        kept = next(free for free in names if not os.path.lexists(self._target / free))
        shutil.copy2(self._target / name, self / kept)
        return kept

    def _publish(self) -> None:
        for path in self._partial.iterdir():
            if path.name.startswith(".") and path.name != LOCK_NAME:
                path.unlink()
        if not self._target.exists():
            self._partial.chmod(0o777 & ~_umask())  # it is for the owner alone
            self._partial.rename(self._target)
            (self._target / LOCK_NAME).unlink()
            return
        written = {path.name for path in self._partial.iterdir()} - {LOCK_NAME}
        for name in written:
            (self._partial / name).replace(self._target / name)
        for name in set(OUTPUT_NAMES) - written:
            (self._target / name).unlink(missing_ok=True)

    def _remove_parents(self) -> None:
        for parent in self._made:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
