"""What is kept of every frame: the same rows and numbers back, in little memory."""

import numpy as np
import pytest

from lanebev.app.recording.storage import StoredNumbers, StoredRows
from lanebev.io.results import ExtrinsicsRow


def _row(number):
    numbers = np.random.default_rng(number).normal(size=9).tolist()
    image = f"images/{number}.png" if number % 2 else ""
    return ExtrinsicsRow(
        number + 10,
        *numbers,
        "TRACKING" if number else "LOST",
        number,
        image,
        "A|B"[:number],
        1e-5 * number if number % 3 else None,
    )


def test_rows_come_back_as_they_were():
    rows = [_row(number) for number in range(6)]
    kept = StoredRows(rows)
    assert list(kept) == rows
    assert kept[-1] == rows[-1]
    assert list(kept[1:4]) == rows[1:4]
    assert list(kept[::-2]) == rows[::-2]
    assert len(kept) == 6
    with pytest.raises(IndexError):
        kept[6]


def test_a_row_takes_little():
    kept, image = StoredRows(), "images/5.png"
    for number in range(2000):
        kept.append(_row(5)._replace(frame=number, image=image, reasons="|".join("AB")))
    assert kept._numbers.itemsize * len(kept._numbers) == 2000 * 12 * 8
    assert len(kept._texts) == 3 * 2000
    assert len(set(map(id, kept._texts))) == 3


@pytest.mark.parametrize("on_disk", [False, True])
def test_numbers_come_back_as_they_were(tmp_path, on_disk):
    folder = tmp_path if on_disk else None
    values = np.random.default_rng(0).normal(size=(5, 2, 3))
    values[1, 0, 2] = np.nan
    kept = StoredNumbers(2, 3, folder=folder)
    for value in values:
        kept.append(value)
    np.testing.assert_array_equal(kept.all(), values)
    assert StoredNumbers(4, 4, folder=folder).all().shape == (0, 4, 4)
    with pytest.raises(ValueError, match=r"expected shape \(4, 4\), got \(2, 3\)"):
        StoredNumbers(4, 4).append(values[0])
    assert list(tmp_path.iterdir()) == []  # the file has no name, and ends with its process
