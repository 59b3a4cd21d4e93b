"""Recall, error and false claims by group, on maps of known answers."""

import math
from types import SimpleNamespace

import pytest
import torch

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.render import render_views
from train import evaluate_roads
from train.evaluate_roads import Sums, add_up, evaluate, groups, judge_rows, records
from train.labels import ViewConfig
from train.maps import boundaries_as_taken, label_maps

SIZE = (64, 96)
VIEW = ViewConfig()


@pytest.fixture(scope="module")
def frame():
    return render_views(2, SIZE, torch.Generator().manual_seed(6), kind="highway")


@pytest.fixture(scope="module")
def perfect(frame):
    """Logits whose softmax is the label."""
    points = boundaries_as_taken(frame)
    target, _ = label_maps(points, frame.painted > 0.5, frame.visible > 0.5, SIZE, VIEW)
    return torch.cat([1 - target.sum(1, keepdim=True), target], dim=1).clamp(min=1e-6).log()


def total(rows):
    return add_up(rows, torch.ones_like(rows.there))


def test_labels_find_themselves(frame, perfect):
    rows = judge_rows(perfect, frame, VIEW)
    sums = total(rows)
    assert sums.there == sums.found > 20
    assert sums.false == 0
    assert math.sqrt(sums.squares / sums.found) < 0.01
    assert (rows.distance[rows.there] > 0).all()


def test_labels_two_px_to_the_side_are_found_two_px_off(frame, perfect):
    moved = torch.cat([perfect[..., :1], perfect[..., :-1]], dim=-1)  # one label px
    sums = total(judge_rows(moved, frame, VIEW))
    assert sums.found > 0.9 * sums.there
    assert math.sqrt(sums.squares / sums.found) == pytest.approx(2, abs=0.3)


def test_nothing_is_not_found_and_everywhere_is_false(frame, perfect):
    nothing = torch.full_like(perfect, -10.0)
    nothing[:, 0] = 10.0
    assert total(judge_rows(nothing, frame, VIEW)).found == 0
    claimed = perfect.clone()
    claimed[:, 3, :, 10:16] = 20.0
    assert total(judge_rows(claimed, frame, VIEW)).false > 0


def test_groups_of_a_kind_split_its_rows(frame, perfect):
    rows = judge_rows(perfect, frame, VIEW)
    whole = total(rows).there
    by = {}
    for (name, _), mask in groups(rows, "highway").items():
        by[name] = by.get(name, 0) + add_up(rows, mask).there
    assert by == dict.fromkeys(("kind", "boundary", "distance_m", "brightness"), whole)


def test_figures_of_no_rows_are_no_numbers():
    assert all(math.isnan(Sums().figures()[name]) for name in ("recall", "error_px", "false"))


def test_evaluates_a_network():
    torch.manual_seed(0)
    network = LaneSegmenter(SegmenterConfig(base_width=4, decoder_width=4, image_size=(48, 80))).eval()
    found = evaluate(network, 1, ["highway"], 3, 1)
    assert found["kind", "highway"].there > 0


def test_kinds_take_turns_until_the_time_is_up(monkeypatch):
    clock = iter(range(0, 1000, 10))  # each batch takes 10 s
    monkeypatch.setattr(evaluate_roads, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    begun = []
    render = evaluate_roads.render_views
    monkeypatch.setattr(
        evaluate_roads, "render_views", lambda *a, **k: begun.append(k["kind"]) or render(*a, **k)
    )
    network = LaneSegmenter(SegmenterConfig(base_width=4, decoder_width=4, image_size=(48, 80))).eval()
    found = evaluate(network, 9, ["highway", "night"], 3, 1, deadline=35.0)
    assert begun == ["highway", "night", "highway"]  # a fourth would end at 40
    assert {record["name"] for record in records(found) if record["by"] == "kind"} == {"highway", "night"}
