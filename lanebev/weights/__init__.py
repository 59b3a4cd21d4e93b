"""Load and save weights files, strictly, and the shipped weights.

A weights file is safetensors with JSON metadata: ``config`` (:class:`SegmenterConfig`), and for the record
``training``, ``seed``, ``commit`` and ``metrics``. Tensors may be stored in half precision, or as 8-bit
numbers with a scale per output channel; they are loaded in single precision.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from lanebev.numbers import stand_in
from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.tensors import device_of_numbers

SHIPPED = Path(__file__).with_name("lane_segmenter.safetensors")
_FORMAT = "lanebev.LaneSegmenter/1"
_COMPACT_FORMAT = "lanebev.LaneSegmenter/2"  # some tensors are int8 and have a scale beside them
_SCALE = ".scale"
_ZIP = b"PK\x03\x04"  # with which torch.save's files begin
_LARGE = 2**20  # weights; larger ones are 8-bit numbers in a compact file
_MOST = {"num_boundaries": 64, "base_width": 512, "decoder_width": 512, "context": 16}
_FORMER_NAMES = {"noise_factor": "sigma_scale", "pose_factor": "pose_sigma_scale"}


def load_segmenter(path: str | Path | None = None) -> LaneSegmenter:
    """Load a segmenter with its weights, ready for inference.

    On the default device; on the CPU if that is "meta", since weights without numbers would be lost.

    Args:
        path: a file written by :func:`save_segmenter`; None is the shipped one.

    Raises:
        ValueError: the file is missing, cut, of another format, or does not fit the network it describes.
    """
    path = SHIPPED if path is None else Path(path)
    metadata, tensors = _read(path)
    try:
        config = segmenter_config(json.loads(metadata["config"]))
        with device_of_numbers():
            segmenter = LaneSegmenter(config)
        segmenter.load_state_dict(tensors, strict=True)
        if not all(bool(value.isfinite().all()) for value in tensors.values()):
            raise ValueError("expected finite numbers, got NaN or infinity; was the training unstable?")
    except (LookupError, TypeError, ValueError, RuntimeError, ArithmeticError, AttributeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path}: weights do not fit the network they describe: {reason}") from error
    return segmenter.eval()


def read_metadata(path: str | Path | None = None) -> dict[str, Any]:
    """Read the metadata of a weights file: config, training, seed, commit, metrics."""
    metadata, _ = _read(SHIPPED if path is None else Path(path), tensors=False)
    return {name: json.loads(value) for name, value in metadata.items() if name != "format"}


def is_checkpoint(path: Path) -> bool:
    """Return whether a file is a checkpoint of training, by its ending or by what torch.save begins with."""
    if path.suffix == ".ckpt":
        return True
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(len(_ZIP)) == _ZIP


def save_segmenter(
    segmenter: LaneSegmenter, path: str | Path, half: bool = True, compact: bool = False, **record: Any
) -> None:
    """Write a segmenter's weights.

    Args:
        segmenter: network to save.
        path: path of the file, whose folder is made.
        half: store weights of convolutions as float16; norms and biases stay float32.
        compact: store convolutions of more than 2²⁰ weights as :func:`quantised`.
        record: JSON-able facts for the metadata: training, seed, commit, metrics.

    Raises:
        ValueError: the file cannot be written.
    """
    tensors = {}
    for name, value in segmenter.state_dict().items():
        if compact and value.ndim > 1 and value.numel() > _LARGE:
            tensors[name], tensors[name + _SCALE] = quantised(value)
        else:
            tensors[name] = value.half() if half and value.ndim > 1 else value
    tensors = {name: value.cpu().contiguous() for name, value in tensors.items()}
    facts = {"config": asdict(segmenter.config), **record}
    metadata = {
        "format": _COMPACT_FORMAT if compact else _FORMAT,
        **{name: json.dumps(value) for name, value in facts.items()},
    }
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, str(path), metadata)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: expected a file that can be written: {error}") from error


def quantised(weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Round weights to 8-bit numbers, symmetric, with a scale for each output channel.

    Source: Krishnamoorthi 2018, "Quantizing deep convolutional networks for efficient inference", sect. 2.

    Args:
        weight: (O, ...).

    Returns:
        (O, ...) int8 and (O, 1, ...) float32, whose product is the weight but for half a scale.
    """
    weight = weight.float()
    largest = weight.abs().amax(dim=tuple(range(1, weight.ndim)), keepdim=True)
    scale = largest.clamp(min=torch.finfo(torch.float32).tiny) / 127
    return (weight / scale).round().clamp(-127, 127).to(torch.int8), scale


def _read(path: Path, tensors: bool = True) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Read metadata, and every tensor in single precision (counters unchanged)."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a weights file, found none")
    if is_checkpoint(path):
        name = path.with_suffix(".safetensors").name
        raise ValueError(
            f"{path}: expected a weights file, got a checkpoint of training; "
            f"make one with: python -m train.export {path} {name} --seed SEED"
        )
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            values = {name: file.get_tensor(name) for name in file.keys()} if tensors else {}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        with open(path, "rb") as file:
            instead = stand_in(file.read(100))
        raise ValueError(f"{path}: expected a whole safetensors file, got: {instead or error}") from error
    if metadata.get("format") not in (_FORMAT, _COMPACT_FORMAT):
        raise ValueError(f"{path}: expected format {_FORMAT}, got {metadata.get('format')}")
    scales = {name: values.pop(name + _SCALE) for name in list(values) if name + _SCALE in values}
    for name, value in values.items():
        if name in scales:
            values[name] = value.float() * scales[name]
        elif value.is_floating_point():
            values[name] = value.float()
    return metadata, values


def segmenter_config(values: Mapping[str, Any]) -> SegmenterConfig:
    """Return the configuration that a file holds, also under the names that its keys had before 0.1.0."""
    arguments: dict[str, Any] = {
        _FORMER_NAMES.get(name, name): tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
    }
    config = SegmenterConfig(**arguments)
    for name, most in _MOST.items():  # no memory for a network that no file holds
        value = getattr(config, name)
        if len(value) > most if isinstance(value, tuple) else value > most:
            raise ValueError(f"{name}: expected {most} at most, got {value}")
    return config
