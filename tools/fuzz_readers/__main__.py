"""Give every reader mutated files: each result must be a value or one ValueError of one line, soon.

    python -m tools.fuzz_readers [--count 20000] [--seed 0] [--readers camera.yaml …] [--keep DIR]

Inputs are valid files of each kind with bytes, numbers, lines and pieces changed, moved, left out or taken
from another kind. A traceback, a message of several lines and an input that takes longer than ``--limit``
seconds are faults: each kind is printed once, and kept with ``--keep``. Exit status 1 if there is any.
"""

import random
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tools.fuzz_readers.mutations import mutated
from tools.fuzz_readers.readers import Reader, readers
from train.commands import command_parser

LONGEST_MESSAGE = 500


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError(f"more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def fault(reader: Reader, data: bytes, folder: Path, limit: float = 10.0) -> str:
    """Read an input; return what is wrong with how that ended, empty if nothing is."""
    path = folder / f"input{reader.suffix}"
    path.write_bytes(data)
    try:
        with warnings.catch_warnings(), _time_limit(limit):
            warnings.simplefilter("error", RuntimeWarning)  # of numbers that overflow
            reader.read(path)
    except ValueError as error:
        text = str(error)
        if isinstance(error, UnicodeError):
            return "a UnicodeError, no ValueError of our own"
        if not text or len(text.splitlines()) > 1 or "\n" in text:
            return f"a message of {len(text.splitlines())} lines: {text[:200]!r}"
        if len(text) > LONGEST_MESSAGE + len(str(path)):
            return f"a message of {len(text)} characters: {text[:200]}…"
        return ""
    except Exception as error:
        where = [line for line in traceback.extract_tb(error.__traceback__) if "lanebev" in line.filename]
        place = f"{Path(where[-1].filename).name}:{where[-1].lineno}" if where else "?"
        return f"{type(error).__name__} at {place}: {' '.join(str(error).split())[:200]}"
    return ""


def main() -> int:
    """Read mutated files and print each kind of fault once."""
    known = readers()
    parser = command_parser(__doc__)
    parser.add_argument("--count", type=int, default=20_000, help="number of inputs (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=10.0, help="time limit per input, s (%(default)s)")
    parser.add_argument(
        "--readers", nargs="+", choices=known, default=list(known), metavar="NAME", help=", ".join(known)
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder in which failing inputs are kept")
    args = parser.parse_args()
    everything = [seed for reader in known.values() for seed in reader.seeds]
    total = sum(known[name].share for name in args.readers)
    faults: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name in args.readers:
            reader, draw, slowest = known[name], random.Random(f"{args.seed} {name}"), 0.0
            count = round(args.count * reader.share / total)
            for _ in range(count):
                data = mutated(draw.choice(reader.seeds), everything, draw)
                begin = time.perf_counter()
                found = fault(reader, data, Path(folder), args.limit)
                slowest = max(slowest, time.perf_counter() - begin)
                if not found:
                    continue
                kind = f"{name}: {found}"
                faults[kind] += 1
                if faults[kind] == 1:
                    print(kind, flush=True)
                    if args.keep:
                        args.keep.mkdir(parents=True, exist_ok=True)
                        (args.keep / f"{len(faults) - 1}-{name}{reader.suffix}").write_bytes(data)
            print(f"{name}: {count} inputs, the slowest took {slowest:.2f} s", flush=True)
    print(f"{args.count} inputs, {sum(faults.values())} faults of {len(faults)} kinds")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
