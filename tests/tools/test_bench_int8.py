"""The comparison of a segmenter in float and in 8 bits: what stands in for the network, and its figures."""

from types import SimpleNamespace

import pytest
import torch

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from tools import bench_int8

CONFIG = SegmenterConfig(base_width=4, decoder_width=4, image_size=(64, 96), context=(1,))


class FakePart:
    """A file of a segmenter, without ONNX: it takes one image at a time, as an 8-bit file does."""

    def __init__(self, segmenter):
        self.segmenter, self.facts = segmenter, {"network_size": list(segmenter.image_size)}

    def __call__(self, values):
        assert values["image"].shape[0] == 1
        return {"logits": self.segmenter(values["image"])}


@pytest.fixture
def network():
    torch.manual_seed(0)
    segmenter = LaneSegmenter(CONFIG).eval()
    return bench_int8.SegmenterFile(segmenter, FakePart(segmenter)).eval()


@torch.inference_mode()
def test_a_file_computes_a_batch_as_its_network_does(network):
    image = torch.rand(3, 3, *CONFIG.image_size)
    torch.testing.assert_close(network(image), network.segmenter(image))
    assert network.image_size == CONFIG.image_size
    assert network.config is CONFIG


@torch.inference_mode()
def test_times_are_milliseconds_of_each_file(network, monkeypatch):
    clock = iter([0.0, 0.003, 1.0, 1.005, 2.0, 2.004, 3.0, 3.001])
    monkeypatch.setattr(bench_int8.time, "process_time", lambda: next(clock))
    assert bench_int8.times([network, network], repeats=2) == pytest.approx([3.0, 1.0])


@torch.inference_mode()
def test_figures_are_those_of_roads_and_drives(network, monkeypatch):
    asked = []

    def evaluate(network, views, kinds, seed, batch):
        asked.append(views)
        figures = {"recall": 0.9, "error_px": 1.5, "false": 0.1, "rows": 7}
        return {("kind", kind): SimpleNamespace(figures=lambda: figures) for kind in kinds}

    def summaries(drives, factors):
        assert (drives, factors) == ([81_000, 81_001], (1.0,))
        return {1.0: SimpleNamespace(rmse=torch.tensor([0.1, 0.2, 0.3, 4.0]), nees=torch.tensor(2.0))}

    monkeypatch.setattr(bench_int8, "evaluate", evaluate)
    monkeypatch.setattr(bench_int8, "observe_drive", lambda networks, seed, frames, fps: [seed])
    monkeypatch.setattr(bench_int8, "summaries", summaries)
    found = bench_int8.accuracy(network, SimpleNamespace(views=5, drives=2, frames=9, data=None))
    assert asked == [3]  # of each of two kinds
    assert len(found) == 2 * 3 + 4 + 1
    assert found["highway: recall"] == 0.9
    assert [value for name, value in found.items() if name.startswith("drives")] == pytest.approx(
        [0.1, 0.2, 0.3, 4.0, 2.0]
    )


def test_the_table_has_a_column_for_each_file(network, monkeypatch, capsys, tmp_path):
    file = tmp_path / "file.onnx"
    file.write_bytes(bytes(2_000_000))
    monkeypatch.setattr(bench_int8, "write_files", lambda folder: (file, file))
    monkeypatch.setattr(bench_int8, "load_segmenter", lambda: network.segmenter)
    monkeypatch.setattr(bench_int8, "OnnxPart", lambda path: network.part)
    monkeypatch.setattr(bench_int8, "accuracy", lambda network, options: {"highway: recall": 0.91234})
    monkeypatch.setattr(torch, "set_num_threads", lambda count: None)
    monkeypatch.setattr("sys.argv", ["bench_int8", "--views", "2"])
    bench_int8.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| | float | int8 |"
    assert "| file, MB | 2 | 2 |" in lines
    assert lines[-1] == "| highway: recall | 0.9123 | 0.9123 |"
