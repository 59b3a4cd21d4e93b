"""Training of the segmentation model: ``python -m train fit --config configs/default.yaml``."""
