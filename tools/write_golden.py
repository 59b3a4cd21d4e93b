"""Write the references of tests/app/test_golden.py again, after an intended change.

    python -m tools.write_golden [--inputs]

Inputs, kept beside them: ``frame.png``, a rendered frame, and ``lanes.json``, ten frames of lane points with
noise of 1 px. References: ``segments.csv``, what the shipped network sees in the frame, and
``extrinsics.csv``, what a run on the lane points writes. Say in the commit why they moved.
"""

import contextlib
import csv
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

import lanebev
from lanebev.cli import main as command
from lanebev.observation.frames import image_bytes
from lanebev.render import Drive
from train.commands import command_parser, one_line_errors

FOLDER = Path(__file__).resolve().parents[1] / "tests" / "golden"
FRAMES, SIZE = 10, (180, 320)
LEAST_WEIGHT = 0.3
COLUMNS = ("index", "boundary", "x1", "y1", "x2", "y2", "weight", "sigma")


def seen_segments(picture: Path) -> list[tuple[float, ...]]:
    """Return the shipped network's segments in a clear picture, in the order of COLUMNS."""
    pixels: NDArray[np.uint8] = np.asarray(Image.open(picture))
    image = torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        _, segments = lanebev.LaneBEV.from_pretrained().observe(image, torch.eye(3)[None])
    ends, boundary, weight, sigma = (part[0].double() for part in segments)
    rows = torch.column_stack([torch.arange(len(weight)), boundary, ends.flatten(1), weight, sigma])
    return [tuple(row) for row in rows[weight >= LEAST_WEIGHT].tolist()]


def run_on_lanes(lanes: Path, out: Path) -> Path:
    """Run ``lanebev run`` on black frames with the lane points; the extrinsics.csv that it writes."""
    height, width = SIZE
    camera = {"fx": 300, "fy": 300, "cx": 159.5, "cy": 89.5, "width": width, "height": height}
    with tempfile.TemporaryDirectory() as folder:
        frames = Path(folder) / "frames"
        frames.mkdir()
        for number in range(FRAMES):
            Image.new("RGB", (width, height)).save(frames / f"{number:06d}.png")
        (Path(folder) / "camera.yaml").write_text(json.dumps(camera), encoding="utf-8")
        with contextlib.chdir(folder):  # extrinsics.csv keeps the images' paths as they are given
            inputs = ["frames", "--camera", "camera.yaml", "--lanes", str(lanes.resolve())]
            status = command(["run", *inputs, "--fps", "20", "--lane-width", "3.7", "--out", "out"])
        if status:
            raise ValueError(f"lanebev run: expected status 0, got {status}")
        shutil.copy(Path(folder) / "out" / "extrinsics.csv", out)
    return out


def write_inputs() -> None:
    """Render the frame, and draw the lane points of the first frames of a drive."""
    drive = Drive(10, SIZE, FRAMES, 20.0)
    generator = np.random.default_rng(0)
    height = SIZE[0]
    rows = np.arange(60.0, height, 5.0)
    lines = []
    for number in range(FRAMES):
        frame = drive.frame(number)
        found = {}
        for boundary, (points, visible) in enumerate(zip(frame.boundaries[0], frame.visible[0], strict=True)):
            x, y = points[visible > 0.5].double().numpy().T
            order = np.argsort(y)
            there = (rows >= y.min(initial=height)) & (rows <= y.max(initial=0.0))
            if there.sum() > 2:
                noisy = np.interp(rows, y[order], x[order]) + generator.normal(size=len(rows))
                found[boundary] = [round(v, 2) if t else -2 for v, t in zip(noisy, there, strict=True)]
        fields = {"raw_file": f"frames/{number:06d}.png", "h_samples": rows.astype(int).tolist()}
        lines.append(json.dumps(fields | {"lanes": [*found.values()], "boundary": [*found]}))
    (FOLDER / "lanes.json").write_text("\n".join(lines) + "\n", encoding="utf-8")
    Image.fromarray(image_bytes(drive.frame(0).image[0])).save(FOLDER / "frame.png", optimize=True)


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--inputs", action="store_true", help="also draw the inputs again")
    args = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    if args.inputs:
        write_inputs()
    with open(FOLDER / "segments.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for index, boundary, *numbers in seen_segments(FOLDER / "frame.png"):
            writer.writerow([int(index), int(boundary), *(round(number, 3) for number in numbers)])
    print(run_on_lanes(FOLDER / "lanes.json", FOLDER / "extrinsics.csv"))


if __name__ == "__main__":
    main()
