"""Draw docs/assets/before_after.jpg from the demo: input, bird's-eye view by a fixed and by the own pose.

python -m tools.readme_picture [--demo out/demo] [--frame 48]
"""

import itertools
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from lanebev import BEVGrid, Camera
from lanebev.app.recording.views import bird_view
from lanebev.io.opening import open_source
from lanebev.io.results import poses_of, read_extrinsics
from train.commands import command_parser, one_line_errors

OUT = Path(__file__).resolve().parents[1] / "docs" / "assets" / "before_after.jpg"
GRID = BEVGrid(x=(-10.0, 10.0), z=(5.0, 40.0), resolution=35 / 360)
BAR = 26  # px, height of the titles


def side_by_side(titled: list[tuple[str, Image.Image]], gap: int = 8) -> Image.Image:
    """Join pictures of one height in a row, each under its title."""
    width = sum(picture.width for _, picture in titled) + gap * (len(titled) - 1)
    sheet = Image.new("RGB", (width, titled[0][1].height + BAR), "white")
    draw, font, x = ImageDraw.Draw(sheet), ImageFont.load_default(15), 0
    for title, picture in titled:
        draw.text((x + 4, 4), title, fill="black", font=font)
        sheet.paste(picture, (x, BAR))
        x += picture.width + gap
    return sheet


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--demo", type=Path, default=Path("out/demo"), help="output folder of lanebev demo")
    parser.add_argument("--frame", type=int, default=48, help="number of the frame to show")
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    camera = Camera.from_file(args.demo / "drive" / "camera.yaml")
    source = open_source(str(args.demo / "drive" / "drive.mp4"))
    frame = next(itertools.islice(source, args.frame, None), None)
    if frame is None or frame.image is None:
        raise ValueError(f"--frame: expected one of the {source.count} frames of the demo, got {args.frame}")
    rows = read_extrinsics(args.demo / "extrinsics.csv")
    first = next(row for row in rows if row.status == "TRACKING")
    panels = [("input", Image.fromarray(frame.image))]
    for title, row in (("fixed pose", first), ("estimated pose", rows[args.frame])):
        panels.append((title, Image.fromarray(bird_view(GRID, frame.image, camera, poses_of([row])))))
    side_by_side(panels).save(args.out, quality=88)


if __name__ == "__main__":
    main()
