"""Start a trunk from the weights of an image classifier."""

import pickle
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lanebev.observation.resnet import ResNet18


def load_backbone(trunk: ResNet18, path: Path) -> None:
    """Load torchvision's ResNet-18, strictly by its names; only the classifier ``fc`` is left out.

    Args:
        trunk: trunk with 64 channels.
        path: a ``state_dict`` of torch.save, or a safetensors file.

    Raises:
        ValueError: no such file, or other names or shapes than ResNet-18's.
    """
    state = _read(path)
    if not all(bool(value.isfinite().all()) for value in state.values()):
        raise ValueError(f"backbone: {path}: expected finite numbers, got NaN or infinity")
    try:
        trunk.load_torchvision(state)
    except (RuntimeError, AttributeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise ValueError(f"backbone: {path}: expected torchvision's ResNet-18, got: {reason}") from error


def _read(path: Path) -> dict[str, Tensor]:
    try:
        if path.suffix == ".safetensors":
            state: object = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ValueError(
            f"backbone: {path}: expected a state_dict, got: {error.strerror or error}"
        ) from error
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"backbone: {path}: expected a state_dict, got other objects, or a file that is cut; make one by "
            "torch.save(model.state_dict(), FILE)"
        ) from error
    except (EOFError, RuntimeError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"backbone: {path}: expected a state_dict, got: {reason}") from error
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]  # of a checkpoint, as PyTorch's ImageNet example writes it
    if not (isinstance(state, dict) and all(isinstance(value, Tensor) for value in state.values())):
        raise ValueError(f"backbone: {path}: expected a state_dict of tensors, got {type(state).__name__}")
    return {name.removeprefix("module."): value for name, value in state.items()}  # DataParallel's names
