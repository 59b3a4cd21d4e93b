"""A straight road: a camera, lanes and runs on it, which several tests of the command line share."""

import csv
import json

import torch

from lanebev import Camera, Extrinsics
from lanebev.cli import main
from tests.drawn_road import boundary, on_rows

HEIGHT, WIDTH, FRAMES = 240, 416, 6
CAMERA = Camera.from_parameters(330, 330, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
OFFSETS = (-5.5, -1.8, 1.9, 5.6)
POSE = (0.03, -0.01, 0.005, 1.4)
ROWS = range(0, HEIGHT, 10)


def lane_lines(names):
    """TuSimple lines of a straight road with 3.7 m lanes; no boundary index."""
    z = torch.logspace(0.5, 2.3, 300, dtype=torch.float64)
    pose = Extrinsics.from_values(*POSE)
    lanes = [on_rows(boundary(CAMERA, offset, z, pose), ROWS, WIDTH) for offset in OFFSETS]
    return [json.dumps({"raw_file": name, "lanes": lanes, "h_samples": list(ROWS)}) for name in names]


def run(data, *extra, source="images", lanes="lanes.json", out):
    fixed = ["--camera", str(data / "camera.yaml"), "--lanes", str(data / lanes), "--calibrator", "two-stage"]
    return main(["run", str(data / source), *fixed, "--out", str(out), *extra])


def table(folder):
    with open(folder / "extrinsics.csv", newline="") as file:
        return list(csv.DictReader(file))


def fails(capsys, arguments, *words):
    """The command says one line with these words, returns 2."""
    try:
        status = main([str(argument) for argument in arguments])
    except SystemExit as exit_:
        status = exit_.code
    output = capsys.readouterr()
    assert status == 2
    assert output.out == ""
    assert output.err.count("\n") == 1, output.err
    for word in words:
        assert word in output.err, output.err
