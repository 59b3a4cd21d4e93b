"""Every format read back by its own library, or by its own formula: to 1e-6 what the run says."""

import json
import math
import os
import resource
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import yaml

from lanebev import Camera, Extrinsics
from lanebev.app.convert import convert, writer
from lanebev.cli import main
from lanebev.io.calibration_file import vehicle_from_camera
from lanebev.io.covariances import diagonal_covariances, read_covariances, write_covariances
from lanebev.io.formats.folder import read_record
from lanebev.io.formats.names import FORMATS, parse_formats
from lanebev.io.formats.openpilot import openpilot_angles
from lanebev.io.formats.record import RunRecord, with_images
from lanebev.io.formats.ros_tf import static_transform
from lanebev.io.frames import Frame
from lanebev.io.images.pixels import write_png
from lanebev.io.output.whole_file import whole_file
from lanebev.io.results import ExtrinsicsRow, poses_of, write_extrinsics
from lanebev.io.state import save_state

FRAMES = 5
LENS = (-0.1, 0.02, 0.001, -0.002, 0.003)
CAMERA = Camera.from_parameters(330, 335, 207, 118, 416, 240, LENS)
POSE = (2.5, -1.75, 0.75, 1.4)  # deg, deg, deg, m
MOUNT = Extrinsics.from_values(*map(math.radians, POSE[:3]), POSE[3])
LINE = np.array([[100.0, 200.0], [120.5, 190.0], [140.0, 180.0]])


def _row(number):
    pose = (POSE[0] + 0.1 * number, *POSE[1:])
    reasons = "ROLL_UNSEEN|LANE_CHANGE" if number == 2 else ""
    status = "COASTING" if number == 4 else "TRACKING"
    return ExtrinsicsRow(number, number / 30, *pose, 0.1, 0.2, 0.3, 0.04, status, 9, f"{number}.png", reasons)


def _covariances():
    root = np.random.default_rng(0).normal(size=(FRAMES, 4, 4)) * 1e-2
    return root @ root.transpose(0, 2, 1)


RECORD = RunRecord(
    name="drive",
    rows=[_row(number) for number in range(FRAMES)],
    covariances=_covariances(),
    lanes=[{2: LINE + number, 3: LINE + 50} for number in range(FRAMES)],
    camera=CAMERA,
    mounted=MOUNT,
)
ROAD = torch.tensor([[-1.8, 0.0, 8.0], [1.9, 0.0, 20.0], [0.0, -1.0, 40.0]], dtype=torch.float64)  # X, Y, Z


def _written(tmp_path, name, record=RECORD, images=None):
    path = tmp_path / FORMATS[name].file
    writer(name)(path, record, images)
    return path


def _pixels(pose, lens=False):
    """(P, 2) of ROAD by the library's own projection."""
    ones = torch.ones(len(ROAD), 1, dtype=torch.float64)
    image = torch.cat([ROAD, ones], dim=1) @ pose.projection(CAMERA.intrinsics[None].double())[0].T
    undistorted = image[:, :2] / image[:, 2:]
    return (CAMERA.distort_points(undistorted) if lens else undistorted).numpy()


def _in_vehicle_axes():
    """ROAD in axes x forward, y left, z up."""
    x, y, z = ROAD.T.numpy()
    return np.stack([z, -x, -y], axis=-1)


def test_parquet_by_pyarrow(tmp_path):
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(_written(tmp_path, "parquet"))
    rows = table.to_pylist()
    assert table.schema.metadata[b"camera"].decode() == CAMERA.fingerprint()
    for row, own, covariance in zip(rows, RECORD.rows, RECORD.covariances, strict=True):
        assert np.allclose(np.reshape(row.pop("covariance"), (4, 4)), covariance, rtol=0, atol=1e-12)
        assert row == {**own._asdict(), "reasons": own.reasons.split("|") if own.reasons else []}


def test_json_lines(tmp_path):
    lines = _written(tmp_path, "jsonl").read_text().splitlines()
    for line, own, covariance in zip(lines, RECORD.rows, RECORD.covariances, strict=True):
        fields = json.loads(line, parse_constant=pytest.fail)
        assert np.allclose(fields.pop("covariance"), covariance, rtol=0, atol=1e-12)
        assert fields == {**own._asdict(), "reasons": own.reasons.split("|") if own.reasons else []}


@pytest.mark.parametrize("name", ["jsonl", "parquet"])
def test_a_covariance_that_is_not_known_is_null(tmp_path, name):
    import pyarrow.parquet

    unknown = replace(RECORD, covariances=diagonal_covariances(np.full((FRAMES, 4), 0.1)))
    path = _written(tmp_path, name, unknown)
    if name == "jsonl":
        rows = [json.loads(line) for line in path.read_text().splitlines()]
    else:
        rows = pyarrow.parquet.read_table(path).to_pylist()
    assert [row["covariance"] for row in rows] == [None] * FRAMES


def test_kitti_projects_as_we_do(tmp_path):
    path = _written(tmp_path, "kitti")
    lines = dict(line.split(": ") for line in path.read_text().splitlines())  # as the development kit does
    matrices = {name: np.array(text.split(), dtype=float) for name, text in lines.items()}
    projection = matrices["P2"].reshape(3, 4)
    rectify, velo_to_cam = np.eye(4), np.eye(4)
    rectify[:3, :3] = matrices["R0_rect"].reshape(3, 3)
    velo_to_cam[:3] = matrices["Tr_velo_to_cam"].reshape(3, 4)
    points = np.c_[_in_vehicle_axes(), np.ones(len(ROAD))]
    image = points @ (projection @ rectify @ velo_to_cam).T
    assert np.allclose(image[:, :2] / image[:, 2:], _pixels(MOUNT), rtol=0, atol=1e-6)
    assert torch.allclose(Camera.from_file(path, CAMERA.image_size).intrinsics, CAMERA.intrinsics)


def _rotation(w, x, y, z):
    """The matrix of a unit quaternion, as pyquaternion has it."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_nuscenes_projects_as_we_do(tmp_path):
    """The development kit's ``map_pointcloud_to_image``: ego to camera, then ``view_points``."""
    (record,) = json.loads(_written(tmp_path, "nuscenes").read_text())
    camera = (_in_vehicle_axes() - record["translation"]) @ _rotation(*record["rotation"])
    image = camera @ np.array(record["camera_intrinsic"]).T
    assert np.allclose(image[:, :2] / image[:, 2:], _pixels(MOUNT), rtol=0, atol=1e-6)
    assert {len(record["token"]), len(record["sensor_token"])} == {32}
    assert set(record) == {"token", "sensor_token", "translation", "rotation", "camera_intrinsic"}


def test_nuscenes_is_read_back(tmp_path):
    path = _written(tmp_path, "nuscenes")
    size = CAMERA.image_size
    assert size != (900, 1600)
    read = Camera.from_file(path, image_size=size)
    assert torch.allclose(read.intrinsics, CAMERA.intrinsics, rtol=0, atol=1e-6)
    assert read.image_size == size


def test_ros_messages_by_rosbags(tmp_path):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types, fields = store.types, static_transform(RECORD)
    header = types["std_msgs/msg/Header"](
        types["builtin_interfaces/msg/Time"](0, 0), fields["header"]["frame_id"]
    )
    place = types["geometry_msgs/msg/Vector3"](**fields["transform"]["translation"])
    turn = types["geometry_msgs/msg/Quaternion"](**fields["transform"]["rotation"])
    transform = types["geometry_msgs/msg/Transform"](place, turn)
    name = "geometry_msgs/msg/TransformStamped"
    message = types[name](header, fields["child_frame_id"], transform)
    read = store.deserialize_cdr(store.serialize_cdr(message, name), name)
    turn, place = read.transform.rotation, read.transform.translation
    expected = vehicle_from_camera(MOUNT)[0].numpy()
    assert np.allclose(_rotation(turn.w, turn.x, turn.y, turn.z), expected[:3, :3], rtol=0, atol=1e-9)
    assert np.allclose([place.x, place.y, place.z], expected[:3, 3], rtol=0, atol=1e-9)

    launch = yaml.safe_load(_written(tmp_path, "ros-tf").read_text())
    texts = launch["launch"][0]["node"]["args"].split()
    arguments = dict(zip(texts[::2], texts[1::2], strict=True))
    for axis in "xyz":
        assert float(arguments[f"--{axis}"]) == pytest.approx(getattr(place, axis), abs=1e-9)
        assert float(arguments[f"--q{axis}"]) == pytest.approx(getattr(turn, axis), abs=1e-9)
    assert (arguments["--frame-id"], arguments["--child-frame-id"]) == (
        "base_footprint",
        "camera_optical_frame",
    )

    info = yaml.safe_load(_written(tmp_path, "ros-camera-info").read_text())
    assert info["camera_matrix"]["data"] == CAMERA.intrinsics.flatten().tolist()
    assert info["distortion_coefficients"]["data"] == list(LENS)
    assert Camera.from_file(tmp_path / FORMATS["ros-camera-info"].file).fingerprint() == CAMERA.fingerprint()


def test_openpilot_turns_as_we_do(tmp_path):
    """``get_view_frame_from_calib_frame`` of its common/transformations/camera.py, worked out here."""
    fields = json.loads(_written(tmp_path, "openpilot").read_text())
    roll, pitch, yaw = fields["rpyCalib"]
    rotations = [np.eye(3) for _ in range(3)]
    for axis, angle in enumerate((roll, pitch, yaw)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        rotations[axis][[i, i, j, j], [i, j, i, j]] = (
            np.cos(angle),
            -np.sin(angle),
            np.sin(angle),
            np.cos(angle),
        )
    device_from_calib = rotations[2] @ rotations[1] @ rotations[0]  # its rot_from_euler
    view_from_device = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    view_from_calib = view_from_device @ device_from_calib
    calib_from_road = view_from_device.T  # x forward, y right, z down, from X right, Y down, Z forward
    expected = MOUNT.camera_from_road()[0, :3, :3].numpy()
    assert np.allclose(view_from_calib @ calib_from_road, expected, rtol=0, atol=1e-9)
    assert fields["height"] == [1.4]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_convention_openpilot_signs(axis):
    angles = [0.0, 0.0, 0.0]
    angles[axis] = 0.1
    roll, pitch, yaw = openpilot_angles(Extrinsics.from_values(*angles, 1.5))[0].tolist()
    assert [pitch, yaw, roll] == pytest.approx(angles, abs=1e-12)


def test_opencv_projects_as_we_do(tmp_path):
    storage = cv2.FileStorage(str(_written(tmp_path, "opencv")), cv2.FILE_STORAGE_READ)
    names = ("rvec", "tvec", "camera_matrix", "distortion_coefficients", "rvecs", "tvecs", "frames")
    rvec, tvec, matrix, lens, rvecs, tvecs, frames = (storage.getNode(name).mat() for name in names)
    pixels, _ = cv2.projectPoints(ROAD.numpy(), rvec, tvec, matrix, lens)
    assert np.allclose(pixels[:, 0], _pixels(MOUNT, lens=True), rtol=0, atol=1e-6)
    pixels, _ = cv2.projectPoints(ROAD.numpy(), rvecs[3], tvecs[3], matrix, lens)
    frame = poses_of([RECORD.rows[3]])
    assert np.allclose(pixels[:, 0], _pixels(frame, lens=True), rtol=0, atol=1e-6)
    assert frames.flatten().tolist() == list(range(FRAMES))


def _images():
    """The run's images; that of frame 1 was lost."""
    for number in (0, 2, 3, 4):
        yield Frame(number, number / 30, 1 / 30, "", np.full((240, 416, 3), 10 * number, np.uint8))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"time": 0.2}, r"images: expected frame 3 at 0.100 s as in the run, got it at 0.200 s"),
        ({"name": "other/7.png"}, r"images: expected 3.png as frame 3, got other/7.png"),
        (
            {"image": np.zeros((480, 832, 3), np.uint8)},
            "images: expected 416 x 240 px as of the run's camera, got 832 x 480 in frame 3; is it the run's",
        ),
    ],
)
def test_images_that_are_not_the_runs_are_refused(changed, message):
    frames = [frame._replace(**changed) if frame.number == 3 else frame for frame in _images()]
    with pytest.raises(ValueError, match=message):
        list(with_images(RECORD, frames))
    more = [*_images(), *(frame._replace(number=FRAMES) for frame in list(_images())[:1])]
    with pytest.raises(ValueError, match="images: expected the 5 frames of the run, got number 6 too; is it"):
        list(with_images(RECORD, more))
    with pytest.raises(
        ValueError, match=r"the 5 frames of the run, got none from number 4 on; is it the run's"
    ):
        list(with_images(RECORD, list(_images())[:2]))
    without_last = [frame for frame in more if frame.number != FRAMES - 1]
    with pytest.raises(ValueError, match="images: expected the 5 frames of the run, got number 6 too; is it"):
        list(with_images(RECORD, without_last))


def test_mcap_by_its_library(tmp_path):
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    path = _written(tmp_path, "mcap", replace(RECORD, start=1_700_000_000.25), _images())
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages(["/tf", "/camera/annotations"]):
            messages.setdefault(channel.topic, []).append((message.log_time, schema.name, decoded))
        times = {time for parts in messages.values() for time, _, _ in parts}
        assert sorted(times)[:2] == [1_700_000_000_250_000_000, 1_700_000_000_283_333_333]
        for number, (_, name, transforms) in enumerate(messages["/tf"]):
            (transform,) = transforms.transforms
            expected = vehicle_from_camera(poses_of([RECORD.rows[number]]))[0].numpy()
            turn, place = transform.rotation, transform.translation
            assert np.allclose(_rotation(turn.w, turn.x, turn.y, turn.z), expected[:3, :3], atol=1e-9)
            assert (place.x, place.y, place.z) == (0.0, 0.0, pytest.approx(1.4))
            assert (name, transform.child_frame_id) == ("foxglove.FrameTransforms", "camera")
        for number, (_, name, annotations) in enumerate(messages["/camera/annotations"]):
            assert name == "foxglove.ImageAnnotations"
            found = {line.metadata[0].value: [(p.x, p.y) for p in line.points] for line in annotations.points}
            assert np.allclose(found["2"], LINE + number + 0.5)  # from the first pixel's outer corner
            assert annotations.texts[0].text.split()[0] == RECORD.rows[number].status
        (lens,) = {
            (tuple(decoded.K), tuple(decoded.D), decoded.distortion_model, decoded.width)
            for *_, decoded in reader.iter_decoded_messages(["/camera/calibration"])
        }
        assert lens == (tuple(CAMERA.intrinsics.flatten().tolist()), LENS, "plumb_bob", 416)
        pictures = [decoded for *_, decoded in reader.iter_decoded_messages(["/camera/image"])]
        shown = [cv2.imdecode(np.frombuffer(p.data, np.uint8), cv2.IMREAD_COLOR).mean() for p in pictures]
        assert shown == pytest.approx([0, 20, 30, 40], abs=1)
        tables = [json.loads(message.data) for *_, message in reader.iter_messages(["/lanebev"])]
        assert [row["pitch_deg"] for row in tables] == [row.pitch_deg for row in RECORD.rows]


def test_rerun_by_its_reader(tmp_path):
    import rerun

    path = _written(tmp_path, "rerun", images=_images())
    columns = {}
    for chunk in rerun.chunk.RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in set(batch.schema.names) - {"log_time", "time", "RecordingInfo:start_time"}:
            columns.setdefault((str(chunk.entity_path), name), []).extend(batch.column(name).to_pylist())
    found = dict(
        zip(columns["/pose/pitch_deg", "frame"], columns["/pose/pitch_deg", "Scalars:scalars"], strict=True)
    )
    assert found == {row.frame: [row.pitch_deg] for row in RECORD.rows}
    height = [place[0][2] for place in columns["/road/camera", "Transform3D:translation"]]
    assert height == pytest.approx([1.4] * FRAMES)
    matrix = np.reshape(columns["/road/camera", "Transform3D:mat3x3"][0], (3, 3), order="F")
    expected = vehicle_from_camera(poses_of([RECORD.rows[0]]))[0, :3, :3].numpy()
    assert np.allclose(matrix, expected, rtol=0, atol=1e-6)
    strips = columns["/road/camera/boundaries", "LineStrips2D:strips"]
    assert np.allclose(strips[1][0], LINE + 1.5)
    assert len(columns["/road/camera/image", "EncodedImage:blob"]) == 4


def test_a_device_a_pipe_and_a_folder_are_not_replaced(tmp_path):  # /dev/null was, by root
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name, got in (("pipe", "a device or a pipe"), ("folder", "a folder")):
        words = rf"{name}: expected a file that can be written, got: {got}; "
        with pytest.raises(ValueError, match=words), whole_file(tmp_path / name):
            pass
        with pytest.raises(OSError, match=got):
            save_state(tmp_path / name, {})
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("name", FORMATS)
def test_a_full_disk_is_an_error_of_every_format(tmp_path, name):
    path, before = tmp_path / FORMATS[name].file, resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        with (
            pytest.raises(ValueError, match=r"that can be written, got: .*File too large"),
            whole_file(path) as whole,
        ):
            writer(name)(whole, RECORD, _images())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_a_viewer_is_shown_the_run_as_it_goes_on(tmp_path, monkeypatch, capsys):
    import rerun

    monkeypatch.setattr(
        rerun.RecordingStream, "connect_grpc", lambda stream, _: stream.save(tmp_path / "a.rrd")
    )
    write_png(tmp_path / "0.png", np.zeros((240, 416, 3), np.uint8))
    lane = {"raw_file": "0.png", "h_samples": [200, 210, 220], "lanes": [[100, 90, 80]]}
    (tmp_path / "lanes.json").write_text(json.dumps(lane))
    CAMERA.to_file(tmp_path / "camera.yaml")
    fixed = [f"{tmp_path}/*.png", "--camera", f"{tmp_path}/camera.yaml", "--lanes", f"{tmp_path}/lanes.json"]
    address = "rerun+http://127.0.0.1:9876/proxy"
    assert main(["run", *fixed, "--out", f"{tmp_path}/out", "--rerun", address]) == 0
    capsys.readouterr()
    chunks = rerun.chunk.RrdReader(tmp_path / "a.rrd").stream().to_chunks()
    entities = {str(chunk.entity_path) for chunk in chunks}
    assert {"/road/camera/boundaries", "/road/camera/image", "/pose/height_m", "/status"} <= entities


def test_a_viewer_that_is_not_there(monkeypatch):
    import rerun

    from lanebev.io.formats.rerun import open_viewer

    with pytest.raises(ValueError, match="rerun no address: expected viewer"):
        open_viewer("no address", CAMERA)

    def fail(_):
        raise RuntimeError("no display")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", fail)
    with pytest.raises(ValueError, match="got: no display"):
        open_viewer("viewer", CAMERA)


def _folder(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    write_extrinsics(folder / "extrinsics.csv", RECORD.rows)
    write_covariances(folder / "covariance.csv", RECORD.covariances)
    return folder


def test_covariances_round_trip(tmp_path):
    read = read_covariances(_folder(tmp_path) / "covariance.csv")
    assert np.allclose(read, RECORD.covariances, rtol=1e-8, atol=0)


@pytest.mark.parametrize("text", ["", "a,b\n", "frame,pitch_pitch\n0,1\n"])
def test_foreign_covariances(tmp_path, text):
    (tmp_path / "covariance.csv").write_text(text)
    with pytest.raises(ValueError, match="expected the columns"):
        read_covariances(tmp_path / "covariance.csv")


def test_a_folder_is_read_back(tmp_path):
    folder = _folder(tmp_path)
    lines = [
        {"raw_file": str(number), "h_samples": [180, 190, 200], "lanes": [[-2, 120.5, 100]], "boundary": [2]}
        for number in range(FRAMES)
    ]
    (folder / "lanes.json").write_text("".join(json.dumps(line) + "\n" for line in lines))
    CAMERA.to_file(folder / "calibration.yaml")
    record = read_record(folder)
    assert record.camera.fingerprint() == CAMERA.fingerprint()
    assert record.mounted is None
    frames = list(record.frames())
    assert frames[4].lines[2].tolist() == [[120.5, 190], [100, 200]]
    assert frames[1].pose.pitch.item() == pytest.approx(math.radians(2.6), abs=1e-7)
    standing = record.standing_pose()
    assert standing.extrinsics.pitch.item() == pytest.approx(math.radians(2.65), abs=1e-7)  # of four tracked
    assert "median of 4 TRACKING" in standing.source
    (folder / "lanes.json").write_text(json.dumps(lines[0]) + "\n")
    with pytest.raises(ValueError, match=r"expected 5 frames as in .*, got 1"):
        read_record(folder)


def test_convert_writes_beside_the_run_or_where_it_is_told(tmp_path, capsys):
    folder = _folder(tmp_path)
    assert main(["convert", str(folder), "--to", "jsonl"]) == 0
    assert "frames.jsonl: 5 frames" in capsys.readouterr().out
    assert len((folder / "frames.jsonl").read_text().splitlines()) == FRAMES
    CAMERA.to_file(tmp_path / "camera.yaml")
    convert(str(folder), "kitti", str(tmp_path / "new" / "calib.txt"), str(tmp_path / "camera.yaml"))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["calib.txt"]


def test_convert_says_what_is_amiss(tmp_path, capsys, monkeypatch):
    folder = _folder(tmp_path)

    def fails(*arguments, word):
        assert main(["convert", *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert word in error

    fails(tmp_path, "--to", "jsonl", word="expected a readable extrinsics.csv")
    fails(folder, "--to", "kitti", word="give --camera FILE")
    fails(folder, "--to", "jsonl", "--out", folder, word="expected a file that can be written")
    lost = [row._replace(status="LOST") for row in RECORD.rows]
    write_extrinsics(folder / "extrinsics.csv", lost)
    fails(folder, "--to", "openpilot", word="expected a calibrated mount or a frame that is TRACKING")
    assert not (folder / "kitti_calib.txt").exists()
    monkeypatch.setattr("lanebev.io.formats.names.find_spec", lambda name: None)
    fails(folder, "--to", "parquet", word="pip install 'lanebev[formats]'")


def test_what_is_read_is_not_replaced(tmp_path, capsys):
    folder, camera, link = _folder(tmp_path), tmp_path / "camera.yaml", tmp_path / "link"
    CAMERA.to_file(camera)
    link.symlink_to(folder / "extrinsics.csv")
    before = {path: path.read_bytes() for path in (camera, *folder.iterdir())}
    for out in (folder / "extrinsics.csv", folder / "covariance.csv", camera, link):
        command = ["convert", str(folder), "--to", "kitti", "--camera", str(camera), "--out", str(out)]
        assert main(command) == 2
        assert "expected a file that the command does not read" in capsys.readouterr().err
    assert main(["compare", str(folder), str(folder), "--out", str(folder / "extrinsics.csv")]) == 2
    assert {path: path.read_bytes() for path in before} == before
    assert main(["compare", str(folder), str(folder), "--out", str(folder / "page.html")]) == 0


def test_another_camera_than_the_runs_is_refused(tmp_path):
    folder, camera = _folder(tmp_path), tmp_path / "camera.yaml"
    CAMERA.to_file(folder / "calibration.yaml")
    CAMERA.to_file(camera)
    assert read_record(folder, camera).camera.fingerprint() == CAMERA.fingerprint()
    CAMERA.scaled((2 * CAMERA.image_size[0], 2 * CAMERA.image_size[1])).to_file(camera)
    with pytest.raises(ValueError, match=r"expected the run's, which is in .*calibration.yaml, got another"):
        read_record(folder, camera)


def test_a_camera_that_states_no_size_is_that_of_the_runs_images(tmp_path):
    folder, camera = _folder(tmp_path), Camera.from_parameters(330, 335, 207, 118, 416, 240)
    camera.to_file(folder / "calibration.yaml")
    (tmp_path / "K.txt").write_text("330 0 207\n0 335 118\n0 0 1\n")
    assert read_record(folder, tmp_path / "K.txt").camera.fingerprint() == camera.fingerprint()


def test_names_of_formats():
    assert parse_formats("mcap, parquet,mcap") == ("mcap", "parquet")
    with pytest.raises(ValueError, match="got 'xml'"):
        parse_formats("mcap,xml")
    with pytest.raises(ValueError, match="formats: expected some of"):
        parse_formats(",")


def test_a_run_writes_formats_with_the_rest(tmp_path, capsys):
    from lanebev.io.formats.parquet import frame_table

    write_png(tmp_path / "0.png", np.zeros((240, 416, 3), np.uint8))
    write_png(tmp_path / "1.png", np.zeros((240, 416, 3), np.uint8))
    lane = {"raw_file": "0.png", "h_samples": [200, 210], "lanes": [[100, 90]]}
    (tmp_path / "lanes.json").write_text(json.dumps(lane))
    CAMERA.to_file(tmp_path / "camera.yaml")
    fixed = [f"{tmp_path}/*.png", "--camera", f"{tmp_path}/camera.yaml", "--lanes", f"{tmp_path}/lanes.json"]
    out = tmp_path / "out"
    assert main(["run", *fixed, "--out", str(out), "--formats", "parquet,mcap"]) == 0
    assert {"frames.parquet", "run.mcap", "covariance.csv"} <= {path.name for path in out.iterdir()}
    assert frame_table(read_record(out)).num_rows == 2
    assert main(["run", *fixed, "--out", str(out)]) == 0
    assert not {"frames.parquet", "run.mcap"} & {path.name for path in out.iterdir()}
    capsys.readouterr()


def test_a_missing_library_is_noticed_before_the_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lanebev.io.formats.names.find_spec", lambda name: None)
    assert main(["run", "nothing-there", "--camera", "none.yaml", "--formats", "rerun"]) == 2
    assert "pip install 'lanebev[rerun]'" in capsys.readouterr().err
