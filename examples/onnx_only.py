"""Calibrate on a video by an exported step alone, without PyTorch: ``onnx_only.py step.onnx VIDEO OUT.csv``.

``lanebev export --part step --camera CAMERA`` writes step.onnx. Writes pitch, yaw, roll (degrees), height (m)
and their standard deviations for every frame, and the last bird's-eye view beside them.
"""

import csv
import json
import sys

import cv2
import numpy as np
import onnxruntime

TYPES = {"tensor(double)": np.float64, "tensor(int64)": np.int64, "tensor(bool)": np.bool_}
COLUMNS = (
    "frame", "pitch_deg", "yaw_deg", "roll_deg", "height_m",
    "pitch_std_deg", "yaw_std_deg", "roll_std_deg", "height_std_m", "status",
)  # fmt: skip


def first_state(session):
    """Return zeros by name: ``reset`` puts what begins a drive in their place."""
    states = (each for each in session.get_inputs() if each.name.startswith("state_"))
    return {each.name: np.zeros([1, *each.shape[1:]], TYPES[each.type]) for each in states}


def rows(session, video, facts):
    """Calibrate frame after frame: (pose and standard deviations in degrees and m, status, view)."""
    names = [each.name for each in session.get_outputs()]
    wanted = {each.name for each in session.get_inputs()}
    state, reset = first_state(session), True
    lanes = next(each.shape[1] for each in session.get_inputs() if each.name == "lane_width")
    dt = 1 / (video.get(cv2.CAP_PROP_FPS) or 30)
    while (frame := video.read()[1]) is not None:
        image = np.ascontiguousarray(frame[None, ..., ::-1].transpose(0, 3, 1, 2), np.float32) / 255
        feeds = {
            "image": image,
            "intrinsics": np.array(facts["intrinsics"])[None],
            "distortion": np.array(facts["distortion"])[None],
            "dt": np.array([dt]),
            "lane_width": np.full((1, lanes), 3.7),
            "reset": np.array([reset]),
        }
        feeds = {name: value for name, value in feeds.items() if name in wanted}
        out = dict(zip(names, session.run(names, feeds | state), strict=True))
        state, reset = {name: out[f"next_{name}"] for name in state}, False
        degrees = np.array([*[180 / np.pi] * 3, 1.0])
        pose, std = out["extrinsics"][0], np.sqrt(np.diagonal(out["covariance"][0]))
        yield degrees * pose, degrees * std, int(out["status"][0]), out["bev"][0]


def main(model, source, out):
    """Write the rows and the last view."""
    onnxruntime.set_default_logger_severity(3)  # errors only
    session = onnxruntime.InferenceSession(model)
    facts = json.loads(session.get_modelmeta().custom_metadata_map["lanebev"])
    video = cv2.VideoCapture(source)
    size = [int(video.get(side)) for side in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)]
    if size != facts["image_size"]:
        sys.exit(f"{source}: expected images of {facts['image_size']} (height, width), got {size}")
    with open(out, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for number, (pose, std, status, bev) in enumerate(rows(session, video, facts)):
            table.writerow([number, *(f"{value:.6f}" for value in (*pose, *std)), status])
            view = (255 * bev[::-1]).round().astype(np.uint8).transpose(1, 2, 0)
    cv2.imwrite(f"{out}.png", view)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: python onnx_only.py step.onnx VIDEO OUT.csv")
    main(*sys.argv[1:])
