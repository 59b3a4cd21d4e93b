"""One row per frame with everything that is known of it: the columns of Parquet and JSON lines."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from lanebev.io.formats.record import RunRecord


def frame_fields(record: RunRecord) -> Iterator[dict[str, Any]]:
    """Return a frame's fields after another's: those of ``extrinsics.csv``, and its covariance.

    ``reasons`` is a list of names. ``covariance`` is 4 x 4 of pitch, yaw, roll (rad) and height (m), or None
    where not all of it is known.
    """
    for row, covariance in zip(record.rows, record.covariances, strict=True):
        known = not np.isnan(covariance).any()
        image = row.image.encode("utf-8", "replace").decode()  # names of files may be no text
        yield {
            **row._asdict(),
            "image": image,
            "reasons": [name for name in row.reasons.split("|") if name],
            "covariance": covariance.tolist() if known else None,
        }
