"""The speed table, on small sizes: every alternative runs, and ratios are to the first."""

import json
import time

import pytest

from tools import bench_speed


@pytest.mark.slow
def test_tables_and_growth_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(bench_speed, "SIZE", (60, 120))
    monkeypatch.setattr(bench_speed, "GRID", bench_speed.BEVGrid(resolution=2.0))
    bench_speed.run(["warp", "frame", "cells"], 0.01, 10_000, tmp_path, time.perf_counter)
    report = json.loads((tmp_path / "bench_speed.json").read_text())
    assert set(report["results"]) >= {"one image", "8 images", "a frame of bytes", "cells of the view"}
    table = report["results"]["one image"]
    assert table["grid_sample"]["ratio"] == 1
    assert all(entry["low"] <= entry["ms"] <= entry["high"] for entry in table.values())
    assert list(report["results"]["cells of the view"]) == ["10000"]
    assert (tmp_path / "cells.svg").stat().st_size > 1000
    assert "| BEVWarp |" in (tmp_path / "bench_speed.md").read_text()


def test_alternatives_give_the_same(monkeypatch):
    """The peers sample what the warp samples; edges differ."""
    monkeypatch.setattr(bench_speed, "GRID", bench_speed.BEVGrid(resolution=0.5))
    calls = bench_speed.warps(1, 3, 1)
    grid, kornia, warp = (calls[name]() for name in ("grid_sample", "kornia warp_perspective", "BEVWarp"))
    seen = warp[1].expand_as(warp[0])
    for other in (grid, kornia):
        assert (other - warp[0])[seen].abs().median() < 1e-4


def test_sizes_grow_until_a_call_takes_too_long(tmp_path, monkeypatch):
    monkeypatch.setattr(bench_speed, "cells", lambda resolution: {"sleep": lambda: time.sleep(0.05)})
    report = bench_speed.run(["cells"], 0.01, 10_000_000, tmp_path, time.perf_counter, longest=0.02)
    assert list(report["results"]["cells of the view"]) == ["10000"]
