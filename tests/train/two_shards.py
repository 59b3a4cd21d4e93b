"""Train through LaneBEV sharded over two processes (FSDP, gloo, CPU): equal to a process with the whole."""

import copy
import sys

import torch
from torch import distributed, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import MixedPrecisionPolicy, fully_shard
from two_processes import CAMERA, SIZE, Training

from lanebev import LaneSegmenter, LineExtractor, SegmenterConfig


class Detector(nn.Module):
    """A trunk whose features are seen from above, and LaneBEV."""

    def __init__(self):
        super().__init__()
        self.lanes = Training().net
        self.trunk = nn.Conv2d(3, 4, 7, 8, 3)

    def forward(self, images, cameras):
        out, _ = self.lanes(images, cameras)
        pose = out.calibration.extrinsics
        view, _ = self.lanes.warp(self.trunk(images), cameras, pose, image_size=SIZE, strides=8)
        return view.float().mean() + pose.stack().square().sum()


def trained(net, images):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = net(images, CAMERA.repeat(len(images), 1, 1))
    loss.backward()
    torch.optim.SGD(net.parameters(), lr=0.1).step()
    return net


def train(rank, folder):
    distributed.init_process_group("gloo", init_method=f"file://{folder}/begin", rank=rank, world_size=2)
    net, mesh = Detector(), init_device_mesh("cpu", (2,))
    images = torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(1))
    whole = trained(copy.deepcopy(net), images).state_dict()
    fully_shard(net.trunk, mesh=mesh, mp_policy=MixedPrecisionPolicy(param_dtype=torch.bfloat16))
    fully_shard(net, mesh=mesh)
    for name, value in trained(net, images).state_dict().items():
        found = value.full_tensor() if hasattr(value, "full_tensor") else value
        torch.testing.assert_close(found, whole[name], atol=1e-4, rtol=1e-3)
    assert not torch.equal(whole["trunk.weight"], Detector().trunk.weight)
    train_in_bfloat16(mesh, images)
    distributed.destroy_process_group()


def train_in_bfloat16(mesh, images):
    """As the docs say: batch norms, whose statistics stay in float32, by themselves and without policy."""
    net = Detector()
    net.lanes.segmenter = LaneSegmenter(SegmenterConfig(base_width=4, decoder_width=8))
    net.lanes.extractor = LineExtractor.for_network(net.lanes.segmenter.config)
    for part in net.lanes.segmenter.modules():
        if isinstance(part, nn.BatchNorm2d):
            fully_shard(part, mesh=mesh)
    policy = MixedPrecisionPolicy(param_dtype=torch.bfloat16)
    fully_shard(net.lanes.segmenter, mesh=mesh, mp_policy=policy)
    fully_shard(net, mesh=mesh)
    out, _ = net.lanes(images, CAMERA.repeat(len(images), 1, 1))
    assert out.logits.dtype == torch.bfloat16
    out.logits.float().square().mean().backward()
    assert net.lanes.segmenter.head.weight.grad.full_tensor().abs().sum() > 0


if __name__ == "__main__":
    torch.multiprocessing.spawn(train, (sys.argv[1],), 2)
