"""tools.stream_check: its bounds, and a stream of some seconds looked at for real."""

import json
from dataclasses import replace

import pytest

from tools.stream_check import StreamFigures, main

GOOD = StreamFigures(
    seconds=60.0, fps=30.0, sent=1830, used=300, dropped=1520, rows=300, wait=0.03, delay=0.4,
    memory=(500.0, 505.0, 510.0),
)  # fmt: skip


def test_what_is_within_bounds_passes():
    assert GOOD.problems() == []
    assert GOOD.underway == pytest.approx(1 / 3)
    assert GOOD.growth == pytest.approx(1.02)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"delay": 2.35}, "delay from arrival to result: expected 2 s at most, got 2.35"),
        ({"wait": 0.6}, "wait from arrival to use: expected 0.5 s at most, got 0.60"),
        ({"dropped": 1400}, "frames underway: expected 1 s at most, got 4.33"),
        ({"memory": (500.0, 560.0)}, "memory at the end over that after the warm-up: expected 1.1 at most"),
        ({"rows": 299}, "rows: expected one a frame of the 300 used, got 299"),
        ({"delay": float("nan")}, "delay"),
    ],
)
def test_what_is_out_of_bounds_is_said(change, words):
    (problem,) = replace(GOOD, **change).problems()
    assert problem.startswith(words)


@pytest.mark.slow
def test_some_seconds_of_a_stream(capsys):
    status = main(["--minutes", "0.05", "--size", "160x96"])
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert figures["rows"] == figures["used"] >= 2
    assert figures["dropped"] > 0
    assert status == bool(figures["problems"])
