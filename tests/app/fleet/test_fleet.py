"""A fleet on Ray: a killed worker, a corrupt file, a second call; the same as single runs."""

import json

import pytest

from tools import fleet_check

pytest.importorskip("ray", reason="Ray is not installed")
parquet = pytest.importorskip("pyarrow.dataset", reason="pyarrow is not installed")


@pytest.mark.slow
def test_a_fleet_equals_single_runs(tmp_path, capsys):
    arguments = [
        "--drives",
        "3",
        "--network",
        "3",
        "--frames",
        "4",
        "--workers",
        "2",
        "--kills",
        "1",
        "--batch",
        "2",
    ]
    assert fleet_check.main([*arguments, "--no-timing", "--folder", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["finished"], found["failed"], found["equal"], found["killed"]) == (2, 1, 2, 1)
    assert found["second_call"] == "3 drives: 2 finished, 1 failed; 0 run now"
    frames = parquet.dataset(tmp_path / "fleet" / "frames", partitioning="hive").to_table().to_pylist()
    assert {(row["drive"], row["camera"], str(row["day"])) for row in frames} == {
        ("drive-00-drive", "camera-0", "2026-03-01"),
        ("drive-02-drive", "camera-2", "2026-03-03"),
    }
    assert len(frames) == 8
    page = (tmp_path / "fleet" / "index.html").read_text()
    assert "drive-01-drive</b>: video" in page
    assert 'href="drives/drive-00-drive/report.html"' in page
    assert (tmp_path / "fleet" / "drives" / "drive-00-drive" / "report.html").is_file()
