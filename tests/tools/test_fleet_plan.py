"""The plan for many hours of video, by hand."""

import pytest

from tools.fleet_plan import FrameCost, plan

COST = FrameCost(
    look=0.09, rest=0.01, videos=0.02, report=2_000_000,
    sizes={"lanes.json": 9000.0, "frames.parquet": 200.0, "bev.mp4": 800.0},
)  # fmt: skip


def test_a_plan_by_hand():
    found = plan(COST, hours=100_000, fps=10.0, cores=1000, minutes=10)
    assert found == pytest.approx(
        {
            "frames": 3.6e9,
            "core_hours": 1e5,
            "core_hours_network": 9e4,
            "core_hours_videos": 2e4,
            "days": 100 / 24,
            "terabytes": 33.12,
            "terabytes_parquet": 0.72,
            "terabytes_videos": 2.88,
            "terabytes_reports": 1.2,
            "minutes_last_run_of_an_hour": 6.0,
        }
    )
