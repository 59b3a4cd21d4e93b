"""Rendering where the network trains: batches, schedules by the share of the budget, resumption."""

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import lightning as L
import pytest
import torch
import yaml
from lightning.pytorch.callbacks import Timer

import train.live
from lanebev.render import WindowConfig
from train.__main__ import main
from train.budget import Stage, rate_factor, stage_at, used_share
from train.labels import ViewConfig, separated
from train.live import HeldOutBatches, LiveBatches, LiveRoads, ScenesAhead, far_stage
from train.module import Segmentation
from train.rendering import Views, combined_seed, labelled, mirrored, random_views
from train.stopwatch import Stopwatch

pytestmark = pytest.mark.filterwarnings("ignore")  # of Lightning about itself

CPU = torch.device("cpu")
STAGES = [Stage(0.5, (48, 80), 4), Stage(1.0, (64, 96), 2)]


@pytest.fixture(scope="module")
def views():
    return random_views(2, (64, 96), (5,), CPU, WindowConfig(), 64)


@pytest.fixture
def instant(monkeypatch):
    """Views of noise, by the same seeds, in no time."""

    def noise(drawn, size, *_):
        count, seed = drawn
        generator = torch.Generator().manual_seed(seed)
        image = torch.randint(256, (count, 3, *size), generator=generator, dtype=torch.uint8)
        points = torch.rand(count, 6, 12, 2, generator=generator) * size[0]
        there = torch.ones(count, 6, 12, dtype=torch.bool)
        return Views(image, points, there, there)

    monkeypatch.setattr(train.live, "sample_scenes", lambda count, _, seed, __: (count, combined_seed(seed)))
    monkeypatch.setattr(train.live, "render_sampled", noise)


def batches(first, repeats=2, flip=0.5):
    view = ViewConfig(flip=flip)
    return LiveBatches(lambda n: n / 8, STAGES, repeats, 2, view, WindowConfig(), (3, 0), first, CPU, 64)


def taken(first, count, **kwargs):
    return list(itertools.islice(batches(first, **kwargs), count))


def test_mirroring_twice_is_nothing_and_once_renumbers(views):
    which = torch.tensor([True, False])
    once = mirrored(views, which)
    assert torch.equal(once.points[1], views.points[1])
    torch.testing.assert_close(once.points[0, 2, :, 0], 95 - views.points[0, 3, :, 0])
    twice = mirrored(once, which)
    assert all(torch.allclose(a.float(), b.float(), atol=1e-4) for a, b in zip(twice, views, strict=True))


def test_labels_go_with_their_image(views):
    """Each label pixel (i, j) is on image pixel (2 i, 2 j), mirrored or not."""
    config = ViewConfig()
    for which in (False, True):
        moved = mirrored(views, torch.tensor([which, which]))
        batch = labelled(moved, config)
        assert batch.target.shape == (2, 6, 32, 48)
        row, line, point = (separated(moved.points / 2, moved.visible, config.gap)).nonzero().unbind(-1)
        x, y = (moved.points[row, line, point] / 2).round().long().unbind(-1)
        assert (batch.target[row, line, y.clamp(0, 31), x.clamp(0, 47)] > 200).float().mean() > 0.8


@pytest.mark.usefixtures("instant")
def test_a_view_is_in_two_batches_on_end_and_sizes_follow_the_share():
    found = taken(0, 7, flip=0.0)
    small, large = (3, 48, 80), (3, 64, 96)
    shapes = [(2, *small), *[(4, *small)] * 3, (1, *large), *[(2, *large)] * 2]
    assert [tuple(batch.image.shape) for batch in found] == shapes
    for earlier, later in itertools.pairwise(found[1:4]):
        assert torch.equal(earlier.image[2:], later.image[:2])  # new ones become old ones
        assert not torch.equal(earlier.image[:2], later.image[2:])


@pytest.mark.usefixtures("instant")
def test_an_interrupted_stream_goes_on_where_it_was():
    whole = taken(0, 7)
    for first in range(1, 7):
        (next_one,) = taken(first, 1)
        assert all(torch.equal(a, b) for a, b in zip(next_one, whole[first], strict=True))


def test_scenes_ahead_are_those_of_their_block_also_after_another_stage_has_begun():
    sampled = []

    def sample(block, stage):
        sampled.append((block, stage, threading.current_thread() is threading.main_thread()))
        return block, stage

    first, second = STAGES
    with ThreadPoolExecutor(1) as pool:
        ahead = ScenesAhead(pool, sample)
        assert ahead.take(0, first) == (0, first)
        ahead.begin(1, first)
        assert ahead.take(1, first) == (1, first)
        ahead.begin(2, first)
        assert ahead.take(2, second) == (2, second)
    on_main = {True: [(0, first), (2, second)], False: [(1, first), (2, first)]}
    assert {here: [(b, s) for b, s, main in sampled if main is here] for here in (True, False)} == on_main


def test_held_out_frames_are_the_same_each_time():
    data = HeldOutBatches(1, 2, (48, 80), ViewConfig(), 7, CPU)
    (one,), (again,) = data, data
    assert torch.equal(one.image, again.image)
    assert one.target.any()


def test_rate_warms_up_stays_and_falls_to_zero_by_share_and_by_steps():
    by_share = {"warmup_steps": 10, "decay_steps": 0, "decay_share": 0.5}
    assert rate_factor(0, -1, 0.0, **by_share) == pytest.approx(0.1)
    assert rate_factor(50, -1, 0.4, **by_share) == 1.0
    assert rate_factor(50, -1, 0.75, **by_share) == pytest.approx(0.5)
    assert rate_factor(99, -1, 1.0, **by_share) == 0.0
    by_steps = {"warmup_steps": 1, "decay_steps": 4, "decay_share": 0.0}
    assert [rate_factor(step, 10, step / 10, **by_steps) for step in (5, 8, 10)] == [1.0, 0.5, 0.0]


def test_stages_end_at_their_share():
    assert [stage_at(STAGES, share).size[0] for share in (0.0, 0.49, 0.5, 1.0)] == [48, 48, 64, 64]


def test_share_is_of_minutes_where_there_is_no_number_of_steps(monkeypatch):
    timer = Timer({"seconds": 40})
    trainer = L.Trainer(max_epochs=-1, logger=False, callbacks=[timer], accelerator="cpu")
    monkeypatch.setattr(timer, "time_elapsed", lambda *_: 10.0)
    assert used_share(trainer) == pytest.approx(0.25)
    trainer = L.Trainer(max_steps=8, logger=False, callbacks=[timer], accelerator="cpu")
    assert used_share(trainer, 4) == pytest.approx(0.5)  # the larger one


def test_stopwatch_forgets_what_was_read():
    watch = Stopwatch(CPU)
    with watch.time("a"):
        pass
    assert watch.read().keys() == {"a"}
    assert watch.read() == {}


SMALL = [
    "--trainer.accelerator=cpu",
    "--trainer.precision=32-true",
    "--trainer.callbacks.every=0.001",
    "--model.init_args.network.base_width=4",
    "--model.init_args.network.decoder_width=4",
    "--model.init_args.init_from=null",
    "--data.init_args.together=1",
    "--data.init_args.stages=[{until: 0.5, size: [48, 80], batch_size: 4},"
    " {until: 1.0, size: [64, 96], batch_size: 2}]",
]


def fit(folder, *extra, config="gpu.yaml"):
    here = [f"--trainer.default_root_dir={folder}", f"--trainer.logger.init_args.save_dir={folder}"]
    path = Path(__file__).parents[2] / "configs" / config
    main(["fit", "--config", str(path), *here, *SMALL, *extra])


@pytest.mark.slow
@pytest.mark.usefixtures("instant")
def test_refine_live_config_trains_by_steps(tmp_path):
    fit(tmp_path, "--trainer.max_steps=2", config="refine_live.yaml")
    last = next(tmp_path.rglob("last.ckpt"))
    assert torch.load(last, weights_only=False)["global_step"] == 2


@pytest.mark.slow
@pytest.mark.usefixtures("instant")
def test_gpu_config_trains_by_steps_and_an_interrupted_run_ends_as_one_in_a_piece(tmp_path, monkeypatch):
    each = "--trainer.callbacks+={class_path: lightning.pytorch.callbacks.ModelCheckpoint, " + (
        "init_args: {every_n_train_steps: 1, filename: 'each-{step}', save_top_k: -1}}"
    )
    steps = ["--trainer.max_steps=6", each]
    fit(tmp_path / "whole", *steps)
    step = Segmentation.training_step

    def until_the_fourth(self, batch, batch_idx):
        if batch_idx == 3:
            raise RuntimeError("power cut")
        return step(self, batch, batch_idx)

    with monkeypatch.context() as cut:
        cut.setattr(Segmentation, "training_step", until_the_fourth)
        with pytest.raises(RuntimeError, match="power cut"):
            fit(tmp_path / "parts", *steps)
    (begun,) = (tmp_path / "parts").rglob("each-step=3.ckpt")
    fit(tmp_path / "parts", *steps, f"--ckpt_path={begun}")
    whole, parts = (
        torch.load(next((tmp_path / name).rglob("each-step=6.ckpt")), weights_only=False)
        for name in ("whole", "parts")
    )
    assert all(torch.equal(value, parts["state_dict"][name]) for name, value in whole["state_dict"].items())
    views = [each["callbacks"]["Throughput"]["views"] for each in (whole, parts)]
    assert views == [2 + 4 + 7 + 1 + 1 + 2] * 2  # the third and the fourth batch are of far views
    table = next((tmp_path / "whole").rglob("throughput.csv")).read_text().splitlines()
    assert table[0].startswith("step,used,views,views_per_s")
    assert len(table) > 3


@pytest.mark.slow
@pytest.mark.usefixtures("instant")
def test_gpu_config_ends_after_its_minutes_with_a_checkpoint(tmp_path):
    fit(tmp_path, "--trainer.max_time=00:00:00:05")
    checkpoint = torch.load(next(tmp_path.rglob("last.ckpt")), weights_only=False)
    assert checkpoint["global_step"] > 0
    assert checkpoint["callbacks"]["Timer"]["time_elapsed"]["train"] >= 5
    rates = [group["lr"] for group in checkpoint["optimizer_states"][0]["param_groups"]]
    assert max(rates) < 1.5e-3  # they fall by the clock, which each group reads for itself


@pytest.mark.parametrize(
    "config", sorted(Path(__file__).parents[2].glob("configs/*.yaml")), ids=lambda path: path.stem
)
def test_the_last_checkpoint_is_of_the_last_step(config):
    """A link would lead to the last one that was due, minutes before the end of a run that its time ends."""
    callbacks = (yaml.safe_load(config.read_text()).get("trainer") or {}).get("callbacks", [])
    for each in callbacks:
        if each["class_path"].endswith("ModelCheckpoint"):
            assert each["init_args"]["save_last"] is True


def test_a_share_of_the_blocks_are_far_views_with_as_many_pixels(instant):
    """Which ones, the seed decides: a run that is resumed has the same."""
    stages = [Stage(1.0, (96, 160), 4)]
    arguments = (lambda _: 0.0, stages, 1, 2, ViewConfig(), WindowConfig(), (3, 0))
    seen = list(itertools.islice(LiveBatches(*arguments, 0, CPU, 64, 0.4), 10))
    sizes = [batch.image.shape[-2:] for batch in seen]
    assert set(sizes) == {(96, 160), (32, 224)}
    assert sizes[::2] == sizes[1::2], "expected one size for the batches of a block"
    assert {len(batch.image) for batch in seen if batch.image.shape[-2] == 32} == {9}
    later = next(iter(LiveBatches(*arguments, 7, CPU, 64, 0.4)))
    assert torch.equal(later.image, seen[7].image)
    without = itertools.islice(LiveBatches(*arguments, 0, CPU, 64, 0.0), 10)
    assert {batch.image.shape[-2:] for batch in without} == {(96, 160)}


@pytest.mark.slow
def test_far_views_show_the_road_about_the_horizon():
    far = far_stage(Stage(1.0, (192, 320), 1))
    views = random_views(4, far.size, (8,), CPU, WindowConfig(scale=(0.7, 0.7), horizon=(0.1, 0.3)), 64)
    assert views.image.shape == (4, 3, 64, 320)
    inside = (views.points >= 0).all(-1) & (views.points[..., 1] < 64) & (views.points[..., 0] < 320)
    assert (inside & views.painted).any(-1).sum() >= 8, "expected boundaries in view"
    farthest = torch.where(views.painted & inside, views.points[..., 1], torch.inf).flatten(1).amin(1)
    assert bool((farthest < 32).all()), "expected the road's end in the upper half"


@pytest.mark.parametrize(
    ("share", "window", "match"), [(1.5, WindowConfig(), "0 to 1, got 1.5"), (0.2, None, "window")]
)
def test_impossible_shares_of_far_views_are_refused(share, window, match):
    with pytest.raises(ValueError, match=match):
        LiveRoads(STAGES, window=window, far_share=share)
