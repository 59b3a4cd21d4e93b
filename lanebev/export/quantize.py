"""The segmenter's ONNX file with 8-bit convolutions, by ONNX Runtime's quantisation."""

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.export.write import MISSING, quiet_logs
from lanebev.render import render_views

VIEWS = 32
"""Rendered views whose activations determine the ranges of 8-bit numbers."""

Feed = dict[str, NDArray[Any]]


def rendered_views(size: tuple[int, int], count: int = VIEWS) -> Iterator[Feed]:
    """Render views of all kinds of roads, each an input of the segmenter (1, 3, h, w)."""
    for number in range(count):
        frame = render_views(1, size, torch.Generator().manual_seed(number))
        yield {"image": frame.image.numpy().astype(np.float32)}


def quantize_segmenter(path: Path, feeds: Iterable[Feed]) -> None:
    """Replace a segmenter's file by one whose convolutions compute with 8-bit numbers.

    Weights have a scale for each output channel, activations one for each tensor, from their smallest and
    largest value on the feeds. The last convolution, whose results are the logits, stays in float.

    Args:
        path: file of :func:`lanebev.export.write.write_onnx`.
        feeds: inputs for the calibration of the ranges.
    """
    try:
        import onnx
        from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
        from onnxruntime.quantization.shape_inference import quant_pre_process
    except ImportError as error:
        raise ValueError(f"int8: {MISSING} ({error})") from error

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        """Hands the feeds on, one after the other."""

        def __init__(self) -> None:
            self.feeds = iter(feeds)

        def get_next(self) -> Feed | None:
            return next(self.feeds, None)

    facts = onnx.load(path).metadata_props
    with tempfile.TemporaryDirectory() as folder, quiet_logs():
        simple, small = Path(folder, "simple.onnx"), Path(folder, "small.onnx")
        quant_pre_process(path, simple, skip_symbolic_shape=True)
        convolutions = [node.name for node in onnx.load(simple).graph.node if node.op_type == "Conv"]
        quantize_static(
            simple,
            small,
            Reader(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=convolutions[-1:],
        )
        model = onnx.load(small)
        del model.metadata_props[:]
        model.metadata_props.extend(facts)
        onnx.save(model, path)
