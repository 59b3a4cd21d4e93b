"""Build the parts of a run from its settings."""

from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.utils import convert_conv2d_weight_memory_format

from lanebev.app.config import RunConfig
from lanebev.app.drive.observers import (
    FarViewObserver,
    LaneFileObserver,
    NetworkObserver,
    Observer,
    RunTracker,
)
from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.camera.choice import camera_file
from lanebev.camera.model import Camera
from lanebev.estimation.calibrator import Calibrator, StateT
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import HILLY_ROADS, JointConfig
from lanebev.estimation.joint.frame_prior import prior_of_mount
from lanebev.estimation.tracker import Tracker
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.export.runtime import onnx_calibrator, onnx_model
from lanebev.io.calibration_file import read_mount
from lanebev.io.frame_source import FrameSource
from lanebev.io.images.pixels import image_size
from lanebev.io.lanes import lane_files, read_lanes
from lanebev.io.lanes.size import lanes_of_whole_images
from lanebev.pipeline import LaneBEV
from lanebev.tensors import usable_device
from lanebev.view.grid import BEVGrid

_LOOKED_AT = 20  # images of a folder, for one of the camera's size


def make_camera(
    config: RunConfig, image_size: tuple[int, int], pixel_aspect: Fraction = Fraction(1)
) -> Camera:
    """Read the camera file, or make an ideal camera of the field of view and the source's images.

    Args:
        config: the settings.
        image_size: (height, width) px of the source's images.
        pixel_aspect: width over height of their pixels, of which a camera file's focal lengths know.
    """
    if config.fov is not None:
        height, width = image_size
        ideal = Camera.from_fov(config.fov, width, height)
        (fx, _, cx), (_, fy, cy), _ = ideal.intrinsics.tolist()
        return Camera.from_parameters(fx, fy * float(pixel_aspect), cx, cy, width, height)
    return Camera.from_file(config.camera, image_size, config.rectified)


def make_grid(config: RunConfig) -> BEVGrid:
    """Make the grid of the bird's-eye view."""
    near, far, left, right, resolution = config.grid
    return BEVGrid((left, right), (near, far), resolution)


def make_calibrator(name: str) -> JointCalibrator | TwoStageCalibrator:
    """Make the calibrator of this name, one of CALIBRATORS, with default settings."""
    return TwoStageCalibrator() if name == "two-stage" else JointCalibrator()


def make_tracker(config: RunConfig, camera: Camera) -> RunTracker:
    """Make the tracker with the calibrator, the prior and the standard deviations of the settings."""
    if config.calibrator == "two-stage":
        return _tracker(TwoStageCalibrator(), config, camera)
    return _tracker(JointCalibrator(joint_config(config)), config, camera)


def joint_config(config: RunConfig) -> JointConfig:
    """Return the joint calibrator's configuration, with the prior and the roads of the settings."""
    roads = HILLY_ROADS if config.hilly else JointConfig()
    if config.mount is None:
        return roads
    mount = read_mount(config.mount)
    return replace(roads, prior=prior_of_mount(mount.pose.tolist(), mount.std.tolist()))


def _tracker(calibrator: Calibrator[StateT], config: RunConfig, camera: Camera) -> Tracker[StateT]:
    """Make the tracker of a calibrator, or of its export."""
    if config.backend == "onnxruntime":
        calibrator = onnx_calibrator(Path(config.exported), config.calibrator, calibrator)
    lane_width, lane_width_std = config.taken_lane_width
    return Tracker(calibrator, camera, lane_width, config.relative_focal_std, lane_width_std)


def needs_network(config: RunConfig) -> bool:
    """Return whether a run uses the network in PyTorch."""
    return config.lanes is None and config.backend == "torch"


def make_network(
    weights: str | None, device: str, precision: str = "float32", width: int | None = None
) -> LaneBEV:
    """Load a network, the shipped one without ``weights``, on a device.

    Args:
        weights: file, or None.
        device: name of the device.
        precision: number format of the convolutions, one of PRECISIONS; the rest stays in single precision.
        width: of the network's input, px; None is that of the weights.

    Raises:
        ValueError: weights that do not fit the network, or a device that is not there or lacks the format.
    """
    found = usable_device(device)
    model = LaneBEV.from_pretrained(weights, network_width=width).to(found)
    return with_precision(model, precision)


def with_precision(model: LaneBEV, precision: str) -> LaneBEV:
    """Let a model's network compute its convolutions in a number format, one of PRECISIONS, and return it.

    For inference only.
    """
    if precision == "float32":
        return model
    device, forward = next(model.parameters()).device.type, model.segmenter.forward
    lower = partial(torch.autocast, device, getattr(torch, precision))
    try:
        lower()
    except RuntimeError as error:
        raise ValueError(f"precision: expected one that {device} has, got {precision}: {error}") from error

    def in_precision(image: Tensor) -> Tensor:
        with lower():  # one for each call: several threads call it
            logits: Tensor = forward(image)
        return logits.contiguous()

    # in this order convolutions take less time; on the CPU, gradients of some crash in it (torch 2.13)
    convert_conv2d_weight_memory_format(model, torch.channels_last)
    model.segmenter.forward = in_precision
    return model


def make_observer(
    config: RunConfig,
    source: FrameSource,
    camera: Camera,
    network: SharedNetwork | None = None,
    tracker: RunTracker | None = None,
) -> Observer:
    """Make what finds boundaries: by a lane file if one is given, else by the network.

    Args:
        config: the settings.
        source: the frames.
        camera: the lens.
        network: an already loaded network of the settings (:attr:`RunConfig.network`).
        tracker: tracker of the same frames, on whose estimates a far view depends.

    Raises:
        ValueError: lanes that do not fit the source, or see :func:`make_network`.
    """
    if config.lanes is not None:
        entries = read_lanes(config.lanes, camera.intrinsics.double().numpy())
        if config.lanes_size is not None or config.lanes_crop is not None:
            entries = lanes_of_whole_images(entries, config.lanes_size, config.lanes_crop, camera.image_size)
        return LaneFileObserver(entries, source, camera, config.stills)
    if config.backend == "onnxruntime":
        loaded: LaneBEV | SharedNetwork = onnx_model(Path(config.exported), camera, config.far_view)
    else:
        loaded = network or make_network(*config.network)
    if config.far_view and tracker is not None:
        return FarViewObserver(loaded, tracker, camera, config.stills)
    return NetworkObserver(loaded, camera)


def input_files(config: RunConfig, source: FrameSource) -> list[str | Path]:
    """Return the files that a run reads and must not replace."""
    lanes = [] if config.lanes is None else lane_files(config.lanes)
    weights = [] if config.weights is None else [config.weights]
    files: list[str | Path] = [camera_file(config.camera)] if config.camera else []
    files += [each for each in (config.mount, config.speed) if each]
    return [*(source.paths or [source.source]), *files, *lanes, *weights]


def match_image_size(camera: Camera, source: FrameSource) -> FrameSource:
    """Return the source with the camera's image size: that of most of its frames, or of some."""
    if camera.image_size == source.image_size:
        return source
    if any(image_size(path) == camera.image_size for path in source.paths[:_LOOKED_AT]):
        return replace(source, image_size=camera.image_size)
    (height, width), (rows, columns) = camera.image_size, source.image_size
    words = {
        (columns, rows): "; was it calibrated before the images were turned?",
        (rows, columns / 2): "; are the images of two cameras side by side? cut out one",
    }
    raise ValueError(
        f"camera: expected one for the source's {columns} x {rows} px, got one for {width} x {height}; "
        f"give the calibration of these images or resize them{words.get((height, width), '')}"
    )
