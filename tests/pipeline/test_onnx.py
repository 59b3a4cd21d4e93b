"""What goes to ONNX: all that sees and all that warps. Calibrators need Cholesky, which ONNX has not."""

import onnxruntime
import pytest
import torch
from torch import nn

from lanebev import BEVGrid, BEVWarp, Extrinsics, LaneSegmenter, LineExtractor
from lanebev.observation.segmenter import SegmenterConfig

pytestmark = pytest.mark.filterwarnings("ignore")
SIZE = (64, 128)
MAP = (32, 64)  # of the network


class SeeAndWarp(nn.Module):
    """Image, camera and pose to segments and the view."""

    def __init__(self) -> None:
        super().__init__()
        config = SegmenterConfig(base_width=16)
        self.segmenter = LaneSegmenter(config)
        self.extractor = LineExtractor.for_network(config)
        self.warp = BEVWarp(BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5))
        y, x = torch.meshgrid(*(torch.arange(side).float() for side in MAP), indexing="ij")
        middle = [31.5 + slope * (y - 10) for slope in (-1.6, -1.0, -0.4, 0.3, 0.9, 1.5)]
        stripes = [8 * ((x - at).abs() < 1) * (y > 12) for at in middle]
        self.register_buffer("stripes", torch.stack([torch.full(MAP, 4.0), *stripes]))

    def forward(self, image, intrinsics, pose):
        segments = self.extractor(self.segmenter(image) + self.stripes, SIZE, SIZE)
        bev, _ = self.warp(image, intrinsics, Extrinsics.unstack(pose))
        return *segments, bev


@pytest.mark.slow
def test_observation_and_warp_export_to_onnx(tmp_path):
    torch.manual_seed(0)
    net = SeeAndWarp().eval()
    intrinsics = torch.tensor([[[80.0, 0.0, 63.5], [0.0, 80.0, 31.5], [0.0, 0.0, 1.0]]])
    args = (torch.rand(1, 3, *SIZE), intrinsics, torch.tensor([[0.05, 0.02, 0.01, 1.5]]))
    with torch.no_grad():
        expected = net(*args)
        torch.onnx.export(net, args, tmp_path / "net.onnx", dynamo=True, verbose=False)
    there = expected[2] > 0.5
    assert there.sum() > 20
    session = onnxruntime.InferenceSession(tmp_path / "net.onnx")
    feeds = {each.name: arg.numpy() for each, arg in zip(session.get_inputs(), args, strict=True)}
    *segments, bev = map(torch.from_numpy, session.run(None, feeds))
    for got, value in zip(segments, expected[:-1], strict=True):
        torch.testing.assert_close(got[there], value[there], atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(bev, expected[-1], atol=1e-4, rtol=0)
