"""Training through the whole of LaneBEV in two processes: by Lightning, and sharded."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch


def run(script, folder):
    command = [sys.executable, Path(__file__).with_name(script), folder]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]


@pytest.mark.slow
def test_two_shards_under_autocast_learn_what_a_whole_network_learns(tmp_path):
    run("two_shards.py", tmp_path)


@pytest.mark.slow
def test_two_processes_learn_the_same_weights(tmp_path):
    run("two_processes.py", tmp_path)
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert torch.equal(first["after"], second["after"])
    assert first["after"].isfinite().all()
    assert (first["after"] - first["before"]).abs().max() > 1e-6
