"""The benchmark of a whole run, on a small video."""

import json
import sys

import pytest

from tools import bench_run


@pytest.mark.slow
def test_a_runs_time_is_told_beside_the_networks(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(bench_run, "SIZE", (96, 160))
    monkeypatch.setattr(bench_run, "RENDERED", 2)
    out = tmp_path / "figures.json"
    monkeypatch.setattr(sys, "argv", ["bench_run", "--frames", "3", "--json", str(out)])
    bench_run.main()
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert printed == json.loads(out.read_text())
    assert printed["frames"] == 3
    assert printed["ratio"] == pytest.approx(printed["run_ms"] / printed["forward_ms"], abs=0.02)
