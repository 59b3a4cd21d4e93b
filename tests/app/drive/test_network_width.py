"""The width of the network's input, which a run may choose."""

import pytest

from lanebev.app.config import RunConfig
from lanebev.app.drive.build import make_network


def test_a_run_has_the_width_that_is_given_for_images_of_all_shapes():
    config = RunConfig("drive.mp4", "camera.yaml", network_width=640)
    model = make_network(*config.network)
    assert model.network_size((720, 1280)) == (352, 640)
    assert model.network_size((375, 1242)) == (192, 640)


def test_without_one_it_is_that_of_the_weights():
    model = make_network(*RunConfig("drive.mp4", "camera.yaml").network)
    assert model.network_size((720, 1280)) == model.segmenter.image_size


@pytest.mark.parametrize("width", [0, -640, 32, 10**6])
def test_other_widths_are_refused(width):
    with pytest.raises(ValueError, match=f"network width: expected 64 to 4096 px, got {width}"):
        RunConfig("drive.mp4", "camera.yaml", network_width=width)


def test_an_exported_network_has_its_own():
    with pytest.raises(ValueError, match="network width: expected --backend torch, got onnxruntime"):
        RunConfig("drive.mp4", "camera.yaml", backend="onnxruntime", network_width=640)
