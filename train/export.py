"""Convert checkpoints to weights files (``python -m train.export CKPT OUT``), and widen networks.

A weights file, such as one of ``train.average``, may be given too, to change its metadata.
"""

import json
import os
import pickle
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lanebev.observation.segmenter import LaneSegmenter
from lanebev.weights import is_checkpoint, load_segmenter, read_metadata, save_segmenter, segmenter_config
from train.commands import command_parser, one_line_errors
from train.losses import unweighted_bias


def checkpoint_weights(path: Path) -> dict[str, Tensor]:
    """Return the segmenter's weights in a Lightning checkpoint, the averaged ones if there are any."""
    return _read_checkpoint(path)[0]


def _read_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read weights and settings."""
    if path.is_file() and not is_checkpoint(path):
        raise ValueError(
            f"{path}: expected a checkpoint of python -m train, got another file; training begins with a "
            "weights file by --model.init_args.init_from"
        )
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        state, settings = checkpoint["state_dict"], dict(checkpoint["settings"])
        settings["steps"] = checkpoint["global_step"]
        if (seen := checkpoint.get("callbacks", {}).get("Throughput")) is not None:
            settings["views"] = seen["views"]
    except OSError as error:
        raise ValueError(f"{path}: expected a checkpoint, got: {error.strerror}") from error
    except (pickle.UnpicklingError, EOFError, KeyError, TypeError, RuntimeError) as error:
        missing = f"none with {error}" if isinstance(error, KeyError) else ""
        reason = missing or str(error).partition("\n")[0]
        raise ValueError(f"{path}: expected a checkpoint of python -m train, got: {reason}") from error
    prefix = "segmenter."
    weights = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
    if not weights:
        raise ValueError(f"{path}: expected weights named {prefix}*, found none")
    return weights, settings


def load_weights(segmenter: LaneSegmenter, path: Path, class_weight: Tensor) -> None:
    """Load weights to go on training with, widening a trunk of half the width.

    Args:
        segmenter: to load into.
        path: a Lightning checkpoint, or a weights file, into whose last bias the class weights go again.
        class_weight: (1+L,) of the training to come.
    """
    exported = not is_checkpoint(path)
    weights = load_segmenter(path).state_dict() if exported else checkpoint_weights(path)
    if weights["trunk.conv1.weight"].shape[0] * 2 == segmenter.config.base_width:
        weights = widen(weights, segmenter.state_dict())
    try:
        segmenter.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"init_from: {path}: weights do not fit the network: {reason}") from error
    if exported:
        add_to_bias(segmenter, -unweighted_bias(class_weight))


def add_to_bias(segmenter: LaneSegmenter, bias: Tensor) -> None:
    """Add (1+L,) to the logits, in pixel_shuffle's order of channels."""
    head = segmenter.head.bias
    assert head is not None  # the head is built with a bias
    with torch.no_grad():
        head += bias.repeat_interleave(segmenter.shuffle**2)


def widen(narrow: dict[str, Tensor], wide: dict[str, Tensor], noise: float = 0.02) -> dict[str, Tensor]:
    """Return weights of a network whose trunk has twice the channels and which computes the same.

    Source: Chen et al. 2016, Net2Net: every channel twice, incoming weights halved. A little noise makes
    the two copies differ.

    Args:
        narrow: state of the narrow network.
        wide: state of a wide network, for the shapes and the noise.
        noise: relative to each tensor's standard deviation.
    """
    result = {}
    for name, target in wide.items():
        value = narrow[name]
        if value.shape == target.shape:
            result[name] = value.clone()
            continue
        if value.ndim == 4 and value.shape[1] * 2 == target.shape[1]:
            value = torch.cat([value, value], dim=1) / 2
        if value.shape[0] * 2 == target.shape[0]:
            value = torch.cat([value, value], dim=0)
        if value.shape != target.shape:
            raise ValueError(f"{name}: expected twice {tuple(narrow[name].shape)}, got {tuple(target.shape)}")
        if value.ndim == 4:
            generator = torch.Generator().manual_seed(len(result))
            value = value + noise * value.std() * torch.randn(value.shape, generator=generator)
        result[name] = value
    return result


def checkpoint_segmenter(path: Path) -> tuple[LaneSegmenter, dict[str, Any]]:
    """Return a checkpoint's network, class weights undone in the last bias, and its training settings."""
    weights, settings = _read_checkpoint(path)
    try:
        segmenter = LaneSegmenter(segmenter_config(settings["network"]))
        segmenter.load_state_dict(weights, strict=True)
    except (KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path}: expected a network of this version, got: {error}") from error
    if settings["class_weight"] is not None:
        add_to_bias(segmenter, unweighted_bias(torch.tensor(settings["class_weight"])))
    return segmenter, settings


def trained_segmenter(path: Path) -> tuple[LaneSegmenter, dict[str, Any]]:
    """Return the network of a checkpoint or a weights file, for inference, and its training settings."""
    if not is_checkpoint(path):
        return load_segmenter(path), read_metadata(path).get("training", {})
    segmenter, settings = checkpoint_segmenter(path)
    training = {name: value for name, value in settings.items() if name != "network"}
    for name in ("init_from", "backbone"):
        if training.get(name) is not None:
            training[name] = Path(training[name]).name  # without its folder
    return segmenter.eval(), training


def checkout_commit() -> str:
    """Return the commit of the code: ``LANEBEV_COMMIT`` of the environment, else of this checkout."""
    if given := os.environ.get("LANEBEV_COMMIT"):
        return given
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError) as error:
        raise ValueError(
            "commit: expected a git checkout, got none; give --commit or set LANEBEV_COMMIT"
        ) from error


def export(
    checkpoint: Path, out: Path, changes: dict[str, Any], compact: bool = True, **record: Any
) -> LaneSegmenter:
    """Write a checkpoint's averaged weights as lanebev loads them, with the settings they were trained with.

    Args:
        checkpoint: Lightning checkpoint, or a weights file.
        out: the weights file.
        changes: changes of the configuration: ``image_size`` to run at by default, ``sigma_scale`` or
            ``pose_sigma_scale``.
        compact: store the largest convolutions as 8-bit numbers: 14.5 MB instead of 22.8.
        record: further facts for the file's metadata.
    """
    segmenter, training = trained_segmenter(checkpoint)
    segmenter.config = replace(segmenter.config, **changes)
    save_segmenter(segmenter, out, compact=compact, training=training, **record)
    return segmenter


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("checkpoint", type=Path, help="checkpoint or weights file")
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument(
        "--commit", help="commit of the training code (default: LANEBEV_COMMIT, or the checkout's)"
    )
    parser.add_argument(
        "--half", action="store_true", help="store all convolutions as float16, none as 8-bit numbers"
    )
    parser.add_argument("--metrics", default="{}", help="metrics of these weights, as JSON")
    parser.add_argument(
        "--image-size", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"), help="size of the network's input"
    )
    parser.add_argument("--sigma-scale", type=float, help="factor measured by train.noise")
    parser.add_argument("--pose-sigma-scale", type=float, help="factor measured by train.noise")
    parser.add_argument("--note", default="", help="any note")
    args = parser.parse_args()
    try:
        metrics = json.loads(args.metrics)
    except ValueError as error:
        raise ValueError(f"metrics: expected JSON, got {args.metrics!r}: {error}") from error
    given = {
        "image_size": args.image_size and tuple(args.image_size),
        "sigma_scale": args.sigma_scale,
        "pose_sigma_scale": args.pose_sigma_scale,
    }
    changes = {name: value for name, value in given.items() if value is not None}
    commit = args.commit or checkout_commit()
    record = {"seed": args.seed, "commit": commit, "metrics": metrics, "note": args.note}
    export(args.checkpoint, args.out, changes, compact=not args.half, **record)


if __name__ == "__main__":
    main()
