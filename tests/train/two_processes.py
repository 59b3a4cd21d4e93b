"""Train through the whole of LaneBEV in two processes (gloo, CPU); each writes its weights to a file."""

import sys

import lightning as L
import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from lanebev import BEVGrid, BEVWarp, JointCalibrator, LaneBEV, LineConfig, LineExtractor

SIZE = (64, 128)
CAMERA = torch.tensor([[80.0, 0.0, 63.5], [0.0, 80.0, 31.5], [0.0, 0.0, 1.0]])


class Stripes(nn.Module):
    """A network of two weights that sees six boundaries in every image."""

    def __init__(self):
        super().__init__()
        self.colour = nn.Conv2d(3, 7, 1)
        y, x = torch.meshgrid(*(torch.arange(side).float() for side in SIZE), indexing="ij")
        middle = [63.5 + slope * (y - 20) for slope in (-3.2, -2.0, -0.7, 0.7, 2.0, 3.2)]
        stripes = [8 * ((x - at).abs() < 1.5) * (y > 24) for at in middle]
        self.register_buffer("stripes", torch.stack([torch.full(SIZE, 4.0), *stripes]))

    def forward(self, image):
        return self.stripes + 0.1 * self.colour(image)


class Training(L.LightningModule):
    """The view's brightness and the pose, over two frames."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        grid = BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5)
        extractor = LineExtractor(LineConfig(stride=1))
        self.net = LaneBEV(Stripes(), extractor, JointCalibrator(iterations=1), BEVWarp(grid))

    def training_step(self, batch, _):
        images = batch[0]
        out, _ = self.net(images, CAMERA.repeat(images.shape[0], 1, 1))
        pose = out.calibration.extrinsics.stack()
        return (pose - torch.tensor([0.1, 0.0, 0.0, 1.2])).square().mean() + out.bev.mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


if __name__ == "__main__":
    torch.manual_seed(1)
    data = TensorDataset(torch.rand(4, 2, 3, *SIZE))
    training = Training()
    before = training.net.segmenter.colour.weight.detach().clone()
    trainer = L.Trainer(
        accelerator="cpu", devices=2, max_epochs=1, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
        strategy=DDPStrategy(process_group_backend="gloo"),
    )  # fmt: skip
    trainer.fit(training, DataLoader(data, batch_size=1))
    weights = {"before": before, "after": training.net.segmenter.colour.weight.detach()}
    torch.save(weights, f"{sys.argv[1]}/{trainer.global_rank}.pt")
