"""Every reader of files: any bytes are a value or one ValueError of one line, and soon."""

import json
import os
import random
import struct

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lanebev import Camera
from lanebev.io.calibration_file import read_mount
from lanebev.io.images.pixels import read_image
from lanebev.io.lanes import read_lanes
from lanebev.io.opening import open_source
from lanebev.io.state import load_state
from lanebev.weights import load_segmenter
from tools.fuzz_readers.__main__ import fault
from tools.fuzz_readers.mutations import mutated
from tools.fuzz_readers.readers import readers

READERS = readers()
SEEDS = [seed for reader in READERS.values() for seed in reader.seeds]
thorough = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(tmp_path, name):
    reader = READERS[name]
    for seed in reader.seeds:
        path = tmp_path / f"seed{reader.suffix}"
        path.write_bytes(seed)
        if name == "weights":  # of no network
            with pytest.raises(ValueError, match="weights do not fit the network"):
                reader.read(path)
        else:
            reader.read(path)


@pytest.mark.parametrize("name", [name for name in READERS if name != "video"])
@thorough
@given(data=st.binary(max_size=200))
def test_any_bytes_are_a_value_or_one_line(tmp_path, name, data):
    assert fault(READERS[name], data, tmp_path) == ""


@pytest.mark.parametrize("name", READERS)
@thorough
@given(seed=st.integers(0, 2**32))
def test_any_change_of_a_valid_file_is_a_value_or_one_line(tmp_path, name, seed):
    draw = random.Random(seed)
    reader = READERS[name]
    assert fault(reader, mutated(draw.choice(reader.seeds), SEEDS, draw), tmp_path) == ""


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)
CAMERA_KEYS = (
    "K D P R roi width height distortion_model binning_x xi cam0 intrinsics camera_model resolution "
    "camera_intrinsic intrinsic model_type projection_parameters fx "
    "fl_x ppx projection Camera Camera.fx k1 k4 distortion w h cx value0 cameras"
)
LANE_KEYS = (
    "raw_file h_samples lanes boundary sigma seen pose_sigma_scale file_path lane_lines "
    "image_name name labels frames objects"
)
camera_keys, lane_keys = (st.sampled_from(keys.split()) for keys in (CAMERA_KEYS, LANE_KEYS))
line_keys = st.sampled_from(["uv", "xyz", "visibility", "category"])
lane_lines = st.dictionaries(line_keys, json_values, max_size=4)
label_keys = st.sampled_from(
    ["category", "attributes", "poly2d", "vertices", "types", "markers", "pixel_start"]
)
labels = st.recursive(
    json_values | st.just("lane"),
    lambda inner: st.lists(inner) | st.dictionaries(label_keys, inner),
    max_leaves=20,
)


@thorough
@given(fields=st.dictionaries(camera_keys, json_values, max_size=6))
def test_any_values_of_a_cameras_keys(tmp_path, fields):
    assert fault(READERS["camera.json"], _json(fields), tmp_path) == ""


@thorough
@given(fields=st.dictionaries(lane_keys, json_values | st.lists(lane_lines, max_size=3), max_size=6))
def test_any_values_of_a_lane_files_keys(tmp_path, fields):
    assert fault(READERS["lanes.json"], _json(fields), tmp_path) == ""


@thorough
@given(label=st.dictionaries(label_keys, labels, max_size=4))
def test_any_values_of_a_label(tmp_path, label):
    for fields in ({"name": "1", "labels": [label]}, {"image_name": "1", "lanes": [label]}):
        assert fault(READERS["lanes.json"], _json(fields), tmp_path) == ""


@thorough
@given(lane=lane_lines, intrinsic=json_values, extrinsic=json_values)
def test_any_values_of_an_openlane_line(tmp_path, lane, intrinsic, extrinsic):
    fields = {"file_path": "1.jpg", "intrinsic": intrinsic, "extrinsic": extrinsic, "lane_lines": [lane]}
    assert fault(READERS["openlane.json"], _json(fields), tmp_path) == ""


def _json(fields):
    return json.dumps(fields).encode()


# what the fuzzer found


@pytest.mark.parametrize("text", ["!!opencv-matrix 5", "K: !!opencv-matrix [1]", "? {a: 1}\n: 2"])
def test_an_opencv_matrix_that_is_none(tmp_path, text):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"expected (keys and values|plain keys)") as error:
        Camera.from_file(tmp_path / "c.yaml")
    assert len(str(error.value).splitlines()) == 1


def test_a_mount_file_of_endless_brackets(tmp_path):
    (tmp_path / "calibration.yaml").write_text("[" * 5000)
    with pytest.raises(ValueError, match=r"expected a readable calibration\.yaml, got: expected YAML"):
        read_mount(tmp_path / "calibration.yaml")


def test_openlane_points_that_overflow(tmp_path):
    text = '{"file_path": "1", "intrinsic": [[1e308, 0, 0], [0, 1e308, 0], [0, 0, 1]], "lane_lines": [%s]}'
    (tmp_path / "a.json").write_text(text % '{"xyz": [[10], [1e308], [1]]}')
    with pytest.raises(ValueError, match=r"lane_lines\[0\].xyz: expected m, got 1e\+308"):
        read_lanes(tmp_path / "a.json")
    (tmp_path / "a.json").write_text(text % '{"xyz": [[10], [1], [1]]}')
    with pytest.raises(ValueError, match="intrinsic: expected numbers of a camera"):
        read_lanes(tmp_path / "a.json")


def test_a_video_with_a_title_in_another_encoding(tmp_path):
    import av
    import numpy as np

    path = tmp_path / "v.avi"
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "Stra_e"
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    data = path.read_bytes()
    assert data.count(b"Stra_e") == 1
    path.write_bytes(data.replace(b"Stra_e", b"Stra\xdfe"))
    assert len(list(open_source(str(path)))) == 1


def test_weights_of_a_network_that_fills_no_memory(tmp_path):
    path = tmp_path / "w.safetensors"
    (valid,) = READERS["weights"].seeds
    length = struct.unpack("<Q", valid[:8])[0]
    header = valid[8 : 8 + length].replace(b'base_width\\": 8', b'base_width\\": 80000')
    path.write_bytes(struct.pack("<Q", len(header)) + header + valid[8 + length :])
    with pytest.raises(ValueError, match="base_width: expected 512 at most, got 80000"):
        load_segmenter(path)


@pytest.mark.parametrize("read", [Camera.from_file, read_lanes, read_mount, read_image, load_segmenter])
def test_folders_and_what_is_not_there_are_one_line(tmp_path, read):
    for path in (tmp_path / "none", tmp_path / "a\nb"):
        with pytest.raises(ValueError, match="expected") as error:
            read(path)
        assert str(error.value)
    assert load_state(tmp_path / "none").problem.endswith("there is no such file")


@pytest.mark.parametrize("read", [Camera.from_file, read_lanes, read_mount])
def test_of_a_long_video_given_as_a_text_only_the_beginning_is_read(tmp_path, read):
    path = tmp_path / "drive.mp4"
    path.write_bytes(b"\0\0\0 ftypisom")
    os.truncate(path, 2**40)  # bytes; no disk has them
    with pytest.raises(ValueError, match="not a text file"):
        read(path)
