"""Every example runs, and is short."""

import math
import runpy
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

import lanebev
from lanebev.export.part import Part
from lanebev.export.write import write_onnx
from lanebev.io.video.writer import VideoWriter

EXAMPLES = Path(__file__).parents[2] / "examples"
GOLDEN = Path(__file__).parents[1] / "golden"


def run_example(name, monkeypatch, tmp_path, *arguments):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


class Counts(nn.Module):
    """Has the names of an exported step; its pitch counts the frames since a reset."""

    inputs = ("image", "dt", "lane_width", "reset", "intrinsics", "state_count")
    outputs = ("bev", "extrinsics", "covariance", "status", "next_state_count")

    def forward(self, image, dt, lane_width, reset, intrinsics, count):
        count = torch.where(reset, 0, count) + 1
        pose = torch.stack([count.deg2rad(), dt, lane_width[:, 0], intrinsics[:, 0, 0]], dim=-1)
        return image[..., ::2, ::2], pose, torch.ones_like(pose).diag_embed(), 1 * reset, count


def counting_step():
    values = (torch.rand(1, 3, 64, 128), *(torch.rand(1, *shape).double() for shape in ((), (5,))))
    state = torch.zeros(1, dtype=torch.float64)
    example = (*values, torch.tensor([True]), torch.eye(3).double()[None], state)
    inputs = {
        name: value.repeat(2, *[1] * (value.ndim - 1))
        for name, value in zip(Counts.inputs, example, strict=True)
    }
    facts = {
        "image_size": [64, 128],
        "intrinsics": [[80.0, 0, 63.5], [0, 80.0, 31.5], [0, 0, 1]],
        "distortion": [],
    }
    return Part(Counts().eval(), inputs, Counts.outputs, facts)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short(path):
    if path.name == "onnx_only.py":
        pytest.skip("it has no library behind it")
    code = [
        line
        for line in path.read_text().splitlines()
        if line and not line.startswith(('"""', "import", "from"))
    ]
    assert len(code) <= 20


@pytest.mark.parametrize("name", ["live_loop.py", "onnx_only.py", "own_video.py"])
def test_an_example_without_arguments_says_how_it_is_called(name, monkeypatch, tmp_path):
    with pytest.raises(SystemExit, match=f"usage: python {name} "):
        run_example(name, monkeypatch, tmp_path)


def test_a_live_loop_on_nothing_is_one_line(monkeypatch, tmp_path):
    with pytest.raises(SystemExit, match="expected a video or the number of a camera, got none"):
        run_example("live_loop.py", monkeypatch, tmp_path, "none.mp4", 60)


def test_another_detectors_boundaries(monkeypatch, tmp_path, capsys):
    run_example("other_detector.py", monkeypatch, tmp_path)
    values = [float(word) for word in capsys.readouterr().out.replace(",", "").split() if word[-1].isdigit()]
    assert values == pytest.approx([0.0, 0.0, 0.0, 3.7 / 2.6], abs=5e-3)


@pytest.mark.slow
def test_features_of_another_network(monkeypatch, tmp_path, capsys):
    run_example("embed.py", monkeypatch, tmp_path)
    assert "torch.Size([1, 1, 114, 40])" in capsys.readouterr().out


@pytest.mark.slow
def test_a_live_loop_ends_with_a_state(monkeypatch, tmp_path, capsys):
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (320, 192))
    for value in (0, 90, 180):
        writer.write(np.full((192, 320, 3), value, np.uint8))
    writer.release()
    run_example("live_loop.py", monkeypatch, tmp_path, tmp_path / "v.avi", 60)
    said = capsys.readouterr().out
    assert said.count("+-") == 3
    assert "does not advance" not in said
    assert (tmp_path / "state.safetensors").is_file()


BEST_EFFORT = {"depth": 1, "reliability": "best effort"}


class Message(SimpleNamespace):
    """Stand-in for a ROS message: its fields are the keywords."""


def ros_modules(messages, info, sent, said):
    """Stand-ins for the ROS 2 packages, in which a node is given one CameraInfo and some images."""
    node = Message(get_logger=lambda: Message(info=said.append))

    def create_subscription(kind, topic, callback, quality):
        assert vars(quality) == BEST_EFFORT  # with it a node receives what any publisher sends
        node.receive = callback

    def wait_for_message(kind, node, topic, *, qos_profile):
        assert vars(qos_profile) == BEST_EFFORT
        return True, info

    node.create_subscription = create_subscription
    kinds = dict.fromkeys(("Quaternion", "Transform", "TransformStamped", "Vector3"), Message)
    modules = {
        "rclpy": {
            "init": lambda: None,
            "create_node": lambda name: node,
            "spin": lambda node: [node.receive(message) for message in messages],
        },
        "rclpy.qos": {"QoSProfile": Message, "ReliabilityPolicy": Message(BEST_EFFORT="best effort")},
        "rclpy.wait_for_message": {"wait_for_message": wait_for_message},
        "cv_bridge": {"CvBridge": lambda: Message(imgmsg_to_cv2=lambda message, code: message.data)},
        "geometry_msgs.msg": kinds,
        "sensor_msgs.msg": {"CameraInfo": Message, "Image": Message},
        "std_msgs.msg": {"Header": Message},
        "tf2_ros": {"TransformBroadcaster": lambda node: Message(sendTransform=sent.append)},
    }
    return {name: SimpleNamespace(**names) for name, names in modules.items()}


def test_a_ros_node_publishes_the_pose(monkeypatch, tmp_path):
    """Of a camera that looks straight ahead, at the height that the filter says, in every TRACKING frame."""
    image = cv2.imread(str(GOLDEN / "frame.png"))
    height, width = image.shape[:2]
    header = [Message(stamp=Message(sec=7, nanosec=k * 50_000_000), frame_id="front") for k in range(3)]
    info = Message(
        width=width, height=height, distortion_model="plumb_bob", d=[0.0] * 5,
        k=[300.0, 0, (width - 1) / 2, 0, 300.0, (height - 1) / 2, 0, 0, 1],
    )  # fmt: skip
    sent, said, results = [], [], []
    called = lanebev.Session.__call__

    def remembered(self, frame, stamp):
        results.append((stamp, called(self, frame, stamp)))
        return results[-1][1]

    monkeypatch.setattr(lanebev.Session, "__call__", remembered)
    images = [Message(header=each, data=image) for each in header]
    for name, module in ros_modules(images, info, sent, said).items():
        monkeypatch.setitem(sys.modules, name, module)
    run_example("ros2_node.py", monkeypatch, tmp_path)
    assert [stamp for stamp, _ in results] == pytest.approx([7.0, 7.05, 7.1])
    tracked = [result for _, result in results if result.status == lanebev.Status.TRACKING]
    assert len(said) == 3
    assert len(sent) == len(tracked) > 0
    for message, result in zip(sent, tracked, strict=True):
        pose = message.transform
        assert (message.header.frame_id, message.child_frame_id) == ("base_footprint", "front")
        assert pose.translation.z == pytest.approx(float(result.extrinsics.height))
        x, y, z, w = (getattr(pose.rotation, name) for name in "xyzw")
        ahead = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))  # the camera's z axis
        pitch, yaw = (float(angle) for angle in result.extrinsics[:2])
        assert ahead[0] > 0.9  # forward
        assert ahead[1] == pytest.approx(math.cos(pitch) * math.sin(yaw), abs=0.02)  # yaw > 0 is left
        assert ahead[2] == pytest.approx(-math.sin(pitch), abs=0.02)  # pitch > 0 is down


@pytest.mark.slow
def test_ones_own_video(monkeypatch, tmp_path, capsys):
    with VideoWriter(tmp_path / "drive.mp4", Fraction(20)) as video:
        for _ in range(2):
            video.write(np.asarray(Image.open(GOLDEN / "frame.png")))
    (tmp_path / "camera.yaml").write_text("{fx: 300, fy: 300, cx: 159.5, cy: 89.5, width: 320, height: 180}")
    run_example("own_video.py", monkeypatch, tmp_path, "drive.mp4", "camera.yaml", "out")
    assert "2 frames" in capsys.readouterr().out
    assert (tmp_path / "out" / "report.html").is_file()


WITHOUT_TORCH = """
import runpy, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "lanebev"):
            raise ImportError(f"{name} is not to be imported")

sys.meta_path.insert(0, Refuse())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.slow
def test_a_step_runs_without_torch(tmp_path):
    """In a process that refuses torch, by a file with the names of a step."""
    part = counting_step()
    write_onnx(part, tmp_path / "step.onnx")
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (128, 64))
    for value in (0, 90, 180):
        writer.write(np.full((64, 128, 3), value, np.uint8))
    writer.release()
    subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, EXAMPLES / "onnx_only.py", "step.onnx", "v.avi", "out.csv"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    rows = (tmp_path / "out.csv").read_text().splitlines()
    assert rows[0].startswith("frame,pitch_deg,yaw_deg,roll_deg,height_m,pitch_std_deg")
    assert len(rows) == 4
    assert rows[1] == "0,1.000000,2.864789,211.994384,80.000000,57.295780,57.295780,57.295780,1.000000,1"
    assert [row.split(",")[1] for row in rows[1:]] == ["1.000000", "2.000000", "3.000000"]
    assert [row[-1] for row in rows[1:]] == ["1", "0", "0"]  # reset with the first frame only
    view = cv2.imread(str(tmp_path / "out.csv.png"))
    assert view.shape == (32, 64, 3)
    assert abs(int(view.mean()) - 180) <= 2


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_stands_in_the_docs(path):
    pages = (page.read_text(encoding="utf-8") for page in (EXAMPLES.parent / "docs").rglob("*.md"))
    assert any(f'--8<-- "examples/{path.name}"' in page for page in pages)
