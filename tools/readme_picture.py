"""Draw docs/assets/before_after.jpg from the demo: input, bird's-eye view by a fixed and by the own pose.

python -m tools.readme_picture [--demo out/demo] [--frame 48]
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics
from lanebev.io.video import open_source
from train.commands import one_line_errors

OUT = Path(__file__).resolve().parents[1] / "docs" / "assets" / "before_after.jpg"
GRID = BEVGrid(x=(-10.0, 10.0), z=(5.0, 40.0), resolution=35 / 360)


def pose_of(row: dict[str, str]) -> Extrinsics:
    """Return the pose of a row of extrinsics.csv, batch size 1."""
    angles = [math.radians(float(row[f"{name}_deg"])) for name in ("pitch", "yaw", "roll")]
    return Extrinsics(*torch.tensor([*angles, float(row["height_m"])]).split(1))


def bird_view(image: NDArray[np.uint8], camera: Camera, pose: Extrinsics) -> Image.Image:
    """Convert an image (H, W, 3) to its bird's-eye view."""
    tensor = torch.from_numpy(image.copy()).permute(2, 0, 1)[None] / 255
    lens = camera.distortion[None].float() if camera.distortion.numel() else None
    bev, _ = BEVWarp(GRID)(tensor, camera.intrinsics[None].float(), pose, lens, camera.model)
    return Image.fromarray((255 * bev[0].permute(1, 2, 0)).round().byte().numpy())


def side_by_side(titled: list[tuple[str, Image.Image]], gap: int = 8, bar: int = 26) -> Image.Image:
    """Join pictures of one height in a row, each under its title."""
    width = sum(picture.width for _, picture in titled) + gap * (len(titled) - 1)
    sheet = Image.new("RGB", (width, titled[0][1].height + bar), "white")
    draw, font, x = ImageDraw.Draw(sheet), ImageFont.load_default(15), 0
    for title, picture in titled:
        draw.text((x + 4, 4), title, fill="black", font=font)
        sheet.paste(picture, (x, bar))
        x += picture.width + gap
    return sheet


@one_line_errors()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--demo", type=Path, default=Path("out/demo"), help="output folder of lanebev demo")
    parser.add_argument("--frame", type=int, default=48, help="number of the frame to show")
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    camera = Camera.from_file(args.demo / "drive" / "camera.yaml")
    source = open_source(str(args.demo / "drive" / "drive.mp4"))
    frame = next(itertools.islice(source, args.frame, None), None)
    if frame is None or frame.image is None:
        raise ValueError(f"--frame: expected one of the {source.count} frames of the demo, got {args.frame}")
    with open(args.demo / "extrinsics.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    first = next(row for row in rows if row["status"] == "TRACKING")
    fixed, own = (bird_view(frame.image, camera, pose_of(row)) for row in (first, rows[args.frame]))
    panels = [("input", Image.fromarray(frame.image)), ("fixed pose", fixed), ("estimated pose", own)]
    side_by_side(panels).save(args.out, quality=88)


if __name__ == "__main__":
    main()
