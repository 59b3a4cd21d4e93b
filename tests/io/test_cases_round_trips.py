"""What is written is read again, and what is turned is turned back, for any values."""

import json
import math

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lanebev.geometry.rotation import (
    angles_from_matrix,
    pitch_yaw_from_vanishing_dir,
    road_from_cam,
    vanishing_dir_from_pitch_yaw,
)
from lanebev.io.lanes import read_lanes
from lanebev.io.lanes.tusimple import tusimple_line
from lanebev.observation.boundary_vertices import BoundaryVertices

files = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
acute = st.floats(-1.5, 1.5)
turns = st.floats(-3.1, 3.1)
pixel = st.none() | st.floats(0, 1920).map(lambda x: round(x, 3))


@given(acute, acute, turns)
def test_angles(pitch, yaw, roll):
    angles = torch.tensor([pitch, yaw, roll], dtype=torch.float64).unbind()
    matrix = road_from_cam(*angles)
    torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    for got, expected in zip(angles_from_matrix(matrix), angles, strict=True):
        torch.testing.assert_close(got, expected, atol=1e-12, rtol=0)


@given(acute, acute, st.floats(1e-3, 1e3))
def test_vanishing_directions(pitch, yaw, length):
    angles = torch.tensor([pitch, yaw], dtype=torch.float64).unbind()
    direction = vanishing_dir_from_pitch_yaw(*angles)
    torch.testing.assert_close(direction.norm(), torch.ones((), dtype=torch.float64))
    for got, expected in zip(pitch_yaw_from_vanishing_dir(length * direction), angles, strict=True):
        torch.testing.assert_close(got, expected, atol=1e-12, rtol=0)


@files
@given(
    st.text(min_size=1, max_size=20).filter(str.strip),
    st.lists(st.integers(0, 200), min_size=1, max_size=9, unique=True).map(sorted),
    st.data(),
)
def test_lanes_on_rows(tmp_path, name, rows, data):
    lanes = data.draw(st.lists(st.lists(pixel, min_size=len(rows), max_size=len(rows)), max_size=6))
    x = np.array(lanes, dtype=np.float64).reshape(-1, len(rows))
    line = tusimple_line(name, np.array(rows, dtype=np.float64), x)
    (tmp_path / "lanes.json").write_text(line + "\n", encoding="utf-8")
    (frame,) = read_lanes(tmp_path / "lanes.json")
    assert frame.name == name
    there = [i for i in range(len(x)) if np.isfinite(x[i]).any()]
    assert [line.boundary for line in frame.lines] == there
    for line in frame.lines:
        np.testing.assert_array_equal(line.points, np.stack([x[line.boundary], rows], axis=-1))


coordinate, weight = st.floats(-100, 3000), st.floats(0.01, 1.0)
vertex = st.tuples(coordinate, coordinate, weight, st.floats(1e-3, 1e3))


@files
@given(st.lists(st.lists(vertex, max_size=5), min_size=6, max_size=6), st.floats(0.1, 10))
def test_vertices_bit_for_bit(tmp_path, boundaries, scale):
    padded = torch.zeros(1, 6, 5, 4, dtype=torch.float64)
    for i, vertices in enumerate(boundaries):
        if vertices:
            padded[0, i, : len(vertices)] = torch.tensor(vertices, dtype=torch.float64)
    seen = BoundaryVertices(padded[..., :2], padded[..., 2], padded[..., 3], torch.arange(6)[None])
    rows = np.arange(0.0, 720.0, 10.0)
    line = tusimple_line("1.jpg", rows, np.full((6, len(rows)), math.nan), seen, scale)
    (tmp_path / "lanes.json").write_text(json.dumps(json.loads(line)) + "\n")
    (frame,) = read_lanes(tmp_path / "lanes.json")
    assert frame.pose_sigma_scale == scale
    kept = [i for i, vertices in enumerate(boundaries) if vertices]
    assert [line.boundary for line in frame.lines] == kept
    for line in frame.lines:
        x, y, sure, sigma = zip(*boundaries[line.boundary], strict=True)
        np.testing.assert_array_equal(line.points, np.stack([x, y], axis=-1))
        np.testing.assert_array_equal(line.weight, sure)
        np.testing.assert_array_equal(line.sigma, sigma)
