"""The speed table, on small sizes: every alternative runs, and ratios are to the first."""

import json
import time

import pytest

from tools.bench_speed import measuring, parts, scene, views


@pytest.mark.slow
def test_tables_and_growth_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(scene, "SIZE", (60, 120))
    monkeypatch.setattr(scene, "GRID", scene.BEVGrid(resolution=2.0))
    parts.run(["warp", "frame", "cells"], 0.01, 10_000, tmp_path, time.perf_counter)
    report = json.loads((tmp_path / "bench_speed.json").read_text())
    assert set(report["results"]) >= {"one image", "8 images", "a frame of bytes", "cells of the view"}
    table = report["results"]["one image"]
    assert table["grid_sample"]["ratio"] == 1
    assert all(entry["low"] <= entry["ms"] <= entry["high"] for entry in table.values())
    assert list(report["results"]["cells of the view"]) == ["10000"]
    assert (tmp_path / "cells.svg").stat().st_size > 1000
    text = (tmp_path / "bench_speed.md").read_text()
    assert "| BEVWarp |" in text
    assert "of 15 targets met" in text
    assert set(table["BEVWarp"]) == {"ratio", "ms", "low", "high", "met"}


def test_alternatives_give_the_same(monkeypatch):
    """The peers sample what the warp samples; edges differ."""
    monkeypatch.setattr(scene, "GRID", scene.BEVGrid(resolution=0.5))
    calls = views.warps(1, 3, 1)
    grid, kornia, warp = (calls[name]() for name in ("grid_sample", "kornia warp_perspective", "BEVWarp"))
    seen = warp[1].expand_as(warp[0])
    for other in (grid, kornia):
        assert (other - warp[0])[seen].abs().median() < 1e-4


def test_sizes_grow_until_a_call_takes_too_long(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "cells", lambda resolution: {"sleep": lambda: time.sleep(0.05)})
    report = parts.run(["cells"], 0.01, 10_000_000, tmp_path, time.perf_counter, longest=0.02)
    assert list(report["results"]["cells of the view"]) == ["10000"]


def test_targets_are_met_or_missed_to_two_decimals():
    entry = {"ms": 3.0, "low": 3.0, "high": 3.0}
    table = measuring.judged(
        {
            "grid_sample": {"ratio": 1.0, **entry},
            "BEVWarp": {"ratio": 1.204, **entry},
            "BEVWarp, fisheye": {"ratio": 1.306, **entry},
            "LineExtractor": {"ratio": 25.0, **entry},
        }
    )
    assert [each.get("met") for each in table.values()] == [None, True, False, True]
    text = measuring.shown("one image", table)
    assert "met: ratio at most 1.2 |" in text
    assert "missed: ratio at most 1.3 |" in text
    assert "met: ms at most 4 |" in text
    text = measuring.overview(
        {"one image": table, "another": {"remap_frame": {"ratio": 1.1, "met": True, **entry}}}
    )
    assert "| one image | 1.00 | 1.20 | **1.31** | 25.00 |  |" in text
    assert "3 of 4 targets met" in text
