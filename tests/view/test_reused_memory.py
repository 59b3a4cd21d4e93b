"""Views without a graph, computed in memory that is kept, against those with one."""

import threading

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, BEVWarp, Extrinsics
from lanebev.view.reused_memory import ReusedArrays

GRID = BEVGrid(x=(-6.0, 6.0), z=(-2.0, 40.0), resolution=0.1)
INTRINSICS = torch.tensor([[150.0, 0.0, 160.0], [0.0, 155.0, 90.0], [0.0, 0.0, 1.0]])
POSES = Extrinsics.unstack(torch.tensor([[0.03, 0.02, -0.05, 1.4], [0.2, -1.2, 0.1, 0.02]]))
LENSES = {
    "none": (None, "pinhole"),
    "pinhole": (torch.tensor([[-0.2, 0.03, 0.001, -0.001, 0.005]]), "pinhole"),
    "fisheye": (torch.tensor([[-0.05, 0.01, -0.003, 0.001]]), "fisheye"),
}


def warped(lens: str, images: torch.Tensor, stride: float | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    distortion, model = LENSES[lens]
    distortion = None if distortion is None else distortion.expand(len(images), -1)
    poses = Extrinsics(*(value[: len(images)] for value in POSES))
    intrinsics = INTRINSICS.expand(len(images), 3, 3)
    return BEVWarp(GRID)(images, intrinsics, poses, distortion, model, (180, 320), stride)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("stride", [None, 2.0])
def test_the_view_is_the_same_with_and_without_a_graph(lens, stride):
    images = torch.rand(2, 3, 90, 160, generator=torch.Generator().manual_seed(0))
    expected, seen = warped(lens, images, stride)
    for context in (torch.no_grad, torch.inference_mode):
        with context():
            bev, valid = warped(lens, images, stride)
        assert torch.equal(valid, seen)
        assert 0.05 < valid.float().mean() < 0.95
        assert torch.allclose(bev, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "kind",
    [
        "channels last",
        "mirrored",
        "of half precision",
        "with a graph",
        "of no channel",
        "of infinite values",
        "negated without a copy",
    ],
)
def test_images_in_any_order_of_memory_and_type_are_sampled_without_a_graph(kind):
    images = torch.rand(2, 3, 90, 160, generator=torch.Generator().manual_seed(0))
    images = {
        "channels last": images.contiguous(memory_format=torch.channels_last),
        "mirrored": torch.rand(2, 3, 160, 90, generator=torch.Generator().manual_seed(0)).mT,
        "of half precision": images.half(),
        "with a graph": images.clone().requires_grad_(),
        "of no channel": images[:, :0],
        "of infinite values": images.masked_fill(images > 0.5, -torch.inf),  # as of log-probabilities
        "negated without a copy": torch.complex(images, images).conj().imag,
    }[kind]
    before = images.detach().clone()
    expected, seen = warped("pinhole", images)
    with torch.no_grad():
        bev, valid = warped("pinhole", images)
    assert bev.dtype == images.dtype
    assert torch.equal(valid, seen)
    assert torch.allclose(bev, expected, atol=1e-3 if bev.dtype == torch.half else 1e-6, rtol=0)
    assert torch.equal(images, before)


def test_views_of_more_rows_than_opencv_samples_are_the_same_without_a_graph():
    grid = BEVGrid(x=(-0.001, 0.001), z=(3.0, 36.0), resolution=0.001)
    images = torch.rand(1, 1, 180, 320, generator=torch.Generator().manual_seed(0))
    poses = Extrinsics(*(value[:1] for value in POSES))
    expected, _ = BEVWarp(grid)(images, INTRINSICS[None], poses)
    with torch.no_grad():
        bev, _ = BEVWarp(grid)(images, INTRINSICS[None], poses)
    assert bev.shape[2] == 33_000
    assert torch.allclose(bev, expected, atol=1e-6, rtol=0)


def test_a_view_stays_as_it_is_when_the_next_is_made():
    first, second = torch.rand(2, 2, 3, 180, 320, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        bev, valid = warped("pinhole", first)
        before = bev.clone(), valid.clone()
        warped("fisheye", second)
        warped("none", second)
    assert torch.equal(bev, before[0])
    assert torch.equal(valid, before[1])


def test_threads_do_not_disturb_each_other():
    images = torch.rand(8, 1, 3, 180, 320, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        expected = [warped("pinhole", each)[0] for each in images]
    results: list[torch.Tensor | None] = [None] * len(images)

    def work(number: int) -> None:
        with torch.no_grad():
            for _ in range(3):
                results[number] = warped("pinhole", images[number])[0]

    threads = [threading.Thread(target=work, args=(number,)) for number in range(len(images))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(got, want) for got, want in zip(results, expected, strict=True))


def test_rows_by_vmap_work_without_gradients():
    images = torch.rand(1, 3, 180, 320, generator=torch.Generator().manual_seed(3)).double()
    warp = BEVWarp(GRID)

    def view(pose: torch.Tensor) -> torch.Tensor:
        return warp(images, INTRINSICS[None], Extrinsics.unstack(pose[None]))[0]

    with torch.no_grad():
        rows = torch.func.vmap(view)(POSES.stack())
    assert torch.allclose(rows[0], view(POSES.stack()[0]), atol=1e-5)


def test_arrays_are_kept_by_name_shape_and_type():
    kept = ReusedArrays()
    one = kept("a", (2, 3), np.float32)
    assert kept("a", (2, 3), np.float32) is one
    others = [kept("b", (2, 3), np.float32), kept("a", (3, 2), np.float32), kept("a", (2, 3), np.float64)]
    assert all(other is not one for other in others)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lanebev.view.reused_memory._MOST_BYTES", 100)
        assert kept("c", (1000,), np.uint8) is not kept("c", (1000,), np.uint8)
        assert kept("a", (2, 3), np.float32) is not one  # room was made
