"""A video of noise with lanes and a camera, which several tests of the commands run on."""

import json
from fractions import Fraction

import numpy as np

from lanebev import Camera
from lanebev.io.video.writer import VideoWriter

HEIGHT, WIDTH, FRAMES = 96, 160, 6


def write_drive(folder, frames=FRAMES, name="drive", seed=0):
    """Write ``NAME.mp4`` of noise, lanes for it and a camera."""
    camera = Camera.from_parameters(120, 120, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
    camera.to_file(folder / "camera.yaml")
    noise = np.random.default_rng(seed)
    with VideoWriter(folder / f"{name}.mp4", Fraction(25)) as writer:
        for _ in range(frames):
            writer.write(noise.integers(60, 90, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    rows = list(range(50, HEIGHT, 2))
    lanes = [[WIDTH / 2 + slope * (row - 48) for row in rows] for slope in (-1.3, 1.2)]
    lines = [
        json.dumps({"raw_file": f"x/{i}", "h_samples": rows, "lanes": lanes, "boundary": [2, 3]})
        for i in range(frames)
    ]
    (folder / f"{name}.json").write_text("\n".join(lines))
    return folder
