"""Speeds of the vehicle from text files."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanebev.io.speeds import Speeds, read_speeds


@pytest.fixture
def read(tmp_path):
    def of(text):
        path = tmp_path / "speed.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_speeds(path)

    return of


@pytest.mark.parametrize(
    "text",
    [
        "0 10\n0.1 11\n0.2 13\n",
        "# of the CAN bus\n0,10\n\n0.1,11\n0.2,13\n",
        "time_s,speed\r\n0,10\r\n0.1,11\r\n0.2,13\r\n",
        "speed (km/h);t\n36,0;0\n39,6;0,1\n46,8;0,2\n",  # a German Excel
        "Timestamp_ms\tvehicle_speed_kph\tgear\n0\t36\t3\n100\t39.6\t3\n200\t46.8\t4\n",
        '"time","velocity [m/s]","exposure time zone"\n0,10,x\n0.1,11,x\n0.2,13,x\n'.replace(
            "exposure time", "a"
        ),
        "time_ns v\n0 10\n100000000 11\n200000000 13\n",
        "t,speed_mph\n0,22.369363\n0.1,24.606299\n0.2,29.080172\n",
        "timestampMillis,vehicleSpeedKmh\n0,36\n100,39.6\n200,46.8\n",
        "Time (usec),Speed (OBD)(km/hr)\n0,36\n100000,39.6\n200000,46.8\n",
        "t speed_kmph\n0 36\n0.1 39.6\n0.2 46.8\n",
        "t speed_km_h\n0 36\n0.1 39.6\n0.2 46.8\n",
        "t,speed_knots\n0,19.438445\n0.1,21.382289\n0.2,25.269978\n",
        "0,0 10,0\n0,1 11,0\n0,2 13,0\n",
        "\ufefftime,speed\n0,10\n0.1,11\n0.2,13\n",
        "# of NumPy\n# speed_kmh time\n36 0\n39.6 0.1\n46.8 0.2\n",
        "# vehicle speed\n0 10\n0.1 11\n0.2 13\n",
        "time,speedAccuracy,speed\n0,0.3,10\n0.1,0.3,11\n0.2,0.3,13\n",  # of a phone
        "time,speed (cm/s)\n0,1000\n0.1,1100\n0.2,1300\n",
        "time_min,speed_limit,speed,engine_speed\n0,13,10,900\n0.0016666667,13,11,900\n0.0033333333,13,13,900\n",
    ],
)
def test_times_and_speeds(read, text):
    found = read(text)
    np.testing.assert_allclose(found.times, [0.0, 0.1, 0.2], atol=1e-9)
    np.testing.assert_allclose(found.speeds, [10.0, 11.0, 13.0], rtol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "10\n11\nnan\n",
        "speed\n10\n11\nnan\n",
        "frame,speed_kmh\n0,36\n1,39.6\n2,\n",
        "datetime,speed_kmh\n2026-11-30 10:00:00,36\n2026-11-30 10:00:01,39.6\n2026-11-30 10:00:02,\n",
        "Speed [km/h]\n36\n39.6\nnan\n",
        "# speed_kmh\n36\n39.6\nnan\n",
        "# speed in km/h\n# speed_kmh\n36\n39.6\nnan\n",
        "# speed limit 50 km/h\n10\n11\nnan\n",
        "# speed limit 50 km/h\nframe,speed\n0,10\n1,11\n2,\n",
        "# speed in km/h\nspeed_kmh\n36\n39.6\nnan\n",
        "# vehicle speed log v1.0 (mm)\n10\n11\nnan\n",
        "# speed of each frame, 30 fps\n10\n11\nnan\n",
        "# speed (m/s) below 130 km/h\n10\n11\nnan\n",
        "# speed [km per hour]\n36\n39.6\nnan\n",
        "# vehicle speed in km / h\n36\n39.6\nnan\n",
        "# speed (km)\n36\n39.6\nnan\n",
        "speed (km/h)\n36,0\n39,6\nnan\n",  # a decimal comma
        "# speed\n10.0\n11.0\n-1.000000e+00\n",  # of numpy.savetxt
    ],
)
def test_a_speed_for_each_frame(read, text):
    found = read(text)
    assert found.times is None
    assert [found.at(number, 100.0) for number in range(4)] == [10.0, pytest.approx(11.0), None, None]


def test_a_speed_that_a_phone_does_not_know(read):
    np.testing.assert_array_equal(read("time,speed\n0,-1\n1,-1.00\n2,-1.2\n").speeds, [np.nan, np.nan, -1.2])


def test_a_time_a_second_before_the_first_frame(read):
    np.testing.assert_array_equal(read("time,speed\n-1,10\n0,11\n").times, [-1.0, 0.0])


def test_how_many_frames_have_no_speed_near_them():
    times = np.array([-1.5, -0.5, 0.0, 2.5, 3.5, 6.0, 6.5])
    assert Speeds(np.ones(3), np.array([0.0, 1.0, 5.0])).without(times) == 4
    assert Speeds(np.ones(1), np.array([0.0])).without(times) == 5
    assert Speeds(np.ones(7)).without(times) == 0


def test_a_speed_between_two_and_beside_them():
    """Linear between two; unknown more than a second from the nearest, and where one of two is not known."""
    found = Speeds(np.array([10.0, 12.0, 20.0, math.nan]), np.array([0.0, 1.0, 5.0, 6.0]))
    assert [found.at(0, time) for time in (-0.5, 0.25, 1.0, 1.5, 3.0, 4.5)] == [10, 10.5, 12, 13, None, 19]
    assert [found.at(0, time) for time in (-1.5, 5.5, 7.0, 8.0)] == [None] * 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a speed in each line, .* got no numbers"),
        ("time,speed\n", "expected a speed in each line, .* got no numbers"),
        ("1,2,3\n4,5,6\n", ".*or a first line of titles that names them, got '1 2 3'"),
        ("time,gear\n0,1\n", ".*or a first line of titles that names them, got 'time gear'"),
        (
            "time,speed_fl,speed_fr\n0,1,1\n",
            "expected one column of speed, got speed_fl, speed_fr; leave the oth",
        ),
        ("time,speed\n0,1\n1\n", "expected 2 columns as in the first line, got '1'"),
        ("speed\n0,12\n1,13\n2,14\n", "expected 1 columns as in the first line, got '0 12'"),
        ("speed\n0,12.5\n2,13.5\n", "expected 1 columns as in the first line, got '0 12.5'"),
        ("time,speed\n0,fast\n", "expected a number, got 'fast'"),
        ("time,angular_velocity\n0,0.1\n", ".* titles that names them, got 'time angular_velocity'"),
        ("time,speed\n10:15:30,9\n", "expected a number, got '10:15:30'; write times in seconds"),
        (
            "# time [s], speed [km/h]\n0 36\n",
            r"expected titles with the unit, got '# time \[s\], speed \[km/h\]'; write them with",
        ),
        ("# speed in km/h\ntime,speed\n0,36\n", "expected titles with the unit, got '# speed in km/h'"),
        ("# speed in km/h\n# time speed\n0 36\n", "expected titles with the unit, got '# speed in km/h'"),
        ("0,10\n0.1,130\n", "expected m/s up to 100, got 130; name another unit, as speed_kmh"),
        ("0.2,10\n0.1,11\n", "expected times that rise, got others"),
        ("nan,10\n0.1,11\n", "expected times that rise, got others"),
        ("13,88\n13,91\n", "expected rising times, got '13,88' and the like; write decimals with a point"),
        (
            "time,speed m/s\n0,0 12,5\n0,1 13,5\n",
            "expected a title of time and one of speed, got one title of both",
        ),
        (b"\x89PNG\x00\xff\xfe", "not a text file"),
    ],
)
def test_what_is_no_table_of_speeds(read, text, message):
    with pytest.raises(ValueError, match=rf"speed .*speed.csv: {message}"):
        read(text)


@settings(max_examples=200, deadline=None)
@given(data=st.binary() | st.text(alphabet='time,speed v;0123.\n\t-nae"', max_size=60).map(str.encode))
def test_any_bytes_are_speeds_or_one_error(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(data)
    problem, found = "", None
    try:
        found = read_speeds(path)
    except ValueError as error:
        problem = str(error)
    assert problem.startswith(f"speed {path}: ") != (found is not None)
    assert "\n" not in problem
    if found is not None:
        assert len(found.speeds) > 0
        assert found.times is None or len(found.times) == len(found.speeds)
        assert abs(found.at(0, 0.0) or 0.0) <= 100.0
