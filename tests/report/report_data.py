"""A made-up drive for the tests of the report: one lane only, a gap, lost, a knock."""

import math

import numpy as np
import torch

from lanebev import Camera
from lanebev.estimation.mount import MountEstimator
from lanebev.io.results import ExtrinsicsRow
from lanebev.report.page import Report
from lanebev.report.pictures import jpeg

FPS, FRAMES, KNOCK = 20, 240, 200
ALL_UNSEEN = "ROLL_UNSEEN|HEIGHT_UNSEEN|DIRECTION_UNSEEN"
CAMERA = Camera.from_parameters(1000, 1010, 639.5, 359.5, 1280, 720, [-0.31, 0.12, 0.001, -0.0007, 0.031])


def eventful_rows():
    """Roll unseen from 2 to 5 s, nothing seen from 6 to 8 s, lost from 7 s, a knock of 3° at 10 s."""
    rows = []
    for i in range(FRAMES):
        time = i / FPS
        pitch = 1.0 + 0.2 * math.sin(5 * time) + (3.0 if i >= KNOCK else 0.0)
        row = ExtrinsicsRow(
            i,
            time,
            pitch,
            -0.5,
            0.3,
            1.45 + 0.01 * math.sin(5 * time),
            0.05,
            0.08,
            0.2,
            0.005,
            "TRACKING",
            24,
            "",
        )
        if time < 0.5:
            row = row._replace(
                status="UNINITIALISED", reasons=f"NO_START|NO_SEGMENTS|{ALL_UNSEEN}", segments=0
            )
        if 2 <= time < 5:
            row = row._replace(roll_std_deg=0.2 + 0.3 * (time - 2), reasons="ROLL_UNSEEN", segments=8)
        if 6 <= time < 8:
            row = row._replace(
                status="COASTING" if time < 7 else "LOST",
                pitch_std_deg=0.05 + time - 6,
                reasons=f"NO_SEGMENTS|{ALL_UNSEEN}",
                segments=0,
            )
        if i == KNOCK:
            row = row._replace(reasons="RESTARTED")
        rows.append(row)
    return rows


def picture(number, size=(36, 64)):
    """A picture whose grey value tells the frame."""
    return np.full((*size, 3), number % 256, np.uint8)


def eventful_report(title="drive.mp4", **changes):
    """A report of the made-up drive with a picture every 20 frames."""
    rows = eventful_rows()
    after = np.full((FRAMES, 5), np.nan)
    after[:, 1:4] = 3.7 + 0.02 * np.sin(np.arange(FRAMES))[:, None]
    after[40:100, [1, 3]] = after[120:160] = np.nan
    _, mount = None, MountEstimator()
    state = mount.initial_state(1, dtype=torch.float64)
    fields = {
        "title": title,
        "rows": rows,
        "before": after * np.linspace(0.95, 1.05, FRAMES)[:, None],
        "after": after,
        "lane_width": 3.7,
        "facts": {"source": title, "lane width": "3.7 m"},
        "pictures": {
            i: {"image": jpeg(picture(i)), "after": jpeg(picture(i, (72, 24)))} for i in range(0, FRAMES, 20)
        },
        "problems": ["frame 130: cannot be decoded"],
        "camera": CAMERA,
        "mount": mount(_tracked(), state, 0.05)[0],
    }
    return Report(**(fields | changes))


def _tracked():
    from lanebev import Calibration, Extrinsics, Status

    pose = Extrinsics.unstack(torch.tensor([[0.02, -0.01, 0.005, 1.45]], dtype=torch.float64))
    cov = 1e-6 * torch.eye(4, dtype=torch.float64)[None]
    return Calibration(pose, cov, torch.tensor([int(Status.TRACKING)]), torch.ones(1, 8))
