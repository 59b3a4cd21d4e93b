"""Lightning trains through the whole of LaneBEV in two processes."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch


@pytest.mark.slow
def test_two_processes_learn_the_same_weights(tmp_path):
    script = Path(__file__).with_name("two_processes.py")
    ended = subprocess.run(
        [sys.executable, script, tmp_path], capture_output=True, text=True, timeout=280, check=False
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert torch.equal(first["after"], second["after"])
    assert first["after"].isfinite().all()
    assert (first["after"] - first["before"]).abs().max() > 1e-6
