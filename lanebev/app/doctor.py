"""``lanebev doctor``: check if a camera fits a source, and if a run on it can be trusted."""

import math
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import islice
from typing import NamedTuple

import numpy as np
import torch

from lanebev.app.config import RunConfig
from lanebev.app.drive.build import make_observer, make_tracker
from lanebev.app.drive.sources import camera_of, make_source
from lanebev.app.drive.upside_down import upside_down_remark
from lanebev.app.progress import Progress, no_progress
from lanebev.app.recording.plausibility import pose_remark, pose_words
from lanebev.camera.model import Camera
from lanebev.camera.plausibility import (
    field_of_view,
    lens_remark,
    model_remark,
    pixel_remark,
    resized_remark,
    view_remark,
)
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import Selection
from lanebev.io.source_names import without_login
from lanebev.types import Status

OK, DOUBT, WRONG = 0, 1, 2
_WORDS = ("ok", "doubt", "wrong")
_SAMPLED = 40  # frames
_SECONDS = 120.0  # s; frames are taken from so much of a source
_OFF_CENTRE = 0.1  # distance of the principal point from the centre, as a fraction of the image's sides
_GAP = 3.0  # times the median interval
_LEAST_VERTICES = 4  # a boundary with fewer is not seen
_SHARE_SEEN = 0.5  # fraction of frames in which two boundaries must be seen


class Finding(NamedTuple):
    """The result of one check.

    Attributes:
        level: OK, DOUBT or WRONG.
        words: what was found, and what to do.
    """

    level: int
    words: str


@dataclass
class Sample:
    """Some frames of a source and the lanes found in them.

    Attributes:
        undecoded: number of frames that did not decode.
        steps: s between frames, each by the nominal one.
        boundaries: number of boundaries seen, a frame each.
        poses: pitch, yaw, roll (degrees) and height (m) of the frames that were tracked.
        remark: what else may be wrong with the images; else empty.
    """

    undecoded: int = 0
    steps: list[float] = field(default_factory=list)
    boundaries: list[int] = field(default_factory=list)
    poses: list[list[float]] = field(default_factory=list)
    remark: str = ""


def doctor(config: RunConfig, progress: Progress = no_progress) -> tuple[str, int]:
    """Check a source and its camera.

    Returns:
        the text to print, and 0 if all checks passed, 1 if something is doubtful, 2 if the camera does not
        fit.
    """
    source = make_source(config)
    camera = camera_of(config, source)
    findings = [check_size(camera, source.image_size)]
    findings += [Finding(DOUBT, f"camera: {camera.remark}")] if camera.remark else []
    findings += [Finding(DOUBT, f"source: {source.problem}")] if source.problem else []
    if findings[0].level != WRONG:
        findings += [check_field_of_view(camera), check_centre(camera), check_lens(camera)]
        findings.append(check_pixels(camera, source.pixel_aspect))
        sample = sample_frames(config, source, camera, progress)
        findings += [check_times(sample), check_lanes(sample), check_pose(sample)]
    level = max(finding.level for finding in findings)
    lines = [f"{_WORDS[finding.level]:<6} {finding.words}" for finding in findings]
    verdict = (
        "all checks passed",
        "a run is possible, but check what is doubtful",
        "a run would refuse this camera or give wrong results",
    )[level]
    return "\n".join([*lines, f"{without_login(config.source)}: {verdict}"]), level


def sample_frames(config: RunConfig, source: FrameSource, camera: Camera, progress: Progress) -> Sample:
    """Run the network on some single frames: the first ones of a stream, else evenly spread ones."""
    count = _SAMPLED if source.is_live else min(source.count, round(_SECONDS * float(source.fps)))
    every = 1 if source.is_live else max(1, count // _SAMPLED)
    if not source.is_live:
        source = replace(source, selection=Selection(0.0, _SECONDS, every))
    observer, tracker = make_observer(config, source, camera), make_tracker(config, camera)
    sample, nominal = Sample(), every / float(source.fps)
    frames = islice(source, _SAMPLED + 1)
    with torch.inference_mode():
        for frame in progress(frames, min(count, _SAMPLED)):
            sample.undecoded += frame.image is None
            if frame.number:
                sample.steps.append(frame.dt / nominal)
            vertices = observer(frame).vertices
            seen = (vertices.weight[0] > 0).sum(-1) >= _LEAST_VERTICES
            sample.boundaries.append(len(set(vertices.boundary[0][seen].tolist())))
            pose = tracker.still(vertices, 1.0).calibration
            if int(pose.status[0]) == Status.TRACKING:
                values = pose.extrinsics.stack()[0].tolist()
                sample.poses.append([*map(math.degrees, values[:3]), values[3]])
    sample.remark = upside_down_remark(observer, tracker, source, len(sample.poses), len(sample.boundaries))
    return sample


def check_size(camera: Camera, image_size: tuple[int, int]) -> Finding:
    """Compare the camera's image size with the source's, (height, width) px."""
    (height, width), (rows, columns) = camera.image_size, image_size
    if camera.image_size == image_size:
        return Finding(OK, f"size: {columns} x {rows} px, as in the camera file")
    got = f"size: the images are {columns} x {rows} px, the camera is for {width} x {height}"
    if abs(columns * height - rows * width) <= max(width, height):
        remedy = f"the same shape: give Camera.scaled(({rows}, {columns})) if the images were resized"
    else:
        remedy = "another shape: the images were cropped or come from another camera"
    return Finding(WRONG, f"{got}; {remedy}")


def check_field_of_view(camera: Camera) -> Finding:
    """Check the focal length by the field of view that it gives the images."""
    words = f"focal length: {float(camera.intrinsics[0, 0]):.0f} px"
    if remark := view_remark(camera):
        return Finding(DOUBT, f"{words}, {remark}")
    angle = field_of_view(camera)  # 180 where the lens has no rays at the edge, see check_lens
    return Finding(OK, f"{words}, {angle:.0f} degrees of view across" if angle < 180.0 else words)


def check_centre(camera: Camera) -> Finding:
    """Check the principal point by its distance from the image's centre."""
    height, width = camera.image_size
    right = float(camera.intrinsics[0, 2]) - 0.5 * (width - 1)
    down = float(camera.intrinsics[1, 2]) - 0.5 * (height - 1)
    words = f"principal point: {right:+.0f} px right of the centre, {down:+.0f} px below it"
    if abs(right) <= _OFF_CENTRE * width and abs(down) <= _OFF_CENTRE * height:
        return Finding(OK, words)
    return Finding(DOUBT, resized_remark(camera) or f"{words}: plausible only if the images were cropped")


def check_lens(camera: Camera) -> Finding:
    """Check if the lens images all pixels, and if its coefficients are like those of the lens model."""
    count, remark = len(camera.distortion), model_remark(camera) or lens_remark(camera)
    words = f"lens: {camera.model}, {count} distortion coefficients"
    return Finding(DOUBT, f"{words}: {remark}") if remark else Finding(OK, words)


def check_pixels(camera: Camera, pixel_aspect: Fraction) -> Finding:
    """Compare the focal lengths with the width of the video's pixels over their height."""
    if remark := pixel_remark(camera, pixel_aspect):
        return Finding(DOUBT, f"pixels: {remark}")
    shape = "square" if pixel_aspect == 1 else f"{float(pixel_aspect):.4g} times as wide as high"
    return Finding(OK, f"pixels: {shape}, as the focal lengths say")


def check_times(sample: Sample) -> Finding:
    """Check if time stamps advance evenly and frames decode."""
    if sample.undecoded:
        words = f"frames: {sample.undecoded} of {len(sample.boundaries)} do not decode"
        return Finding(DOUBT, words)
    longest = max(sample.steps, default=1.0)
    median = float(np.median(sample.steps)) if sample.steps else 1.0
    if longest > _GAP * median:
        return Finding(DOUBT, f"times: a gap of {longest / median:.0f} times the median interval")
    if not 0.8 < median < 1.25:
        return Finding(
            DOUBT, f"times: the frame interval is {median:.2f} times that of the stated frame rate"
        )
    return Finding(OK, "times: frames are evenly spaced and decode")


def check_lanes(sample: Sample) -> Finding:
    """Check in how many frames two boundaries or more are found."""
    share = float(np.mean([number >= 2 for number in sample.boundaries])) if sample.boundaries else 0.0
    words = f"lanes: two boundaries or more in {share:.0%} of {len(sample.boundaries)} frames"
    if share >= _SHARE_SEEN:
        return Finding(OK, words)
    return Finding(DOUBT, f"{words}: is there a marked road, and does the camera look at it?")


def check_pose(sample: Sample) -> Finding:
    """Check if the median pose of the frames is plausible for a camera in a car.

    A wrong focal length changes pitch and yaw, and hardly anything else: lanes alone do not show it, unless
    the pose becomes implausible.
    """
    if sample.remark:
        return Finding(DOUBT, sample.remark)
    if not sample.poses:
        return Finding(DOUBT, "pose: none, since lanes were not found well enough in any frame")
    pose = np.median(sample.poses, axis=0).tolist()
    if remark := pose_remark(pose):
        return Finding(DOUBT, remark)
    return Finding(OK, f"pose: {', '.join(pose_words(pose))}; lanes do not determine the focal length")
