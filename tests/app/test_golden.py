"""The shipped network sees and a run writes what tests/golden holds; tools.write_golden writes it anew."""

import csv
from pathlib import Path

import numpy as np

from tools.write_golden import LEAST_WEIGHT, run_on_lanes, seen_segments

GOLDEN = Path(__file__).parents[1] / "golden"


def _rows(path):
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_network_sees_the_same_segments():
    expected = np.array([[float(value) for value in row.values()] for row in _rows(GOLDEN / "segments.csv")])
    found = {row[0]: row for row in seen_segments(GOLDEN / "frame.png")}
    sure = expected[expected[:, 6] > LEAST_WEIGHT + 0.05]
    assert len(sure) > 20
    again = np.array([found[index] for index in sure[:, 0]])
    np.testing.assert_array_equal(again[:, 1], sure[:, 1])
    np.testing.assert_allclose(again[:, 2:6], sure[:, 2:6], atol=0.1)  # px
    np.testing.assert_allclose(again[:, 6:], sure[:, 6:], atol=0.02)
    new = [row for index, row in found.items() if index not in expected[:, 0]]
    assert all(row[6] < LEAST_WEIGHT + 0.05 for row in new)


def test_a_run_writes_the_same_extrinsics(tmp_path):
    expected = _rows(GOLDEN / "extrinsics.csv")
    found = _rows(run_on_lanes(GOLDEN / "lanes.json", tmp_path / "extrinsics.csv"))
    assert len(found) == len(expected) == 10
    for row, before in zip(found, expected, strict=True):
        for name, value in before.items():
            if name in ("status", "segments", "frame", "time_s", "image", "reasons"):
                assert row[name] == value
            else:
                close = 1e-6 if name == "vertical_curvature_per_m" else 1e-4
                np.testing.assert_allclose(float(row[name]), float(value), atol=close, err_msg=name)
