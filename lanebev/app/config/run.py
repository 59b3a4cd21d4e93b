"""Settings of a run and their defaults. Imports nothing heavy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

from lanebev.app.config.options import check_grid, check_types, option, parse_grid, parse_rate
from lanebev.estimation.lane_width_prior import (
    LANE_WIDTH,
    LANE_WIDTH_STD,
    check_lane_width_prior,
    lane_width_prior,
)
from lanebev.io.formats.names import FORMATS, check_formats, parse_formats
from lanebev.io.source_names import is_bag
from lanebev.numbers import parse_crop, parse_size

CALIBRATORS = ("joint", "two-stage")
BACKENDS = ("torch", "onnxruntime")
PRECISIONS = ("float32", "bfloat16", "float16")
FOV_FOCAL_STD = 0.2
"""Standard deviation of a guessed focal length as a fraction of it: 60 degrees of view may be 40 or 90."""


def rate_as_fraction(fps: float | None) -> Fraction | None:
    """Return a frame rate (Hz) as a fraction, None for none."""
    return None if fps is None else Fraction(fps).limit_denominator(1000)


class NetworkSettings(NamedTuple):
    """Arguments of :func:`lanebev.app.drive.build.make_network`."""

    weights: str | None
    device: str
    precision: str
    width: int | None


@dataclass(frozen=True)
class RunConfig:
    """Settings of a run. Every field is an option of ``lanebev run``; its help text says what it means.

    In Python, ``lanes_size`` is (height, width) px, ``lanes_crop`` (top, left, height, width) px and ``grid``
    (near, far, left, right, resolution) m. None stands for the default that the help text names: see
    :attr:`relative_focal_std` and :attr:`taken_lane_width`; ``lanes_size`` is then the size of
    ``lanes_crop``, or else of the source.

    Raises:
        TypeError: a value of another type.
        ValueError: a value out of range, or settings that exclude each other.
    """

    source: str = option(
        "",
        "a video, a folder of images, a quoted glob ('DIR/**/*.jpg'), one image, an MCAP file or ROS bag, "
        "a camera (/dev/video0), a stream (rtsp://, http://), or - for a pipe",
        "SOURCE",
    )
    camera: str = option(
        "",
        "camera file of OpenCV, ROS, Kalibr, EuRoC, KITTI or nuScenes, or YAML with fx fy cx cy width height "
        "(FILE#NAME: one of several cameras)",
        "FILE",
    )
    out: str = option("lanebev-out", "output folder (default {})", "DIR")
    lane_width: float | None = option(
        None,
        f"lane width, metres (default {LANE_WIDTH:g}, with a standard deviation of {LANE_WIDTH_STD:g})",
        "M",
        float,
    )
    lanes: str | None = option(
        None,
        "lanes of another detector or a person instead of the network's: JSON of TuSimple, OpenLane, LabelMe "
        "and others, .lines.txt of CULane, a folder of them, or CVAT's XML",
        "FILE",
    )
    stills: bool = option(False, "treat every image as independent, not as a frame of a drive")
    resume: str | None = option(
        None, "continue from the state that a run with the same calibrator saved in this folder", "DIR"
    )
    calibrator: str = option(
        "joint", "calibrator; two-stage is the paper's method (default {})", choices=CALIBRATORS
    )
    fps: float | None = option(
        None,
        "frame rate of a folder, a glob or a raw stream (default: from times in the names of images or in a "
        "file beside them, else 30)",
        "HZ",
        parse_rate,
    )
    lanes_size: tuple[int, int] | None = option(
        None, "size of the images that --lanes was drawn on, if not the source's", "WxH", parse_size
    )
    lanes_crop: tuple[int, int, int, int] | None = option(
        None,
        "part of the source's images that --lanes was drawn on, such as 1280x480+0+240; if that part was "
        "then resized, --lanes-size is its size",
        "WxH+LEFT+TOP",
        parse_crop,
    )
    fov: float | None = option(
        None,
        "horizontal field of view, degrees, if there is no camera file for --camera",
        "DEG",
        float,
    )
    focal_std: float | None = option(
        None,
        "standard deviation of the focal length as a fraction of it (default 0 with --camera, "
        f"{FOV_FOCAL_STD} with --fov)",
        "REL",
        float,
    )
    lane_width_std: float | None = option(
        None,
        "standard deviation of the lane width, metres (default 0 with --lane-width, "
        f"{LANE_WIDTH_STD:g} without)",
        "M",
        float,
    )
    mount: str | None = option(
        None, "calibration.yaml of an earlier run, whose pose is the prior of the first frame", "FILE"
    )
    rectified: bool = option(False, "the images were rectified: use the projection matrix P")
    weights: str | None = option(None, "weights of the network instead of the shipped ones", "FILE")
    device: str = option("cpu", "device of the network: cpu, cuda, cuda:1, mps (default {})", "NAME")
    precision: str = option(
        "float32",
        "number format of the network's convolutions (default {}); bfloat16 takes about half the time on "
        "processors and GPUs that have it",
        choices=PRECISIONS,
    )
    network_width: int | None = option(
        None,
        "width of the network's input, pixels (default: 576 with the shipped weights, more for wide images); "
        "the time grows with its square",
        "PX",
        int,
    )
    backend: str = option(
        "torch", "library that computes network and calibrator (default {})", choices=BACKENDS
    )
    exported: str = option(
        "lanebev-export", "output folder of lanebev export, for onnxruntime (default {})", "DIR"
    )
    formats: tuple[str, ...] = option(
        (), f"write the results in these formats too: {', '.join(FORMATS)}", "NAME,NAME", parse_formats
    )
    start: float = option(0.0, "begin at this time of the source, seconds (default {})", "S", float)
    end: float | None = option(None, "end at this time of the source, seconds (default: its end)", "S", float)
    every: int = option(1, "take every Nth frame of the source (default {})", "N", int)
    no_video: bool = option(False, "write no bev.mp4 and overlay.mp4")
    grid: tuple[float, float, float, float, float] = option(
        (3.0, 60.0, -10.0, 10.0, 0.05),
        "range of the bird's-eye view, default 3:60,-10:10/0.05: metres ahead, metres to the right, "
        "metres per pixel",
        "NEAR:FAR,LEFT:RIGHT/STEP",
        parse_grid,
    )
    rerun: str | None = option(
        None,
        "show the run in Rerun as it proceeds: viewer opens a viewer, URL is the address of an open one",
        "viewer|URL",
    )
    topic: str | None = option(None, "topic of the images in a bag with several", "NAME")
    keep_all: bool = option(False, "drop no frame of a stream: it waits, and its own times are used")
    smooth: bool = option(False, "estimate every pose from all frames of the drive, later ones too")
    far_view: bool = option(
        False, "also show the network the far road at a larger scale; frames are processed one at a time"
    )
    speed: str | None = option(
        None,
        "speeds of the vehicle, m/s: a text file with one for each frame, or CSV with the columns time "
        "(seconds since the first frame) and speed",
        "FILE",
    )
    speed_topic: str | None = option(
        None, "topic of a bag with the vehicle's speed: Odometry, Twist, VelocityReport or GPSFix", "NAME"
    )
    hilly: bool = option(False, "expect crests and dips everywhere (default: at the start and where evident)")

    @property
    def network(self) -> NetworkSettings:
        """The settings on which the network depends; runs that have the same can share it."""
        return NetworkSettings(self.weights, self.device, self.precision, self.network_width)

    @property
    def relative_focal_std(self) -> float:
        """Standard deviation of the focal length as a fraction of it, with the default applied."""
        if self.focal_std is not None:
            return self.focal_std
        return 0.0 if self.fov is None else FOV_FOCAL_STD

    @property
    def taken_lane_width(self) -> tuple[float, float]:
        """Lane width and its standard deviation, m, with the defaults applied."""
        return lane_width_prior(self.lane_width, self.lane_width_std)

    @property
    def frame_rate(self) -> Fraction | None:
        """``fps`` as a fraction."""
        return rate_as_fraction(self.fps)

    def __post_init__(self) -> None:
        check_types(self)
        check_grid(self.grid)
        check_formats(self.formats)
        if not self.source:
            raise ValueError("source: expected a path, got none")
        self._check_lens()
        self._check_selection()
        check_lane_width_prior(*self.taken_lane_width, ("lane width", "lane width std"))
        if self.fps is not None and not (math.isfinite(self.fps) and 0.01 <= self.fps <= 10_000):
            raise ValueError(f"fps: expected 0.01 to 10000 frames per second, got {self.fps:g}")
        self._check_calibrator()
        self._check_backend()
        if self.smooth and self.stills:
            raise ValueError("smooth: expected a drive, got --stills")
        if self.speed and self.speed_topic:
            raise ValueError("speed: expected a file or a topic, got both; leave one of them out")
        if self.stills and (self.speed or self.speed_topic):
            raise ValueError("speed: expected a drive, got --stills")
        if self.stills and self.resume:
            raise ValueError("resume: expected a drive, got --stills; images on their own have no state")
        self._check_lanes()

    def _check_lanes(self) -> None:
        sizes = {"lanes size": (self.lanes_size, (1, 1)), "lanes crop": (self.lanes_crop, (0, 0, 1, 1))}
        for name, (value, least) in sizes.items():
            if value is None:
                continue
            whole = len(value) == len(least) and all(type(each) is int for each in value)
            if not (whole and all(each >= low for each, low in zip(value, least, strict=True))):
                sides = ", ".join(("top", "left", "height", "width")[-len(least) :])
                raise ValueError(f"{name}: expected whole px of an image, ({sides}), got {value}")
            if not self.lanes:
                raise ValueError(f"{name}: expected --lanes too, got none")
        given = next((name for name in ("weights", "far_view") if getattr(self, name)), None)
        if self.lanes and given:
            raise ValueError(
                f"{given.replace('_', ' ')}: expected lanes of the network, got --lanes too; leave one of "
                "them out"
            )

    def _check_selection(self) -> None:
        if not (math.isfinite(self.start) and self.start >= 0):
            raise ValueError(f"start: expected 0 s or later, got {self.start:g}")
        if self.end is not None and not self.end > self.start:
            raise ValueError(f"end: expected a time after --start {self.start:g}, got {self.end:g}")
        if self.every < 1:
            raise ValueError(f"every: expected 1 or more, got {self.every}")

    def _check_calibrator(self) -> None:
        if self.calibrator not in CALIBRATORS:
            raise ValueError(f"calibrator: expected {' or '.join(CALIBRATORS)}, got {self.calibrator!r}")
        for name in ("mount", "hilly", "smooth"):
            if getattr(self, name) and self.calibrator != "joint":
                raise ValueError(f"{name}: expected --calibrator joint, got {self.calibrator}")

    def _check_backend(self) -> None:
        if self.backend not in BACKENDS:
            raise ValueError(f"backend: expected {' or '.join(BACKENDS)}, got {self.backend!r}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, got {self.precision!r}")
        if self.network_width is not None and not 64 <= self.network_width <= 4096:
            raise ValueError(f"network width: expected 64 to 4096 px, got {self.network_width}")
        torch_only = ("mount", "hilly", "weights", "network_width")
        given = next((name for name in torch_only if getattr(self, name)), None)
        given = given or ("device" if self.device != "cpu" else None)
        given = given or ("precision" if self.precision != "float32" else None)
        if self.backend != "torch" and given:
            raise ValueError(
                f"{given.replace('_', ' ')}: expected --backend torch, got {self.backend}; an "
                "exported calibrator and network have their own settings, and run on the CPU"
            )

    def _check_lens(self) -> None:
        if not self.camera and self.fov is None and not is_bag(self.source):
            raise ValueError("camera: expected --camera FILE, or --fov DEG if no file is at hand, got none")
        if self.camera and self.fov is not None:
            raise ValueError("fov: expected --camera or --fov, got both; leave one of them out")
        if self.fov is not None and not 10.0 <= self.fov <= 179.0:
            raise ValueError(
                f"fov: expected a horizontal field of view of 10 to 179 degrees, got {self.fov:g}"
            )
        if not 0.0 <= self.relative_focal_std < 1.0:
            raise ValueError(
                f"focal std: expected a share of the focal length from 0 to 1, as 0.05, "
                f"got {self.focal_std:g}"
            )
        if self.rectified and self.fov is not None:
            raise ValueError("rectified: expected a camera file with a projection matrix, got --fov")
