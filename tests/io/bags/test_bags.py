"""MCAP files and ROS bags as sources, written by the libraries of their own."""

from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lanebev import Camera
from lanebev.app.config import RunConfig
from lanebev.app.drive.sources import camera_of, make_source
from lanebev.cli import main
from lanebev.io.bags import BagSource, open_bag_source
from lanebev.io.bags.images import TopicImages, message_image
from lanebev.io.formats.mcap import write
from lanebev.io.formats.record import RunRecord
from lanebev.io.frames import Frame
from lanebev.io.results import ExtrinsicsRow, read_extrinsics
from lanebev.io.rising_clock import RisingClock
from lanebev.io.source_names import is_bag

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
SIZE = (48, 64)
CAMERA = Camera.from_parameters(60, 61, 32, 24, 64, 48, (-0.1, 0.01, 0.0, 0.0, 0.0))
COUNT, START = 6, 1_700_000_000.5


def _picture(number):
    image = np.full((*SIZE, 3), 40, np.uint8)
    image[:, :, 0] = 20 * number
    return image


def _header(number, frame="camera"):
    time = START + 0.1 * number
    stamp = TYPES["builtin_interfaces/msg/Time"](int(time), round(1e9 * (time % 1)))
    return TYPES["std_msgs/msg/Header"](stamp, frame)


def _compressed(number):
    data = cv2.imencode(".png", _picture(number)[..., ::-1])[1].reshape(-1)
    return TYPES["sensor_msgs/msg/CompressedImage"](_header(number), "png", data)


def _jpeg():
    noise = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", noise)[1].reshape(-1)


def _raw(image, encoding, padding=0):
    rows = np.pad(image.reshape(image.shape[0], -1), ((0, 0), (0, padding)))
    shape = (image.shape[0], image.shape[1], encoding, 0, rows.shape[1])
    return TYPES["sensor_msgs/msg/Image"](_header(0), *shape, rows.reshape(-1))


def _info():
    matrix = CAMERA.intrinsics.flatten().numpy().copy()
    lens = (CAMERA.distortion.numpy(), matrix, np.eye(3).reshape(-1))
    projection = torch.cat([CAMERA.intrinsics, torch.zeros(3, 1)], dim=1).flatten().numpy()
    region = TYPES["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return TYPES["sensor_msgs/msg/CameraInfo"](
        _header(0), *SIZE, "plumb_bob", *lens, projection.astype(np.float64), 0, 0, region
    )


def _bag(
    folder, plugin=StoragePlugin.SQLITE3, topics=("/cam/image/compressed",), lenses=("/cam/camera_info",)
):
    """A bag whose lenses have focal lengths a pixel longer from one to the next."""
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        for more, lens in enumerate(lenses):
            name = "sensor_msgs/msg/CameraInfo"
            connection = writer.add_connection(lens, name, typestore=STORE)
            info = _info()
            info.k[0] += more
            writer.write(connection, round(1e9 * START), STORE.serialize_cdr(info, name))
        for topic in topics:
            name = "sensor_msgs/msg/CompressedImage"
            connection = writer.add_connection(topic, name, typestore=STORE)
            for number in range(COUNT):
                logged = round(1e9 * (START + 0.1 * number)) + 5_000_000
                writer.write(connection, logged, STORE.serialize_cdr(_compressed(number), name))
    return folder


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    root = tmp_path_factory.mktemp("bags")
    folder = _bag(root / "mcap", StoragePlugin.MCAP)
    return {"folder": _bag(root / "sqlite"), "folder of mcap": folder, "mcap": next(folder.glob("*.mcap"))}


@pytest.mark.parametrize("kind", ["folder", "folder of mcap", "mcap"])
def test_frames_and_lens_of_a_ros_2_bag(bags, kind):
    config = RunConfig(str(bags[kind]), "")
    source = make_source(config)
    frames = list(source)
    assert [frame.image[0, 0, 0] for frame in frames] == [20 * number for number in range(COUNT)]
    assert [frame.time for frame in frames] == pytest.approx(np.arange(COUNT) / 10, abs=1e-6)
    assert [frame.dt for frame in frames] == pytest.approx([0.1] * COUNT, rel=0.05)
    assert (source.count, source.image_size) == (COUNT, SIZE)
    assert camera_of(config, source).fingerprint() == CAMERA.fingerprint()
    some = list(make_source(replace(config, start=0.15, every=2)))
    assert [frame.source_number for frame in some] == [2, 4]


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/cam/image_rect/compressed", True),
        ("/cam/image_rect_color", True),
        ("/cam/rectified/image", True),
        ("/cam/image_raw", False),
        ("/cam/direct/image", False),
    ],
)
def test_images_that_ros_rectified_have_no_lens(tmp_path, topic, rectified):
    source = make_source(RunConfig(str(_bag(tmp_path / "bag", topics=(topic,))), ""))
    camera = camera_of(RunConfig(source.source, ""), source)
    assert camera.distortion.tolist() == ([] if rectified else CAMERA.distortion.tolist())


@pytest.mark.parametrize(
    ("topic", "more", "names"),
    [
        ("/cam/image_rect_color", 0, ("/cam/camera_info", "/cam/camera_info_raw")),  # zed-ros-wrapper#427
        ("/cam/image_raw_color", 1, ("/cam/camera_info", "/cam/camera_info_raw")),
        ("/image_left/compressed", 0, ("/camera_info_left", "/camera_info_right")),
        ("/image_right/compressed", 1, ("/camera_info_left", "/camera_info_right")),
    ],
)
@pytest.mark.parametrize("order", [1, -1])
def test_images_have_the_lens_of_the_most_like_name(tmp_path, topic, more, names, order):
    names = names[::order]
    source = make_source(RunConfig(str(_bag(tmp_path / "bag", topics=(topic,), lenses=names)), ""))
    assert source.lens["K"][0] == CAMERA.intrinsics[0, 0] + (more if order == 1 else 1 - more)


def _ros1_header(store, number):
    time = START + 0.1 * number
    stamp = store.types["builtin_interfaces/msg/Time"](int(time), round(1e9 * (time % 1)))
    return store.types["std_msgs/msg/Header"](number, stamp, "camera")


def _ros1_bag(path):
    """A ROS 1 bag of compressed images and their camera_info, whose matrices have capital names there."""
    store = get_typestore(Stores.ROS1_NOETIC)
    size, types = tuple(SIZE), store.types
    lens = (CAMERA.distortion.numpy(), CAMERA.intrinsics.flatten().numpy(), np.eye(3).reshape(-1))
    projection = torch.cat([CAMERA.intrinsics, torch.zeros(3, 1)], dim=1).flatten().numpy()
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = types["sensor_msgs/msg/CameraInfo"](
        _ros1_header(store, 0), *size, "plumb_bob", *lens, projection.astype(np.float64), 0, 0, region
    )
    with Writer1(path) as writer:
        lenses = writer.add_connection("/cam/camera_info", info.__msgtype__, typestore=store)
        writer.write(lenses, round(1e9 * START), store.serialize_ros1(info, info.__msgtype__))
        name = "sensor_msgs/msg/CompressedImage"
        images = writer.add_connection("/cam/image/compressed", name, typestore=store)
        for number in range(COUNT):
            data = cv2.imencode(".png", _picture(number)[..., ::-1])[1].reshape(-1)
            message = types[name](_ros1_header(store, number), "png", data)
            logged = round(1e9 * (START + 0.1 * number)) + 5_000_000
            writer.write(images, logged, store.serialize_ros1(message, name))
    return path


@pytest.mark.parametrize(
    ("focals", "words"),
    [
        ((0, 0, 60, 60), ""),
        (
            (60, 60, 63),
            "CameraInfo changes, K[0] from 60.0 to 63.0; the first is taken",
        ),
        ((0, 0), None),
    ],
)
def test_a_lens_that_is_set_up_late_or_moves(tmp_path, focals, words):
    lens, name = tmp_path / "bag", "sensor_msgs/msg/CameraInfo"
    with Writer(lens, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        info = writer.add_connection("/cam/camera_info", name, typestore=STORE)
        images = writer.add_connection("/cam/image", "sensor_msgs/msg/CompressedImage", typestore=STORE)
        for number, focal in enumerate(focals):
            message = _info()
            message.k[:] = message.k * (focal / 60)
            logged = round(1e9 * (START + number))
            writer.write(info, logged, STORE.serialize_cdr(message, name))
            picture = STORE.serialize_cdr(_compressed(number), "sensor_msgs/msg/CompressedImage")
            writer.write(images, logged, picture)
    config = RunConfig(str(lens), "")
    source = make_source(config)
    if words is None:
        with pytest.raises(ValueError, match="has no calibrated CameraInfo beside /cam/image"):
            camera_of(config, source)
        return
    camera = camera_of(config, source)
    assert camera.intrinsics[0, 0] == 60
    assert camera.remark.startswith(words)
    assert bool(camera.remark) == bool(words)


@pytest.mark.parametrize(
    ("field", "place", "words"),
    [
        ("d", 1, "D[1]"),
        ("p", 2, "P[2]"),
        ("width", None, "width"),
        ("distortion_model", None, "distortion_m"),
    ],
)
def test_the_field_of_a_lens_that_changes_is_named(tmp_path, field, place, words):
    name = "sensor_msgs/msg/CameraInfo"
    first, other = _info(), _info()
    if place is None:
        setattr(other, field, {"width": 65, "distortion_model": "rational"}[field])
    else:
        value = getattr(other, field).copy()
        value[place] += 0.5
        setattr(other, field, value)
    folder = tmp_path / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        info = writer.add_connection("/cam/camera_info", name, typestore=STORE)
        images = writer.add_connection("/cam/image", "sensor_msgs/msg/CompressedImage", typestore=STORE)
        for number, message in enumerate((first, first, other)):
            writer.write(info, round(1e9 * (START + number)), STORE.serialize_cdr(message, name))
        picture = STORE.serialize_cdr(_compressed(0), "sensor_msgs/msg/CompressedImage")
        writer.write(images, round(1e9 * START), picture)
    source = make_source(RunConfig(str(folder), ""))
    assert source.lens_remark.startswith(f"CameraInfo changes, {words}"), source.lens_remark


@pytest.mark.parametrize("doubt", ["", "CameraInfo changes"])
def test_remarks_on_a_lens_are_joined(bags, doubt):
    config = RunConfig(str(bags["mcap"]), "")
    source = make_source(config)
    lens = {**source.lens, "distortion_model": "", "D": [-0.1, 0.01, 0.02, 0.005]}
    remark = camera_of(config, replace(source, lens=lens, lens_remark=doubt)).remark
    own = Camera.from_fields(lens).remark
    assert own.startswith("it states four coefficients and no lens model")
    assert remark == (f"{own}; {doubt}" if doubt else own)


def test_other_topics_that_last_longer_change_no_frame_rate(tmp_path):
    name, info = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        images = writer.add_connection("/image", name, typestore=STORE)
        lenses = writer.add_connection("/rear/camera_info", info, typestore=STORE)
        for number in range(COUNT):
            message = STORE.serialize_cdr(_compressed(number), name)
            writer.write(images, round(1e9 * (START + 0.1 * number)), message)
        for seconds in (0, 600):
            writer.write(lenses, round(1e9 * (START + seconds)), STORE.serialize_cdr(_info(), info))
    source = open_bag_source(str(tmp_path / "bag"))
    assert float(source.fps) == pytest.approx(10, rel=0.01)
    assert [frame.dt for frame in source] == pytest.approx([0.1] * COUNT, rel=0.05)


def test_stamps_that_do_not_rise_are_said(tmp_path):  # usb_cam#259
    name = "sensor_msgs/msg/CompressedImage"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/image", name, typestore=STORE)
        for place, number in enumerate((0, 1, 3, 2, 4)):
            message = STORE.serialize_cdr(_compressed(number), name)
            writer.write(connection, round(1e9 * (START + 0.1 * place)), message)
    frames = list(make_source(RunConfig(str(tmp_path / "bag"), "")))
    assert all(frame.image is not None and frame.dt > 0 for frame in frames)
    problems = ["", "", "", "expected a stamp later than the frame before, got -0.1 s"]
    assert [frame.problem for frame in frames[:4]] == problems


@pytest.mark.parametrize(
    ("stamps", "logged", "times", "problems"),
    [
        ([7.0] * 4, [0, 0.1, 0.2, 0.4], [0, 0.1, 0.2, 0.4], {1: "got 0 s"}),
        ([7.0] * 3, [5, 5, 5], [0, 0.5, 1], {1: "got 0 s"}),
        ([None] * 3, [5, 5.1, 5.3], [0, 0.1, 0.3], {}),
        # simulated time, of which some messages have none (gazebo_ros_pkgs#548)
        ([12.3, None, 12.5, 12.6], [900, 900.1, 900.3, 900.4], [0, 0.1, 0.2, 0.3], {}),
        ([None, 12.4, 12.6], [900, 900.1, 900.3], [0, 0.1, 0.3], {}),
        # a bag that is played again
        ([10, 10.1, 5, 5.1, 5.3], [90, 90.1, 90.2, 90.3, 90.5], [0, 0.1, 0.2, 0.3, 0.5], {2: "got -5.1 s"}),
        # a first stamp that is of another clock, as recorders of streams have it
        (
            [9e5, *range(3, 61, 2)],
            [0.1 * i for i in range(30)],
            [0.1 * i if i <= 16 else 1.6 + 2 * (i - 16) for i in range(30)],
            {1: "got -9e+05 s"},
        ),
        ([1, 1.2, 1.1, 1.4], [9, 9.1, 9.2, 9.3], [0, 0.2, 0.3, 0.4], {2: "got -0.1 s"}),
    ],
)
def test_times_rise_whatever_the_stamps(stamps, logged, times, problems):
    clock = RisingClock(0.5)
    found = [clock.time(stamp, record) for stamp, record in zip(stamps, logged, strict=True)]
    assert [time - found[0][0] for time, _ in found] == pytest.approx(times)
    assert {
        place: words[-len(problems.get(place, "")) :] for place, (_, words) in enumerate(found) if words
    } == problems


def test_images_without_stamps_are_said(tmp_path):  # zed-ros-wrapper#969
    name = "sensor_msgs/msg/CompressedImage"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/image", name, typestore=STORE)
        for number in range(COUNT):
            header = replace(_header(0), stamp=TYPES["builtin_interfaces/msg/Time"](0, 0))
            message = STORE.serialize_cdr(replace(_compressed(number), header=header), name)
            writer.write(connection, round(1e9 * (START + 0.2 * number)), message)
    source = open_bag_source(str(tmp_path / "bag"))
    assert source.problem.endswith(f"{COUNT} of its first images have no stamps; they follow as recorded")
    assert [frame.time for frame in source] == pytest.approx(0.2 * np.arange(COUNT))
    assert float(source.fps) == pytest.approx(5)


def test_the_number_of_frames_that_are_taken_is_exact_where_times_vary(tmp_path, monkeypatch):
    name = "sensor_msgs/msg/CompressedImage"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/image", name, typestore=STORE)
        for number in (0, 1, 2, 7, 8, 9):  # tenths of a second
            message = STORE.serialize_cdr(_compressed(number), name)
            writer.write(connection, round(1e9 * (START + 0.1 * number)), message)
    config = RunConfig(str(tmp_path / "bag"), "", start=0.15, end=0.85)
    source = make_source(config)
    assert [frame.source_number for frame in source] == source.taken_numbers == [2, 3, 4]
    assert make_source(replace(config, start=0.3, end=0.75)).taken_count == 1
    with monkeypatch.context() as patch:  # the bag is read once
        patch.setattr(BagSource, "frame_times", lambda self: pytest.fail("it was read again"))
        assert (source.taken_count, source.taken_numbers) == (3, [2, 3, 4])
    with pytest.raises(ValueError, match="expected some of the 6 frames to be taken, got none"):
        make_source(replace(config, start=0.3, end=0.65))


def test_a_topic_of_several_publishers_is_one(tmp_path):  # as rosbag writes them, a connection each
    store, name = get_typestore(Stores.ROS1_NOETIC), "sensor_msgs/msg/CompressedImage"
    with Writer1(tmp_path / "two.bag") as writer:
        connections = [writer.add_connection("/image", name, typestore=store, callerid=c) for c in "ab"]
        for number in range(COUNT):
            header = _ros1_header(store, number)
            data = cv2.imencode(".png", _picture(number)[..., ::-1])[1].reshape(-1)
            message = store.serialize_ros1(store.types[name](header, "png", data), name)
            logged = round(1e9 * (START + 0.1 * number))
            writer.write(connections[number % 2], logged, message)
    source = open_bag_source(str(tmp_path / "two.bag"))
    assert [frame.image[0, 0, 0] for frame in source] == [20 * number for number in range(COUNT)]
    assert source.count == source.taken_count == COUNT


def test_frames_and_lens_of_a_ros_1_bag(tmp_path):
    config = RunConfig(str(_ros1_bag(tmp_path / "drive.bag")), "")
    source = make_source(config)
    frames = list(source)
    assert [frame.image[0, 0, 0] for frame in frames] == [20 * number for number in range(COUNT)]
    assert [frame.time for frame in frames] == pytest.approx(np.arange(COUNT) / 10, abs=1e-6)
    assert (source.count, source.image_size) == (COUNT, SIZE)
    assert camera_of(config, source).fingerprint() == CAMERA.fingerprint()


def test_a_ros_1_bag_that_breaks_off_is_one_line(tmp_path, capsys):
    path = _ros1_bag(tmp_path / "drive.bag")
    path.write_bytes(path.read_bytes()[:-300])
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "bag " in error


def test_an_mcap_of_ours_is_a_source(tmp_path):
    rows = [ExtrinsicsRow(i, i / 10, *[1.0] * 8, "TRACKING", 9, "") for i in range(COUNT)]
    record = RunRecord("drive", rows, np.zeros((COUNT, 4, 4)), camera=CAMERA)
    images = [Frame(number, number / 10, 0.1, "", _picture(number)) for number in range(COUNT)]
    write(tmp_path / "run.mcap", record, images)
    config = RunConfig(str(tmp_path / "run.mcap"), "")
    source = make_source(config)
    assert source.problem == ""
    shown = [frame.image[..., 0].mean() for frame in source]
    assert shown == pytest.approx([20 * number for number in range(COUNT)], abs=4)
    assert camera_of(config, source).fingerprint() == CAMERA.fingerprint()


@pytest.mark.slow
def test_a_run_on_a_bag(bags, tmp_path, capsys):
    assert main(["run", str(bags["mcap"]), "--no-video", "--out", str(tmp_path / "out")]) == 0
    assert len(read_extrinsics(tmp_path / "out" / "extrinsics.csv")) == COUNT
    capsys.readouterr()


@pytest.mark.parametrize(
    ("encoding", "convert"),
    [
        ("rgb8", lambda image: image),
        ("bgr8", lambda image: image[..., ::-1]),
        ("rgba8", lambda image: np.dstack([image, image[..., :1]])),
        ("bgra8", lambda image: np.dstack([image[..., ::-1], image[..., :1]])),
        ("8UC4", lambda image: np.dstack([image[..., ::-1], image[..., :1]])),
    ],
)
def test_raw_images(encoding, convert):
    image = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    assert np.array_equal(message_image(_raw(np.ascontiguousarray(convert(image)), encoding, 5)), image)


def test_grey_and_bayer_images():
    grey = np.random.default_rng(0).integers(0, 255, SIZE, dtype=np.uint8)
    assert np.array_equal(message_image(_raw(grey, "mono8")), np.dstack([grey] * 3))
    red = np.zeros(SIZE, np.uint8)
    red[::2, ::2] = 200  # in RGGB the first pixel is a red one
    shown = message_image(_raw(red, "bayer_rggb8"))[4:-4, 4:-4].reshape(-1, 3).mean(0)
    assert shown[0] > 190
    assert max(shown[1:]) < 5
    blue = message_image(_raw(red, "bayer_bggr8"))[4:-4, 4:-4].reshape(-1, 3).mean(0)
    assert blue[2] > 190
    assert max(blue[:2]) < 5


@pytest.mark.parametrize("order", ["<", ">"])
def test_images_of_16_bits(order):
    grey = np.random.default_rng(0).integers(0, 255, SIZE, dtype=np.uint8)
    colour = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    for image, encoding in ((grey, "mono16"), (colour[..., ::-1], "bgr16")):
        rows = (image.astype(f"{order}u2") * 257).reshape(SIZE[0], -1).view(np.uint8)
        message = replace(_raw(rows, encoding, 4), width=SIZE[1], is_bigendian=int(order == ">"))
        expected = colour if encoding == "bgr16" else np.dstack([grey] * 3)
        assert np.array_equal(message_image(message), expected)


def test_an_image_of_12_bits_in_16_is_noticed(tmp_path):
    name = "sensor_msgs/msg/Image"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/image", name, typestore=STORE)
        image = replace(_raw(np.full((SIZE[0], 2 * SIZE[1]), 8, np.uint8), "mono16"), width=SIZE[1])
        writer.write(connection, 0, STORE.serialize_cdr(image, name))
    assert "nearly black, its brightest value 8 of 255" in open_bag_source(str(tmp_path / "bag")).problem


@pytest.mark.parametrize(("encoding", "blue"), [("nv12", 0), ("nv21", 1)])
def test_images_with_a_plane_of_colours(encoding, blue):
    planes = np.full((SIZE[0] * 3 // 2, SIZE[1]), 128, np.uint8)
    assert np.ptp(message_image(replace(_raw(planes, encoding, 8), height=SIZE[0]))) == 0  # grey
    planes[SIZE[0] :, blue::2] = 240
    shown = message_image(replace(_raw(planes, encoding, 8), height=SIZE[0]))
    assert shown.shape == (*SIZE, 3)
    assert shown[..., 2].min() > 200 > shown[..., 0].max()


def test_yuv_images():
    uyvy = np.tile(np.array([128, 90], np.uint8), (*SIZE, 1))
    yuyv = np.tile(np.array([90, 128], np.uint8), (*SIZE, 1))
    for image, encoding in ((uyvy, "yuv422"), (yuyv, "yuv422_yuy2")):
        shown = message_image(_raw(image, encoding)).reshape(-1, 3)
        assert np.ptp(shown) <= 1  # grey


@pytest.mark.parametrize(
    ("message", "word"),
    [
        (_raw(_picture(0), "32FC1"), "got '32FC1'"),
        (replace(_raw(_picture(0), "rgb8"), data=np.zeros(9, np.uint8)), "got 9 bytes; is it cut"),
        (replace(_compressed(0), data=np.zeros(9, np.uint8)), "format 'png' that decodes"),
        (replace(_compressed(0), data=np.zeros(0, np.uint8)), "format 'png' that decodes"),
        (replace(_compressed(0), data=_compressed(0).data[:100]), "format 'png' that decodes"),
        (replace(_compressed(0), format="jpeg", data=_jpeg()[:-300]), "format 'jpeg' that decodes"),
    ],
)
def test_images_that_do_not_decode(message, word):
    with pytest.raises(ValueError, match=word):
        message_image(message)


def test_a_whole_jpeg_decodes():
    message = replace(_compressed(0), format="jpeg", data=_jpeg())
    np.testing.assert_array_equal(message_image(message), cv2.imdecode(_jpeg(), 1)[..., ::-1])


def _fails(capsys, *arguments, word):
    assert main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert word in error, error


def test_bags_that_cannot_be_a_source(tmp_path, capsys, monkeypatch):
    two = _bag(tmp_path / "two", topics=("/a", "/b"), lenses=())
    _fails(capsys, "run", two, word="expected one topic of images, got: /a, /b; choose one with --topic")
    _fails(capsys, "run", two, "--topic", "/c", word="expected images on /c, got them on: /a, /b")
    _fails(capsys, "run", two, "--topic", "/a", word="has no calibrated CameraInfo beside /a")
    empty = _bag(tmp_path / "empty", topics=())
    _fails(capsys, "run", empty, word="expected one topic of images, got: none")
    (tmp_path / "no.mcap").write_bytes(b"")
    _fails(capsys, "run", tmp_path / "no.mcap", word="expected one that can be read")
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(99))
    _fails(capsys, "run", tmp_path / "cut.mcap", word="is it cut? mcap recover writes what is whole of it")
    _fails(capsys, "run", tmp_path / "there.mcap", word="No such file")
    monkeypatch.setattr("lanebev.io.bags.messages.find_spec", lambda name: None)
    _fails(capsys, "run", two, word="pip install 'lanebev[formats]'")


@settings(max_examples=60)
@given(data=st.data())
def test_any_bytes_are_one_line(bags, tmp_path_factory, data):
    """A file of any bytes, or one damaged or cut anywhere, is read or is a ValueError."""
    path = tmp_path_factory.mktemp("fuzz") / "a.mcap"
    whole = bytearray(bags["mcap"].read_bytes())
    place = data.draw(st.integers(0, len(whole) - 1))
    kind = data.draw(st.sampled_from(["cut", "damaged", "any"]))
    if kind == "cut":
        whole = whole[:place]
    elif kind == "damaged":
        whole[place : place + 8] = data.draw(st.binary(min_size=8, max_size=8))
    else:
        whole = b"\x89MCAP0\r\n" + data.draw(st.binary(max_size=200))
    path.write_bytes(whole)
    try:
        frames = list(open_bag_source(str(path)))
    except ValueError as error:
        problem = str(error)
        frames = []
    else:
        problem = "bag "
    assert problem.startswith("bag ")
    assert "\n" not in problem
    assert len(frames) <= COUNT + 1


def _mcap(path, name, kinds, messages):
    """Write an MCAP file with messages (bytes) of one type, whose encodings are ``kinds``."""
    with open(path, "wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(name, kinds[1], kinds[2].encode())
        channel = writer.register_channel("/cam/images", kinds[0], schema)
        for number, data in enumerate(messages):
            time = round(1e9 * (START + 0.1 * number))
            writer.add_message(channel, time, data, time)
        writer.finish()
    return str(path)


def test_messages_of_ros_1_in_an_mcap_file(tmp_path):  # as mcap convert drive.bag writes them
    store, name = get_typestore(Stores.ROS1_NOETIC), "sensor_msgs/msg/CompressedImage"
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    messages = []
    for number in range(COUNT):
        made = _compressed(number)
        time = stamp(made.header.stamp.sec, made.header.stamp.nanosec)
        message = store.types[name](header(number, time, "camera"), "png", made.data)
        messages.append(bytes(store.serialize_ros1(message, name)))
    definition = store.generate_msgdef(name, ros_version=1)[0]
    path = _mcap(
        tmp_path / "a.mcap", "sensor_msgs/CompressedImage", ("ros1", "ros1msg", definition), messages
    )
    frames = list(open_bag_source(path))
    assert [frame.image[0, 0, 0] for frame in frames] == [20 * number for number in range(COUNT)]
    assert [frame.time for frame in frames] == pytest.approx(np.arange(COUNT) / 10, abs=1e-6)


def test_an_encoding_that_is_not_known_is_no_damage(tmp_path):
    store, name = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/Image"
    kinds = ("cdr", "ros2msg", store.generate_msgdef(name)[0])
    path = _mcap(
        tmp_path / "a.mcap", name, kinds, [bytes(store.serialize_cdr(_raw(_picture(0), "16UC1"), name))]
    )
    with pytest.raises(ValueError, match=r"a\.mcap: expected an image of rgb8, .*, got '16UC1'; give"):
        open_bag_source(path)


def _foxglove_bag(path, name, form, contents):
    """A ROS 2 bag of Foxglove's messages of numbers and bytes."""
    fields = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(fields, name))
    with Writer(path, version=9) as writer:
        connection = writer.add_connection("/cam", name, typestore=store)
        for number, data in contents:
            message = store.types[name](_header(number).stamp, "camera", data, form)
            writer.write(connection, round(1e9 * START) + number, store.serialize_cdr(message, name))
    return str(path)


def test_foxgloves_messages_in_ros_2(tmp_path):
    contents = [(number, _compressed(number).data) for number in range(COUNT)]
    path = _foxglove_bag(tmp_path / "bag", "foxglove_msgs/msg/CompressedImage", "png", contents)
    frames = list(open_bag_source(path))
    assert [frame.image[0, 0, 0] for frame in frames] == [20 * number for number in range(COUNT)]
    assert [frame.time for frame in frames] == pytest.approx(np.arange(COUNT) / 10, abs=1e-6)


def _packets(count):
    """Return the packets of a video in H.264 with a key frame every fourth, and no B-frames."""
    encoder = av.VideoCodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = 64, 48, "yuv444p", Fraction(1, 10)
    encoder.options = {"g": "4", "bf": "0", "crf": "5", "tune": "zerolatency"}
    frames = [av.VideoFrame.from_ndarray(_picture(number), "rgb24") for number in range(count)]
    return [bytes(packet) for frame in [*frames, None] for packet in encoder.encode(frame)]


@pytest.mark.parametrize("lost", [0, 2])
def test_a_video_of_foxglove(tmp_path, lost):
    contents = [(number, np.frombuffer(data, np.uint8)) for number, data in enumerate(_packets(10))]
    path = _foxglove_bag(tmp_path / "bag", "foxglove_msgs/msg/CompressedVideo", "h264", contents[lost:])
    frames = list(make_source(RunConfig(path, "c")))
    early = 4 - lost if lost else 0  # before the first key frame
    assert [frame.image is None for frame in frames] == [True] * early + [False] * (10 - lost - early)
    for number, frame in enumerate(frames[early:], start=lost + early):
        assert np.abs(frame.image.astype(int) - _picture(number)).mean() < 4
    some = list(make_source(RunConfig(path, "c", every=3)))
    assert [frame.source_number for frame in some] == list(range(0, 10 - lost, 3))
    assert np.abs(some[-1].image.astype(int) - _picture(lost + some[-1].source_number)).mean() < 4


@pytest.mark.parametrize(
    ("kind", "codec", "options"),
    [
        ("h265", "libx265", {"tune": "zerolatency", "x265-params": "log-level=none"}),
        ("vp9", "libvpx-vp9", {"lag-in-frames": "0", "deadline": "realtime"}),
        ("av1", "libsvtav1", {"svtav1-params": "pred-struct=1:lookahead=0"}),
    ],
)
def test_a_packet_of_each_codec_is_an_image(kind, codec, options):
    encoder = av.VideoCodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = 64, 64, "yuv420p", Fraction(1, 10)
    encoder.options = options
    frames = [av.VideoFrame.from_ndarray(np.full((64, 64, 3), 20 * i + 40, np.uint8)) for i in range(5)]
    packets = [packet for frame in [*frames, None] for packet in encoder.encode(frame)]
    images = TopicImages()
    levels = [images(SimpleNamespace(format=kind, data=bytes(each))).mean() for each in packets]
    assert levels == pytest.approx([40, 60, 80, 100, 120], abs=3)


def test_packets_of_a_video_are_named(tmp_path):
    name = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
    path = _mcap(tmp_path / "a.mcap", name, ("cdr", "ros2msg", ""), [b"x"])
    with pytest.raises(ValueError, match="got: none; make a video file of /cam/images, whose packets are"):
        open_bag_source(path)


def test_a_file_of_a_ros_2_bag_and_a_folder_without_metadata_say_what_to_give(bags, tmp_path):
    file = next(bags["folder"].glob("*.db3"))
    (tmp_path / "a.db3").write_bytes(file.read_bytes())
    for source in (file, tmp_path):
        with pytest.raises(
            ValueError, match=r"with its metadata.yaml, got none; give the folder of the .db3"
        ):
            make_source(RunConfig(str(source), ""))
    assert is_bag(str(tmp_path))
    (tmp_path / "0.png").write_bytes(b"")  # images that were taken out of it
    assert not is_bag(str(tmp_path))


GPS = "gps_common/msg/GPSFix"  # of ROS 1, here without the fields that are not read
STORE.register(get_types_from_msg("std_msgs/Header header\nfloat64 speed\n", GPS))


def _moves(name, speed):
    if name == GPS:
        return TYPES[name](_header(2), speed)
    vector = TYPES["geometry_msgs/msg/Vector3"]
    twist = TYPES["geometry_msgs/msg/Twist"](vector(speed, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    if name == "geometry_msgs/msg/Twist":
        return twist
    if name == "geometry_msgs/msg/TwistStamped":
        return TYPES[name](_header(2), twist)
    point, turn = TYPES["geometry_msgs/msg/Point"], TYPES["geometry_msgs/msg/Quaternion"]
    pose = TYPES["geometry_msgs/msg/Pose"](point(0.0, 0.0, 0.0), turn(0.0, 0.0, 0.0, 1.0))
    none = np.zeros(36)
    pose = TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, none)
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, none)
    return TYPES[name](_header(2), "base_link", pose, twist)


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("nav_msgs/msg/Odometry", 0.2),
        ("geometry_msgs/msg/TwistStamped", 0.2),
        ("geometry_msgs/msg/Twist", 0.3),
        (GPS, 0.2),
    ],
)
def test_the_vehicles_speed_is_on_a_topic(tmp_path, plugin, name, time):
    """At its own time; a message without one at that of its recording, here an hour after the images' own."""
    start = START + 3600.0
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        images = "sensor_msgs/msg/CompressedImage"
        connection = writer.add_connection("/image", images, typestore=STORE)
        for number in range(COUNT):
            logged = round(1e9 * (start + 0.1 * number))
            writer.write(connection, logged, STORE.serialize_cdr(_compressed(number), images))
        connection = writer.add_connection("/odom", name, typestore=STORE)
        writer.write(connection, round(1e9 * (start + 0.3)), STORE.serialize_cdr(_moves(name, 7.5), name))
    config = RunConfig(str(tmp_path / "bag"), "", speed_topic="/odom")
    source = make_source(config)
    assert source.speeds.times == pytest.approx([time], abs=1e-6)
    assert [frame.speed for frame in source] == [7.5] * COUNT
    with pytest.raises(ValueError, match="expected speeds on /image, got them on: /odom"):
        make_source(replace(config, speed_topic="/image"))
    assert [frame.speed for frame in make_source(replace(config, speed_topic=None))] == [None] * COUNT
