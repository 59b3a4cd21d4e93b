"""Replay every kind of drive and compare with the committed references, as openpilot's process replay does.

    python -m tools.replay [KIND…]          how the estimators do on each drive, and what differs
    python -m tools.replay --write [KIND…]  likewise, and write what differs as the new references

Say in the commit why they moved. Exit status 1 where something differs and nothing is written.
"""

import sys
from collections.abc import Mapping, Sequence

import torch

from tools.replay.check import (
    REFERENCES,
    TOLERANCE,
    Key,
    calibrators,
    differences,
    drive_kinds,
    recordings,
    reference_path,
    reference_paths,
    replay_all,
)
from tools.replay.figures import after_shock, as_track, drive_figures, markdown
from tools.replay.references import Difference, Row, write_rows
from train.commands import command_parser, one_line_errors


@one_line_errors()
def main(arguments: list[str] | None = None) -> int:
    parser = command_parser(__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help="kinds to replay (default: all)")
    parser.add_argument("--write", action="store_true", help="write the references that differ")
    args = parser.parse_args(arguments)
    kinds = drive_kinds()
    unknown = sorted(set(args.kinds) - set(kinds.values()))
    if unknown:
        known = ", ".join(dict.fromkeys(kinds.values()))
        raise ValueError(f"kind: expected some of {known}, got {', '.join(unknown)}")
    torch.set_num_threads(1)
    drives = recordings([name for name, kind in kinds.items() if not args.kinds or kind in args.kinds])
    rows, replayed = replay_all(drives, calibrators())
    print(
        markdown(
            [
                (name, label, drive_figures(recording, made, row))
                for row, (name, recording) in enumerate(drives.items())
                for label, made in replayed.items()
            ]
        )
    )
    for row, (name, recording) in enumerate(drives.items()):
        if not recording.moments and recording.hard.any():
            run = as_track(recording, replayed["joint"], row)
            errors = " ".join(f"{value:.2f}" for value in after_shock(run, 1 / float(recording.dt[0])))
            print(f"\n{name}, joint, half a second after: {errors} (RMSE of half a second, °, cm)")
    found = differences(rows)
    moved = {key: difference for key, difference in found.items() if not difference.within(TOLERANCE)}
    print(f"\n{len(found) - len(moved)} of {len(found)} are as their references say, to {TOLERANCE:g} σ")
    for key, difference in moved.items():
        print(f"{' '.join(key)}: {difference}")
    if args.write:
        write(rows, moved)
        return 0
    return int(bool(moved))


def write(rows: Mapping[Key, Sequence[Row]], moved: Mapping[Key, Difference]) -> None:
    """Write the references that moved, and remove those that no drive has."""
    REFERENCES.mkdir(parents=True, exist_ok=True)
    for key in moved:
        write_rows(reference_path(key), rows[key])
        print(f"wrote {reference_path(key).name}")
    for path in sorted(set(REFERENCES.iterdir()) - reference_paths()):
        path.unlink()
        print(f"removed {path.name}, which is no drive's")


if __name__ == "__main__":
    sys.exit(main())
