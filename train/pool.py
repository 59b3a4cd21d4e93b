"""Rendered frames on disk: ``python -m train.pool OUT --shards 10 --seed 1`` renders, training reads.

A shard is one ``.npz`` of frames: JPEG bytes, boundaries in pixels as taken, and the exact pose. Rendering
costs about as much as training on a view, and several views can be drawn from each frame.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from jsonargparse.typing import PositiveInt

from lanebev.geometry.vanishing_point import vanishing_point
from lanebev.observation.frames import image_bytes
from lanebev.render import RenderedFrame, render_views
from train.archives import decode_jpeg, encode_jpegs, read_arrays, write_arrays
from train.commands import command_parser, one_line_errors
from train.labels import LabelledImage
from train.maps import boundaries_as_taken


class Pose(NamedTuple):
    """True pose of the camera over the road. A shard has N.

    Attributes:
        extrinsics: (4,) pitch, yaw, roll in rad, height in m.
        intrinsics: (3, 3) px as taken.
        distortion: (5,) Brown-Conrady.
        lane_width: (L - 1,) m.
    """

    extrinsics: npt.NDArray[np.float32]
    intrinsics: npt.NDArray[np.float32]
    distortion: npt.NDArray[np.float32]
    lane_width: npt.NDArray[np.float32]


class Shard(NamedTuple):
    """Frames of one file, images still compressed.

    Attributes:
        jpeg: (bytes,) uint8, all images one after the other.
        ends: (N,) int64, where each image's bytes end.
        points: (N, L, P, 2) px as taken.
        painted: (N, L, P) bool.
        visible: (N, L, P) bool.
        vanishing_point: (N, 2) px as taken.
        poses: poses of the N frames.
    """

    jpeg: npt.NDArray[np.uint8]
    ends: npt.NDArray[np.int64]
    points: npt.NDArray[np.float32]
    painted: npt.NDArray[np.bool_]
    visible: npt.NDArray[np.bool_]
    vanishing_point: npt.NDArray[np.float32]
    poses: Pose

    def __len__(self) -> int:
        return len(self.ends)

    def frame(self, index: int) -> LabelledImage:
        """Decode one frame."""
        return LabelledImage(
            decode_jpeg(self.jpeg, self.ends, index),
            self.points[index],
            self.painted[index],
            self.visible[index],
            self.vanishing_point[index],
        )

    def pose(self, index: int) -> Pose:
        """Return the pose of one frame."""
        return Pose(*(field[index] for field in self.poses))


def labelled_images(frame: RenderedFrame) -> Iterator[LabelledImage]:
    """Return the rows of a rendered batch, with boundaries as the lens shows them."""
    pitch, yaw, _, _ = frame.extrinsics
    vanishing = vanishing_point(pitch, yaw, frame.intrinsics, frame.distortion)
    points, images = boundaries_as_taken(frame), image_bytes(frame.image)
    for row, image in enumerate(images):
        yield LabelledImage(
            image,
            points[row].float().numpy(),
            (frame.painted[row] > 0.5).numpy(),
            (frame.visible[row] > 0.5).numpy(),
            vanishing[row].float().numpy(),
        )


def camera_poses(frames: list[RenderedFrame]) -> Pose:
    """Return the poses of rendered batches, one after the other."""
    parts = [(f.extrinsics.stack(), f.intrinsics, f.distortion, f.lane_width) for f in frames]
    return Pose(*(torch.cat(field).float().numpy() for field in zip(*parts, strict=True)))


def write_shard(path: Path, frames: list[RenderedFrame]) -> None:
    """Write rendered batches as one shard, whole or not at all."""
    samples = [sample for frame in frames for sample in labelled_images(frame)]
    jpeg, ends = encode_jpegs(sample.image for sample in samples)
    own = ("points", "painted", "visible", "vanishing_point")
    fields = {name: np.stack([getattr(sample, name) for sample in samples]) for name in own}
    write_arrays(path, {"jpeg": jpeg, "ends": ends, **fields, **camera_poses(frames)._asdict()})


def read_shard(path: Path) -> Shard:
    """Read one shard."""
    own = Shard._fields[:-1]
    arrays = read_arrays(path, (*own, *Pose._fields), "a pool shard")
    jpeg, ends, points, painted, visible, vanishing = arrays[: len(own)]
    return Shard(jpeg, ends, points, painted, visible, vanishing, Pose(*arrays[len(own) :]))


def shard_size(path: Path) -> int:
    """Return the number of a shard's frames, without reading them."""
    return len(read_arrays(path, ("ends",), "a pool shard")[0])


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--shards", type=PositiveInt, default=10)
    parser.add_argument("--frames", type=PositiveInt, default=64, help="frames per shard")
    parser.add_argument("--batch", type=PositiveInt, default=8, help="frames rendered together")
    parser.add_argument("--size", type=int, nargs=2, default=(360, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--prefix", default="shard")
    args = parser.parse_args()
    if args.frames % args.batch:
        parser.error(f"--frames: expected a multiple of --batch {args.batch}, got {args.frames}")
    args.out.mkdir(parents=True, exist_ok=True)
    for index in range(args.shards):
        path = args.out / f"{args.prefix}-{args.seed}-{index:05d}.npz"
        if path.exists():
            continue
        generator = torch.Generator().manual_seed(args.seed * 1_000_003 + index)
        start = time.perf_counter()
        frames = [
            render_views(args.batch, tuple(args.size), generator) for _ in range(args.frames // args.batch)
        ]
        write_shard(path, frames)
        seconds = (time.perf_counter() - start) / args.frames
        print(f"{path}: {args.frames} frames, {1e3 * seconds:.0f} ms each", flush=True)


if __name__ == "__main__":
    main()
