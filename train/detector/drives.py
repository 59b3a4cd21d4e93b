"""Drives with a shaking camera on disk: ``python -m train.detector.drives OUT --drives 160 --seed 1``.

A drive is one ``.npz``: JPEG images, the boxes on the road, the true pose, and the pose and state of the
online calibration on those images. Existing files are not rendered again.
"""

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jsonargparse.typing import PositiveInt
from numpy.typing import NDArray
from torch import Tensor

from lanebev.estimation.joint.state import JointState
from lanebev.observation.frames import image_bytes
from lanebev.pipeline import LaneBEV
from lanebev.render import Drive
from lanebev.render.camera_motion import SmoothNoise
from lanebev.render.scene.sampler import BatchSampler
from lanebev.tensors import join_tensors
from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid
from train.archives import decode_jpeg, encode_jpegs, read_arrays, write_arrays
from train.commands import command_parser, one_line_errors
from train.detector.boxes import in_grid, visible_share

NOMINAL = (math.radians(2.0), 0.0, 0.0, 1.5)
"""Pitch, yaw, roll (rad) and height (m) that the camera is said to have."""

MOUNT_ERROR = math.radians(2.0)
"""Largest error of each angle of a drive's mount."""

SHAKE = (math.radians(1.5), math.radians(0.3), math.radians(1.0), 0.06)
"""Amplitudes of pitch, yaw, roll and height about the mount."""

GRID = BEVGrid(x=(-12.0, 12.0), z=(5.0, 53.0), resolution=1.0)
WARM_UP = 5  # frames of a drive that only the calibration uses
FEWEST = 2  # vehicles in the middle of a drive
VISIBLE = 0.3  # share of a box that counts as seen
_SHAKE_HZ = ((0.15, 2.0), (0.1, 0.8), (0.1, 1.5), (0.2, 2.0))


class ShakingDrive(Drive):
    """A drive with a displaced mount, about which the camera moves as band-limited noise.

    Args:
        seed: seed of everything.
        kwargs: arguments of :class:`~lanebev.render.Drive`.
    """

    def __init__(self, seed: int, **kwargs: Any) -> None:
        super().__init__(seed, mount=Extrinsics.from_values(*NOMINAL), motion=0.0, **kwargs)
        sampler = BatchSampler(1, torch.Generator().manual_seed(seed + 0x5EED))
        self.mount_error = [*sampler.uniform(-MOUNT_ERROR, MOUNT_ERROR, 3)[0].tolist(), 0.0]
        self.shake = [SmoothNoise(sampler, a, *hz) for a, hz in zip(SHAKE, _SHAKE_HZ, strict=True)]

    def extrinsics_at(self, time: float) -> Extrinsics:
        """Return the true pose over the road at a time, each (1,)."""
        moves = (off + noise(time) for off, noise in zip(self.mount_error, self.shake, strict=True))
        return Extrinsics(*(a + b for a, b in zip(super().extrinsics_at(time), moves, strict=True)))


class DriveRecord(NamedTuple):
    """A drive of N frames.

    Attributes:
        jpeg: (bytes,) uint8, all images one after the other.
        ends: (N,) int64, where each image's bytes end.
        boxes: (N, M, 5) of vehicles, see :mod:`train.detector.boxes`.
        seen: (N, M) bool, there and visible.
        extrinsics: (N, 4) true pitch, yaw, roll in rad, height in m.
        online: (N, 4) the same by the online calibration.
        intrinsics: (3, 3) px.
        lane_width: (N, L - 1) m.
        state: state of the calibration before each frame, fields (N, ...) of :class:`JointState`.
    """

    jpeg: NDArray[np.uint8]
    ends: NDArray[np.int64]
    boxes: NDArray[np.float32]
    seen: NDArray[np.bool_]
    extrinsics: NDArray[np.float32]
    online: NDArray[np.float32]
    intrinsics: NDArray[np.float32]
    lane_width: NDArray[np.float32]
    state: JointState

    def images(self) -> NDArray[np.uint8]:
        """Decode, (N, H, W, 3)."""
        return np.stack([decode_jpeg(self.jpeg, self.ends, index) for index in range(len(self.ends))])


def render_drive(seed: int, frames: int, size: tuple[int, int], fps: float, lanes: LaneBEV) -> DriveRecord:
    """Render a drive, and calibrate it online on the images as they are stored.

    Args:
        seed: seed of the drive.
        frames: N.
        size: (H, W).
        fps: frames a second.
        lanes: the calibration.
    """
    drive = ShakingDrive(seed, image_size=size, num_frames=frames, fps=fps)
    taken = [drive.frame(index) for index in range(frames)]
    jpeg, ends = encode_jpegs(image_bytes(frame.image[0]) for frame in taken)
    truth = [
        torch.cat(part)
        for part in zip(
            *((f.boxes, f.box_valid, f.extrinsics.stack(), f.lane_width) for f in taken), strict=True
        )
    ]
    boxes, valid, extrinsics, lane_width = truth
    share = visible_share(boxes, valid, image_bearings(taken[0].intrinsics, extrinsics[:, 1], size[1]))
    record = DriveRecord(
        jpeg=jpeg,
        ends=ends,
        boxes=boxes.numpy(),
        seen=(share >= VISIBLE).numpy(),
        extrinsics=extrinsics.numpy(),
        online=np.zeros((frames, 4), np.float32),
        intrinsics=taken[0].intrinsics[0].numpy(),
        lane_width=lane_width.numpy(),
        state=lanes.initial_state(0),
    )
    online, state = calibrate_online(record, lanes, fps)
    return record._replace(online=online.float().numpy(), state=state)


def image_bearings(intrinsics: Tensor, yaw: Tensor, width: int) -> Tensor:
    """Compute bearings (B, 2) rad on the road of the left and right edge of an undistorted image.

    Args:
        intrinsics: (1, 3, 3) or (B, 3, 3) px.
        yaw: (B,) rad; positive points left.
        width: px of the image.
    """
    edge = intrinsics.new_tensor([-0.5, width - 0.5])
    return ((edge - intrinsics[:, 0, 2:]) / intrinsics[:, 0, :1]).atan() - yaw.unsqueeze(-1)


@torch.inference_mode()
def calibrate_online(record: DriveRecord, lanes: LaneBEV, fps: float) -> tuple[Tensor, JointState]:
    """Follow a drive with the online calibration.

    Returns:
        (N, 4) poses, and the states before each frame, fields (N, ...).
    """
    intrinsics = torch.from_numpy(record.intrinsics)[None].double()
    state, poses, before = lanes.initial_state(1, torch.float64), [], []
    for image, width in zip(record.images(), torch.from_numpy(record.lane_width).double(), strict=True):
        before.append(state)
        frame = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        out, state = lanes(frame, intrinsics, state, 1 / fps, width[None], bev=False)
        poses.append(out.calibration.extrinsics.stack())
    return torch.cat(poses), join_tensors(torch.cat, before)


def has_vehicles(seed: int, frames: int, fps: float) -> bool:
    """Return whether a drive has some vehicles in the grid in its middle."""
    frame = ShakingDrive(seed, image_size=(16, 32), num_frames=frames, fps=fps).frame(frames // 2)
    return int((frame.box_valid & in_grid(frame.boxes, GRID)).sum()) >= FEWEST


def write_drive(path: Path, record: DriveRecord) -> None:
    """Write a drive, whole or not at all."""
    arrays = record._asdict()
    state = {f"state_{name}": part.numpy() for name, part in arrays.pop("state")._asdict().items()}
    write_arrays(path, {**arrays, **state})


def read_drive(path: Path) -> DriveRecord:
    """Read a drive."""
    own, state = DriveRecord._fields[:-1], JointState._fields
    names = (*own, *(f"state_{name}" for name in state))
    arrays = read_arrays(path, names, "a drive that train.detector.drives wrote")
    parts = dict(zip(own, arrays, strict=False))
    return DriveRecord(**parts, state=JointState(*map(torch.from_numpy, arrays[len(own) :])))


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--drives", type=PositiveInt, default=160)
    parser.add_argument("--frames", type=PositiveInt, default=12, help="frames per drive")
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 576), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument(
        "--network-width",
        type=PositiveInt,
        help="width of the lane network's input, px (default: as trained)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the drives")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    lanes = LaneBEV.from_pretrained(network_width=args.network_width).eval()
    number, start = 0, args.seed * 1_000_003
    for seed in range(start, start + 1_000_000):
        if number == args.drives:
            break
        path = args.out / f"{seed}.npz"
        if not path.exists():
            if not has_vehicles(seed, args.frames, args.fps):
                continue
            begun = time.perf_counter()
            write_drive(path, render_drive(seed, args.frames, tuple(args.size), args.fps, lanes))
            print(f"{path}: {time.perf_counter() - begun:.1f} s", flush=True)
        number += 1


if __name__ == "__main__":
    main()
