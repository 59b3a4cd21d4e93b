"""Measure how fast a device renders, labels and trains: ``python -m train.smoke --out OUT``.

Prints frames a second of rendering, of labelling and augmenting, and of training alone, the time of the first
call and the peak memory; on a GPU also of training after cuDNN has searched for its fastest kernels. Saves a
sheet of labelled views. A batch that does not fit in memory is reported and skipped.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jsonargparse.typing import PositiveInt
from PIL import Image
from torch import Tensor

from lanebev.observation.segmenter import SegmenterConfig
from lanebev.render import WindowConfig
from lanebev.report.overlay import BOUNDARY_COLOURS
from train.commands import command_parser, one_line_errors
from train.data import Batch
from train.labels import ViewConfig
from train.module import Segmentation, unpack
from train.rendering import labelled, random_views

_HIDDEN = (255.0, 255.0, 255.0)
_OPACITY = 0.7
_COLUMNS, _SHOWN_WIDTH = 4, 400  # pictures in a row of the sheet, and px of each


def labelled_view(batch: Batch) -> Tensor:
    """Draw the labels of a batch into its images, hidden boundaries in white: (B, 3, H, W) uint8."""
    size = batch.image.shape[-2:]
    colours = torch.tensor(BOUNDARY_COLOURS, dtype=torch.float32, device=batch.image.device)
    colours = torch.cat([colours, colours.new_tensor([_HIDDEN])])
    hidden = 255 * (1 - batch.weight.float()).unsqueeze(1)
    share = torch.cat([batch.target.float(), hidden], dim=1) / 255
    share = F.interpolate(share, size=size, mode="nearest")
    paint = torch.einsum("blhw,lc->bchw", share, colours)
    covered = share.sum(1, keepdim=True).clamp(max=1) * _OPACITY
    return ((1 - covered) * batch.image.float() + _OPACITY * paint).clamp(0, 255).byte()


def save_sheet(images: Tensor, path: Path) -> None:
    """Save images (B, 3, H, W) uint8 side by side as a PNG."""
    height = round(_SHOWN_WIDTH * images.shape[-2] / images.shape[-1])
    small = F.interpolate(images.float(), size=(height, _SHOWN_WIDTH), mode="bilinear", antialias=True)
    small = F.pad(small, (0, 0, 0, 0, 0, 0, 0, -len(images) % _COLUMNS))
    rows = small.unflatten(0, (-1, _COLUMNS)).permute(0, 3, 1, 4, 2)  # (rows, H, columns, W, 3)
    sheet = rows.reshape(-1, _COLUMNS * _SHOWN_WIDTH, 3).round().clamp(0, 255).byte().cpu().numpy()
    Image.fromarray(sheet).save(path)


def seconds(work: Callable[[], Any], device: torch.device, repeats: int) -> tuple[float, float]:
    """Time a call on a device: the first, and the least of several after that."""
    taken = []
    for _ in range(repeats + 1):
        _wait(device)
        begin = time.perf_counter()
        work()
        _wait(device)
        taken.append(time.perf_counter() - begin)
    return taken[0], min(taken[1:])


def report(name: str, count: int, work: Callable[[], Any], device: torch.device, repeats: int) -> None:
    """Print frames a second and the peak memory of a call on ``count`` frames."""
    cuda = device.type == "cuda"
    if cuda:
        torch.cuda.reset_peak_memory_stats(device)
    try:
        first, each = seconds(work, device, repeats)
    except torch.OutOfMemoryError:
        print(f"{name} B={count}: out of memory", flush=True)
        torch.cuda.empty_cache()
        return
    peak = torch.cuda.max_memory_allocated(device) / 2**30 if cuda else 0.0
    print(
        f"{name} B={count}: {count / each:.0f} frames/s, {1e3 * each:.1f} ms, at first {1e3 * first:.0f} ms, "
        f"peak {peak:.1f} GiB",
        flush=True,
    )


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="output folder")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 576), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--batches", type=PositiveInt, nargs="+", default=(32, 64, 128))
    parser.add_argument("--repeats", type=PositiveInt, default=3)
    parser.add_argument("--base-width", type=PositiveInt, default=64)
    args = parser.parse_args()
    device, size, repeats = torch.device(args.device), tuple(args.size), args.repeats
    torch.set_float32_matmul_precision("high")
    args.out.mkdir(parents=True, exist_ok=True)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    print(f"{name}, torch {torch.__version__}, {size[0]} x {size[1]}", flush=True)

    view, window = ViewConfig(), WindowConfig()
    together = (512, 1024) if device.type == "cuda" else ()  # as many as configs/gpu.yaml renders together
    for count in (*args.batches, *together):
        report(
            "rendering",
            count,
            partial(random_views, count, size, (count,), device, window, count),
            device,
            repeats,
        )
    count = args.batches[len(args.batches) // 2]
    views = random_views(count, size, (1,), device, window, min(args.batches))
    report("labelling", count, lambda: labelled(views, view), device, repeats)
    batch = labelled(views, view)
    save_sheet(labelled_view(type(batch)(*(field[:24] for field in batch))), args.out / "sheet.png")

    config = SegmenterConfig(base_width=args.base_width, image_size=size)
    model = Segmentation(network=config, class_weight=None).to(device)
    model.log_dict = lambda *_, **__: None  # type: ignore[method-assign]
    optimizer = torch.optim.AdamW(model.parameters(), 1e-5)
    photometric = model.photometric
    assert photometric is not None
    report("augmenting", count, lambda: photometric(unpack(batch)[0]), device, repeats)
    model.photometric = None

    def step(batch: Any) -> None:
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            loss = model.map_loss(batch, 0)[0]
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    for count in sorted({len(batch.image), min(args.batches)}):
        part = type(batch)(*(field[:count] for field in batch))
        report("training", count, partial(step, part), device, repeats)
    if device.type == "cuda":
        torch.backends.cudnn.benchmark = True
        report("training after a search for kernels", count, partial(step, part), device, repeats)


if __name__ == "__main__":
    main()
