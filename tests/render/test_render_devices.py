"""Rendering on any device: the same scenes everywhere, nothing that meets across devices, few waits."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from lanebev.render import Drive, RenderedFrame, WindowConfig, render_views, views
from lanebev.render.raster.base.blocks import make_blocks, multiply_rows
from lanebev.render.rows import send, take_rows
from lanebev.render.scene.kinds import KINDS
from lanebev.render.scene.world import Scene
from lanebev.render.views import render_scenes, sample_views
from lanebev.tensors import all_tensors
from tools.other_device import ELSEWHERE, Elsewhere, other_device

SIZE = (64, 112)
cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


class Number(NamedTuple):
    """A number for each block."""

    value: Tensor


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene_of(batch: int, seed: int, kind: str = "any") -> Scene:
    return sample_views(batch, SIZE, generator(seed), kind=kind)[0]


def assert_same(first: RenderedFrame, second: RenderedFrame, share: float = 0.0) -> None:
    """Equal truth; images equal, or unequal by more than a grey level in at most a share of the pixels."""
    for name, one, other in zip(first._fields, first, second, strict=True):
        if name == "image":
            assert ((one.cpu() - other.cpu()).abs() > 1 / 255).float().mean() <= share
        elif isinstance(one, Tensor):
            torch.testing.assert_close(one.cpu(), other.cpu(), atol=2e-3, rtol=1e-4, msg=name)


def test_the_same_seed_gives_the_same_frames_bit_for_bit() -> None:
    first, second = (render_views(3, SIZE, generator(1)) for _ in range(2))
    for one, other in zip(all_tensors(first), all_tensors(second), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("kind", KINDS)
def test_a_row_is_the_same_in_a_batch_of_any_size(kind: str) -> None:
    """Blocks have one row each, so others change nothing but the rounding of vector instructions' ends."""
    scene, seeds = scene_of(3, 2, kind), [1, 2, 3]
    together = render_scenes(scene, SIZE, seeds, rows=3)
    alone = [render_scenes(take_rows(scene, slice(b, b + 1)), SIZE, seeds[b : b + 1]) for b in range(3)]
    for b in range(3):
        assert_same(take_rows(together, slice(b, b + 1)), alone[b], share=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_tensor_of_the_host_meets_one_of_the_device(kind: str) -> None:
    expected = render_views(4, SIZE, generator(3), kind=kind, rows=4)
    with other_device() as device:
        frame = render_views(4, SIZE, generator(3), kind=kind, device=ELSEWHERE)
    assert all(isinstance(t, Elsewhere) for t in all_tensors(frame))
    assert torch.equal(frame.image.here, expected.image)  # type: ignore[attr-defined]
    assert sum(device.waits.values()) < 30


@pytest.mark.slow
def test_waits_and_launches_do_not_grow_with_the_batch() -> None:
    counts = []
    for batch in (8, 24):
        scene = scene_of(batch, 4)
        with other_device() as device:
            render_scenes(scene, SIZE, list(range(batch)), device=ELSEWHERE)
        counts.append((sum(device.waits.values()), sum(device.launches.values())))
    (waits, launches), (more_waits, more_launches) = counts
    assert more_waits == waits
    assert more_launches < 1.4 * launches  # kinds of road and of wall that the smaller batch has not


def test_scenes_are_sampled_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    place = views.sample_place
    monkeypatch.setattr(views, "sample_place", lambda *a: seen.append(torch.get_num_threads()) or place(*a))
    monkeypatch.setattr(views, "scene_at", None)  # breaks
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(TypeError):
            scene_of(2, 1)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert seen == [1]


def test_frames_of_a_drive_are_those_asked_for_one_by_one() -> None:
    drive = Drive(5, SIZE, num_frames=8, kind="any")
    frames = drive.frames([6, 1, 3])
    for row, index in enumerate((6, 1, 3)):
        for one, other in zip(
            all_tensors(take_rows(frames, slice(row, row + 1))), all_tensors(drive.frame(index)), strict=True
        ):
            assert torch.equal(one, other)


@pytest.mark.parametrize("rows", [torch.tensor([2, 0, 0]), torch.tensor([1])])
def test_selected_rows_are_those_of_every_tensor(rows: Tensor) -> None:
    scene = scene_of(3, 6)
    for one, other in zip(all_tensors(take_rows(scene, rows)), all_tensors(scene), strict=True):
        assert torch.equal(one, other[rows])
        assert one.dtype == other.dtype


@pytest.mark.parametrize("rows", [[0, 2], [0, 1, 2], []])
def test_a_factor_of_some_rows_leaves_the_others_alone(rows: list[int]) -> None:
    mask = torch.rand(3, 100, generator=generator(10)) < torch.tensor([[0.9], [0.5], [0.2]])
    blocks = make_blocks(mask, size=16)
    values = torch.ones(blocks.place.shape)
    number = Number(torch.tensor([2.0, 3.0, 5.0])[blocks.row])
    multiply_rows(values, blocks, rows, lambda own, place: own.value[:, None] * place, number, blocks.place)
    chosen = torch.isin(blocks.row, torch.tensor(rows))[:, None]
    assert torch.equal(values, torch.where(chosen, number.value[:, None] * blocks.place, 1.0))


def test_what_is_sent_elsewhere_arrives() -> None:
    scene = scene_of(2, 7)
    with other_device():
        sent = all_tensors(send(scene, ELSEWHERE))
    for one, other in zip(sent, all_tensors(scene), strict=True):
        assert torch.equal(one.here, other)  # type: ignore[attr-defined]


@cuda
@pytest.mark.parametrize("kind", KINDS)
def test_cuda_shows_the_scenes_of_the_cpu(kind: str) -> None:
    scene, seeds = scene_of(8, 8, kind), list(range(8))
    here = render_scenes(scene, SIZE, seeds, ideal_sensor=True)
    there = render_scenes(scene, SIZE, seeds, device="cuda", ideal_sensor=True)
    assert there.image.is_cuda
    assert_same(here, there, share=0.01)


@cuda
def test_cuda_repeats_bit_for_bit() -> None:
    first, second = (
        render_views(16, SIZE, generator(9), device="cuda", window=WindowConfig()) for _ in range(2)
    )
    for one, other in zip(all_tensors(first), all_tensors(second), strict=True):
        assert torch.equal(one, other)
    from_cuda = torch.Generator("cuda").manual_seed(9)
    assert render_views(2, SIZE, from_cuda, device="cuda").image.isfinite().all()
