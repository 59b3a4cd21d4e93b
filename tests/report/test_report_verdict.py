"""The verdict in words, from made-up rows."""

import numpy as np
import pytest

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import AxisState, axis_states
from lanebev.report.verdict import describe, intervals, percent, reason_words, verdict

ROW = ExtrinsicsRow(0, 0.0, 1.0, 2.0, 0.1, 1.5, 0.05, 0.08, 0.1, 0.004, "TRACKING", 12, "")
ALL_UNSEEN = "ROLL_UNSEEN|HEIGHT_UNSEEN|DIRECTION_UNSEEN"


def drive(seconds=10.0, fps=20, changes=()):
    """Rows of a drive; changes: (start, end, fields)."""
    rows = [ROW._replace(frame=i, time_s=i / fps) for i in range(round(seconds * fps))]
    for start, end, fields in changes:
        rows = [row._replace(**fields) if start - 1e-9 <= row.time_s < end - 1e-9 else row for row in rows]
    return rows


ONE_LANE = (7.2, 9.8, {"reasons": "ROLL_UNSEEN"})


def test_a_drive_without_trouble_is_calibrated():
    found = verdict(drive())
    assert found.headline == "Calibrated for 100 % of the drive."
    assert found.grade == "good"
    assert found.findings == ()
    assert (
        found.precision == "Typical uncertainty (2σ): pitch ±0.10°, yaw ±0.16°, roll ±0.20°, height ±0.8 cm."
    )


def test_a_road_of_one_lane_is_told_in_seconds():
    lost = (3.0, 3.4, {"status": "COASTING", "reasons": f"NO_SEGMENTS|{ALL_UNSEEN}"})
    found = verdict(drive(changes=[ONE_LANE, lost]))
    assert found.text == (
        "Calibrated for 96 % of the drive, all four axes determined for 70 %; "
        "pose only predicted from 3.0 to 3.4 s: no lane boundaries seen; "
        "roll not determined from 7.2 to 9.8 s: one lane only"
    )
    assert found.grade == "fair"


def test_one_boundary_leaves_all_axes_undetermined():
    found = verdict(drive(changes=[(2.0, 4.0, {"reasons": ALL_UNSEEN})]))
    (finding,) = found.findings
    assert describe(finding) == (
        "pitch, yaw, roll and height not determined from 2.0 to 4.0 s: one boundary only"
    )
    assert (finding.first, finding.last) == (40, 79)


def test_a_large_sigma_is_uncertain():
    found = verdict(drive(changes=[(0.0, 1.0, {"yaw_std_deg": 0.7, "height_std_m": 0.2})]))
    assert [describe(finding) for finding in found.findings] == [
        "yaw and height uncertain from 0.0 to 1.0 s: σ above 0.57°, σ above 10.0 cm",
    ]


def test_the_most_severe_comes_first():
    changes = [
        (0.0, 1.0, {"status": "UNINITIALISED", "reasons": f"NO_START|FEW_INLIERS|{ALL_UNSEEN}"}),
        (4.0, 5.0, {"status": "COASTING", "reasons": "FEW_INLIERS"}),
        (5.0, 7.0, {"status": "LOST", "reasons": "FEW_INLIERS"}),
        ONE_LANE,
    ]
    found = verdict(drive(changes=changes))
    assert [finding.what for finding in found.findings] == [
        "pose lost",
        "pose only predicted",
        "not yet calibrated",
        "not determined",
    ]
    assert found.findings[2].why == "no frame yet to start from, what was seen does not fit the road"


def test_missing_frames_are_told():
    rows = [row for row in drive() if not 4.0 <= row.time_s < 6.5]
    assert describe(verdict(rows).findings[0]) == "no frames from 4.0 to 6.5 s"


def test_flicker_is_one_interval_and_single_frames_are_left_out():
    rows = drive()
    for i in (*range(100, 140, 2), 180):
        rows[i] = rows[i]._replace(reasons="ROLL_UNSEEN")
    (finding,) = verdict(rows).findings
    assert (finding.start, round(finding.end, 2)) == (5.0, 6.95)


def test_many_findings_are_counted():
    changes = [(i, i + 0.3, {"status": "LOST"}) for i in np.arange(1, 20, 1.0)]
    found = verdict(drive(20.0, changes=changes))
    assert (len(found.findings), found.omitted) == (8, 11)
    assert found.text.endswith("; and 11 more")


def test_nothing_calibrated_says_why():
    assert verdict([]).headline == "Not calibrated: there was no frame."
    rows = drive(changes=[(0, 10, {"status": "UNINITIALISED", "reasons": "NO_SEGMENTS|NO_START"})])
    assert verdict(rows).headline == ("Not calibrated: no lane boundaries seen, no frame yet to start from.")
    assert verdict(rows).grade == "poor"
    assert verdict(drive(changes=[(0, 10, {"status": "UNINITIALISED"})])).headline.endswith(
        "no usable frame."
    )


def test_images_on_their_own_are_counted():
    rows = drive(0.5, changes=[(0.1, 0.2, {"reasons": "ROLL_UNSEEN"}), (0.3, 0.35, {"status": "LOST"})])
    found = verdict(rows, stills=True)
    assert found.text == (
        "9 of 10 images calibrated, all four axes determined in 7; no calibration in 1 image; "
        "roll not determined in 2 images: one lane only"
    )


@pytest.mark.parametrize("status", ["TRACKING", "COASTING", "LOST", "UNINITIALISED", "SOMETHING_NEW"])
def test_every_row_has_a_state_on_each_axis(status):
    states = axis_states(ROW._replace(status=status, reasons="ROLL_UNSEEN", height_std_m=0.3))
    expected = {
        "TRACKING": (AxisState.MEASURED, AxisState.MEASURED, AxisState.UNDETERMINED, AxisState.UNCERTAIN),
        "COASTING": (AxisState.UNDETERMINED,) * 4,
        "LOST": (AxisState.LOST,) * 4,
    }
    assert states == expected.get(status, (AxisState.UNKNOWN,) * 4)


def test_a_sigma_that_is_no_number_is_uncertain():
    assert axis_states(ROW._replace(yaw_std_deg=float("nan")))[1] == AxisState.UNCERTAIN


def test_intervals():
    times = np.arange(10.0)
    at = np.array([1, 1, 0, 1, 0, 0, 0, 1, 1, 1], dtype=bool)
    assert list(intervals(at, times, joined=0.5)) == [(0, 1), (3, 3), (7, 9)]
    assert list(intervals(at, times, joined=2.0)) == [(0, 3), (7, 9)]
    assert list(intervals(at, times, joined=0.5, shortest=2.5)) == [(7, 9)]
    assert list(intervals(np.zeros(10, bool), times)) == []


def test_percent_rounds_neither_to_nothing_nor_to_all():
    assert [percent(share) for share in (0.0, 0.001, 0.956, 0.9999, 1.0)] == [
        "0 %", "1 %", "96 %", "99 %", "100 %",
    ]  # fmt: skip


def test_reasons_in_words():
    assert reason_words(["ROLL_UNSEEN", "HEIGHT_UNSEEN", "LANE_CHANGE"]) == [
        "no lane with both its boundaries",
        "lane change",
    ]
    assert reason_words(["NO_SEGMENTS", *ALL_UNSEEN.split("|")]) == ["no lane boundaries seen"]
    assert reason_words(["SOMETHING_NEW"]) == ["something new"]
