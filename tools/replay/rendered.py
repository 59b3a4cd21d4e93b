"""Render drives and store the boundary vertices that the shipped network finds in them.

    python -m tools.replay.rendered [NAME…]

writes ``tests/replay/drives/NAME.npz`` anew, which takes some minutes a drive. The replay reads these files
only: another renderer or other weights change nothing until they are written.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from lanebev.camera.model import Camera
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.segments import camera_segments
from lanebev.pipeline import LaneBEV
from lanebev.render import Drive
from lanebev.tensors import join_tensors
from lanebev.testing.motions import Motion, Pose, fall, landing_time, moved, share_done
from lanebev.types import Extrinsics
from tools.replay.kinds import FRAMES, KNOCK
from tools.replay.recording import Recording
from train.commands import command_parser, one_line_errors

DRIVES = Path(__file__).resolve().parents[2] / "tests" / "replay" / "drives"
FPS = 20.0
SIZE = (360, 640)
_PIXEL = 64.0  # steps of a coordinate per px, so that 16 bits hold it
_TOGETHER = 4  # frames rendered and seen at once
_KNOCKED_AT = 2.0  # s


class Shock(NamedTuple):
    """A fast motion of the camera.

    Attributes:
        pose: difference of pitch, yaw, roll (rad) and height (m) at a time in s.
        first: s, when it begins.
        last: s, when it is over.
    """

    pose: Motion
    first: float
    last: float

    def during(self, times: torch.Tensor) -> torch.Tensor:
        """Return which times (T,) s are in it, (T,) bool."""
        return (times >= self.first) & (times < self.last)


def _knocked(t: float) -> Pose:
    """Return a knock of 3° and 25 cm in 0.1 s that stays."""
    return moved((0.0, 0.0, 0.0, 0.0), KNOCK, share_done(t, _KNOCKED_AT, 0.1))


FALL = Shock(fall, 0.0, landing_time())
"""The drive begins in mid-air: a fall of 1.2 m onto the wheels, in half a second."""

KNOCKED = Shock(_knocked, _KNOCKED_AT, _KNOCKED_AT + 0.1)


@dataclass(frozen=True)
class Rendered:
    """Settings of a rendered drive.

    Attributes:
        kind: one of the replay's kinds.
        world: kind of the renderer's world.
        seed: seed of the drive.
        shock: what moves the camera beside the drive's own motion; None: nothing.
        mount: also run the mount estimator.
    """

    kind: str
    world: str
    seed: int
    shock: Shock | None = None
    mount: bool = False


RENDERED = {
    "rendered-highway": Rendered("rendered: highway", "highway", 11),
    "rendered-city": Rendered("rendered: city", "city", 12),
    "rendered-night": Rendered("rendered: night", "night", 13),
    "rendered-drop": Rendered("rendered: drop", "highway", 14, FALL),
    "rendered-knock": Rendered("rendered: knock", "highway", 16, KNOCKED),
}
"""By name, which is also that of the files."""


class ShockedDrive(Drive):
    """A drive with a shock in addition to its own motion; None is no shock."""

    shock: Shock | None = None

    def extrinsics_at(self, time: float) -> Extrinsics:
        """Return the true pose over the road at a time, each (1,)."""
        pose = super().extrinsics_at(time)
        if self.shock is None:
            return pose
        return Extrinsics(*(value + more for value, more in zip(pose, self.shock.pose(time), strict=True)))


def detected_vertices(rendered: Rendered) -> dict[str, Any]:
    """Render a drive and run the shipped network on it: the content of the drive's file."""
    drive = ShockedDrive(rendered.seed, SIZE, FRAMES, FPS, kind=rendered.world)
    drive.shock = rendered.shock
    model = LaneBEV.from_pretrained()
    seen, poses, width = [], [], 0.0
    with torch.inference_mode():
        for first in range(0, FRAMES, _TOGETHER):
            frames = drive.frames(range(first, min(first + _TOGETHER, FRAMES)))
            seen.append(model.boundary_vertices(frames.image)[1])
            poses.append(frames.extrinsics.stack().double())
            width = width or float(frames.lane_width[0, frames.lane_width.shape[1] // 2])
    vertices = join_tensors(torch.cat, seen)
    return {
        "points": (vertices.points.clamp(0, 1023) * _PIXEL).round().numpy().astype(np.uint16),
        "weight": (vertices.weight * 255).round().numpy().astype(np.uint8),
        "sigma": vertices.sigma.numpy().astype(np.float16),
        "boundary": vertices.boundary.numpy().astype(np.uint8),
        "intrinsics": drive.camera.intrinsics.double().numpy(),
        "truth": torch.cat(poses).numpy(),
        "lane_width": np.float64(width),
        "sigma_scale": np.float64(model.pose_sigma_scale),
    }


def load(name: str) -> Recording:
    """Read a rendered drive's file."""
    rendered = RENDERED[name]
    with np.load(DRIVES / f"{name}.npz") as file:
        held = {key: torch.from_numpy(file[key].astype(np.float64)) for key in file.files}
    camera = Camera(held["intrinsics"], torch.zeros(0, dtype=torch.float64), "pinhole", SIZE)
    vertices = BoundaryVertices(
        held["points"] / _PIXEL, held["weight"] / 255, held["sigma"], held["boundary"].long()
    )
    times, shock = torch.arange(FRAMES) / FPS, rendered.shock
    return Recording(
        segments=camera_segments(vertices, camera),
        intrinsics=camera.intrinsics,
        dt=torch.full((FRAMES,), 1 / FPS, dtype=torch.float64),
        lane_width=float(held["lane_width"]),
        sigma_scale=float(held["sigma_scale"]),
        truth=held["truth"],
        hard=torch.zeros(FRAMES, dtype=torch.bool) if shock is None else shock.during(times),
        mount=rendered.mount,
    )


@one_line_errors()
def main(arguments: list[str] | None = None) -> int:
    parser = command_parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="drives to render (default: all)")
    args = parser.parse_args(arguments)
    unknown = sorted(set(args.names) - set(RENDERED))
    if unknown:
        raise ValueError(f"name: expected some of {', '.join(RENDERED)}, got {', '.join(unknown)}")
    DRIVES.mkdir(parents=True, exist_ok=True)
    for name in args.names or RENDERED:
        np.savez_compressed(DRIVES / f"{name}.npz", **detected_vertices(RENDERED[name]))
        print(f"wrote {name}.npz, {(DRIVES / f'{name}.npz').stat().st_size / 1024:.0f} KiB", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
