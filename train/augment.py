"""Photometric changes of an image by the camera, from kornia."""

import kornia.augmentation as K
from torch import Tensor, nn


class Photometric(nn.Module):
    """Changes brightness, contrast, colour, blur and noise of each image independently; geometry stays."""

    def __init__(self, strength: float = 1.0) -> None:
        super().__init__()
        s = strength
        self.steps = K.ImageSequential(
            K.RandomBrightness((1 - 0.35 * s, 1 + 0.35 * s), p=0.6),
            K.RandomContrast((1 - 0.4 * s, 1 + 0.4 * s), p=0.6),
            K.RandomGamma((1 - 0.3 * s, 1 + 0.4 * s), p=0.3),
            K.RandomSaturation((1 - 0.6 * s, 1 + 0.4 * s), p=0.3),
            K.RandomPlanckianJitter(mode="blackbody", p=0.3),
            K.RandomGrayscale(p=0.08),
            K.RandomGaussianBlur((5, 5), (0.3, 1.2 * s + 0.3), p=0.15),
            K.RandomMotionBlur((3, 7), 90.0, 0.0, p=0.05),
            K.RandomGaussianNoise(0.0, 0.03 * s, p=0.3),
            K.RandomErasing((0.005, 0.04), p=0.15),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Augment (B, 3, H, W) in [0, 1]."""
        augmented: Tensor = self.steps(image)
        return augmented.clamp(0, 1)
