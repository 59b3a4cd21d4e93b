"""A sheet of rendered frames as a PNG, with real ones beside them if a folder of them is given.

python -m tools.render_sheet --out sheet.png [--count 100] [--kind city] [--real FOLDER] [--truth]
"""

import time
from pathlib import Path

import cv2
import numpy as np
import torch
from jsonargparse.typing import PositiveInt
from numpy.typing import NDArray

from lanebev.geometry.lens import distort_points
from lanebev.observation.frames import image_bytes
from lanebev.render import RenderedFrame, render_views
from lanebev.render.scene.kinds import KINDS
from train.commands import command_parser, one_line_errors

COLOURS = [(255, 80, 80), (255, 160, 0), (60, 220, 60), (60, 200, 255), (120, 120, 255), (255, 90, 255)]


def draw_truth(picture: np.ndarray, frame: RenderedFrame, row: int) -> None:
    """Draw dots on every visible boundary point (rings where it is hidden)."""
    points = frame.boundaries[row].flatten(0, 1)[None]
    taken = distort_points(points, frame.intrinsics[row : row + 1], frame.distortion[row : row + 1])[0]
    taken = taken.unflatten(0, frame.boundaries.shape[1:3])
    for boundary, colour in enumerate(COLOURS):
        for p in range(taken.shape[1]):
            if frame.painted[row, boundary, p] > 0:
                centre = tuple(round(float(v)) for v in taken[boundary, p])
                hidden = frame.visible[row, boundary, p] == 0
                cv2.circle(picture, centre, 3 if hidden else 1, colour, 1 if hidden else -1)


def real_frames(folder: Path, count: int, size: tuple[int, int]) -> list[np.ndarray]:
    """Return pictures of a folder, evenly picked, RGB, resized."""
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".jpg", ".png"))
    picked = [paths[i] for i in np.linspace(0, len(paths) - 1, min(count, len(paths))).astype(int)]
    pictures = [cv2.imread(str(p)) for p in picked]
    return [cv2.resize(p, size[::-1], interpolation=cv2.INTER_AREA)[..., ::-1] for p in pictures]


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=PositiveInt, default=100)
    parser.add_argument("--columns", type=PositiveInt, default=10)
    parser.add_argument("--size", type=int, nargs=2, default=(180, 320), metavar=("H", "W"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=KINDS, default="any", help="kind of road")
    parser.add_argument("--batch", type=PositiveInt, default=4)
    parser.add_argument("--real", type=Path, help="folder of real pictures, shown as every second one")
    parser.add_argument("--truth", action="store_true", help="draw the boundaries")
    args = parser.parse_args()
    torch.set_num_threads(1)

    size, generator = tuple(args.size), torch.Generator().manual_seed(args.seed)
    real = real_frames(args.real, args.count // 2, size) if args.real else []
    wanted = args.count - len(real)
    pictures: list[NDArray[np.uint8]] = []
    start = time.perf_counter()
    while len(pictures) < wanted:
        frame = render_views(min(args.batch, wanted - len(pictures)), size, generator, kind=args.kind)
        for row, picture in enumerate(image_bytes(frame.image)):
            if args.truth:
                draw_truth(picture, frame, row)
            pictures.append(picture)
    print(f"{1e3 * (time.perf_counter() - start) / wanted:.0f} ms per image of {size[1]}x{size[0]}")
    if real:
        mixed = [p for pair in zip(pictures, real, strict=False) for p in pair]
        pictures = mixed + pictures[len(real) :]
    blank = np.zeros_like(pictures[0])
    pictures += [blank] * (-len(pictures) % args.columns)
    rows = [np.hstack(pictures[i : i + args.columns]) for i in range(0, len(pictures), args.columns)]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out), np.vstack(rows)[..., ::-1])


if __name__ == "__main__":
    main()
