import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from lanebev.io.lanes.parsing import FrameLines
from lanebev.observation.polylines import BoundaryRows, LaneLine
from train.__main__ import main
from train.data import Batch, ViewBatches
from train.datasets import EntryFrames, LaneFiles, ScoredBatch, check_labels, labelled_image, read_entries
from train.labels import ViewConfig
from train.scores import DRAWN, BenchmarkScores, drawn_counts

HEIGHT, WIDTH = 360, 640
ROWS = list(range(90, 360, 10))
FEET = (-200, 160, 480, 850)  # where four lines through (320, 60) meet the image's bottom


def line_x(foot, y):
    return 320 + (foot - 320) * (y - 60) / (HEIGHT - 60)


def lanes():
    """x on ROWS, -2 outside the image."""
    x = [[line_x(foot, y) for y in ROWS] for foot in FEET]
    return [[round(v, 2) if 0 <= v < WIDTH else -2 for v in lane] for lane in x]


def points():
    return [[(x, y) for x, y in zip(lane, ROWS, strict=True) if x >= 0] for lane in lanes()]


@pytest.fixture
def root(tmp_path):
    """Two images in all three layouts."""
    for k in range(2):
        image = np.full((HEIGHT, WIDTH, 3), 60 + k, np.uint8)
        for line in points():
            cv2.polylines(image, [np.rint(line).astype(np.int32)], False, (255, 255, 255), 3)
        for folder in ("clips/a", "driver", "images/validation/s"):
            (tmp_path / folder).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(tmp_path / folder / f"{k}.jpg"), image)
        text = "\n".join(" ".join(f"{x:.3f} {y}" for x, y in reversed(line)) for line in points())
        (tmp_path / "driver" / f"{k}.lines.txt").write_text(text)
        uv = [{"category": 1, "uv": [list(axis) for axis in zip(*line, strict=True)]} for line in points()]
        labels = tmp_path / "lane3d/validation/s"
        labels.mkdir(parents=True, exist_ok=True)
        frame = {"file_path": f"validation/s/{k}.jpg", "lane_lines": uv}
        (labels / f"{k}.json").write_text(json.dumps(frame))
    entries = [{"raw_file": f"clips/a/{k}.jpg", "lanes": lanes(), "h_samples": ROWS} for k in range(2)]
    (tmp_path / "label.json").write_text("\n".join(json.dumps(entry) for entry in entries))
    (tmp_path / "list.txt").write_text("/driver/0.jpg /laneseg/0.png 1 1 1 1\n/driver/1.jpg\n")
    return tmp_path


LAYOUTS = [("tusimple", "label.json"), ("culane", "list.txt"), ("openlane", "lane3d/validation")]


@pytest.mark.parametrize(("layout", "name"), LAYOUTS)
def test_layouts_give_the_same_boundaries(root, layout, name):
    entries = read_entries(layout, root, [name])
    assert len(entries) == 2
    sample = labelled_image(entries[1])
    assert sample.image.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(sample.painted.any(-1), [False, True, True, True, True, False])
    for index, foot in zip(range(1, 5), FEET, strict=True):
        x, y = sample.points[index][sample.painted[index]].T
        assert len(x) > 2
        assert y[0] > y[-1]  # near to far
        np.testing.assert_allclose(x, line_x(foot, y), atol=0.01)


@pytest.mark.parametrize(("layout", "name"), LAYOUTS)
def test_data_module(root, layout, name):
    data = LaneFiles(layout, str(root), [name], [name], 2, [(64, 96)], (64, 96), workers=0)
    train = next(iter(data.train_dataloader()))
    assert isinstance(train, Batch)
    assert train.image.shape == (2, 3, 64, 96)
    (whole,) = data.val_dataloader()
    assert isinstance(whole, ScoredBatch)
    assert whole.image_sizes == [(HEIGHT, WIDTH)] * 2
    assert whole.views.target[:, 1:5].flatten(2).amax(-1).min() > 200


@pytest.mark.parametrize(("layout", "name"), LAYOUTS)
def test_labels_as_logits_score_full_marks(root, layout, name):
    (batch,) = LaneFiles(layout, str(root), val=[name], batch_size=2, val_size=(288, 512)).val_dataloader()
    target = batch.views.target.float() / 255
    logits = torch.cat([1 - target.sum(1, keepdim=True), target], dim=1).clamp(min=1e-6).log()
    scores = BenchmarkScores()
    scores.update(logits, (288, 512), batch)
    figures = scores.compute()
    if layout == "tusimple":
        assert figures["accuracy"] > 0.9  # a stripe's ends are left out
        assert (figures["false_positives"], figures["false_negatives"]) == (0, 0)
    else:
        assert figures == {"f1": 1.0}
    nothing = BenchmarkScores()
    nothing.update(torch.zeros_like(logits).index_fill(1, torch.tensor([0]), 10.0), (288, 512), batch)
    assert nothing.compute().get("accuracy", nothing.compute().get("f1")) == 0
    assert BenchmarkScores().compute() == {}


@pytest.mark.parametrize("stated", [(1, 3), (1,), (4,)])
def test_boundaries_that_a_file_states_are_taken(root, stated):
    """As a run takes them: nobody else knows that an inner one was not seen."""
    entry = read_entries("tusimple", root, ["label.json"])[0]
    lines = [line._replace(boundary=k) for line, k in zip(entry.lines.lines, stated, strict=False)]
    found = labelled_image(entry._replace(lines=entry.lines._replace(lines=lines)))
    assert np.flatnonzero(np.isfinite(found.points).any((1, 2))).tolist() == list(stated)


def test_a_cut_image_is_refused(root):
    entry = read_entries("tusimple", root, ["label.json"])[0]
    whole = entry.image.read_bytes()
    entry.image.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="expected a whole image"):
        labelled_image(entry)


@pytest.mark.parametrize(("layout", "found"), [("culane", 0), ("openlane", 1)])
def test_lanes_are_drawn_and_matched_as_their_benchmarks_do(layout, found):
    """Stripes 30 px wide that lie 15 px apart overlap by a third; a sixth boundary is not CULane's."""
    rules = DRAWN[layout]
    size = (rules.height, 2 * rules.height)
    rows = np.arange(0, rules.height, 10.0)
    place = np.linspace(0.2, 0.8, 6) * size[1]
    lines = [LaneLine(np.stack([np.full_like(rows, x), rows], -1)) for x in place[1:2]]
    drawn = np.full((6, len(rows)), np.nan)
    drawn[0], drawn[1] = place[0], place[1] + 15
    counts = drawn_counts(BoundaryRows(rows, drawn), FrameLines("", lines), size, layout)
    outer = int(layout == "openlane")  # all boundaries are labelled there
    assert counts == (found, 1 - found + outer, 1 - found)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Lightning about itself
def test_config_trains_and_prints_the_benchmarks_figures(root):
    here = [f"--trainer.default_root_dir={root}", f"--trainer.logger.init_args.save_dir={root}"]
    small = ["--model.init_args.network.base_width=4", "--model.init_args.network.decoder_width=4"]
    data = {"root": root, "train": "[label.json]", "val": "[label.json]", "batch_size": 2, "workers": 0}
    data |= {"sizes": "[[64,96]]", "val_size": "[64,96]"}
    given = [f"--data.init_args.{name}={value}" for name, value in data.items()]
    brief = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]
    once = ["--trainer.max_steps=1", "--trainer.val_check_interval=1", "--trainer.num_sanity_val_steps=0"]
    config = str(Path(__file__).parents[2] / "configs" / "tusimple.yaml")
    main(["fit", "--config", config, *here, *small, *given, *brief, *once])
    last = next(root.rglob("last.ckpt"))
    main(["test", "--config", config, *here, *small, *given, *brief, f"--ckpt_path={last}"])
    logged = "".join(path.read_text() for path in root.rglob("metrics.csv"))
    assert all(f"test/{name}" in logged for name in ("accuracy", "false_positives", "false_negatives"))


@pytest.mark.parametrize("workers", [0, 2])
def test_an_interrupted_run_goes_on_with_the_views_that_would_have_followed(root, workers):
    frames = EntryFrames(read_entries("tusimple", root, ["label.json"]))
    arguments = (frames, 1, [(64, 96), (96, 64)], ViewConfig(), (3, 0))
    threads = torch.get_num_threads()

    def batches(first, count):
        data = DataLoader(ViewBatches(*arguments, first), batch_size=None, num_workers=workers)
        return [batch.image for batch, _ in zip(data, range(count), strict=False)]

    whole, rest = batches(0, 7), batches(3, 4)
    assert torch.get_num_threads() == threads
    assert all(map(torch.equal, whole[3:], rest))
    assert not any(map(torch.equal, whole[:3], rest))


def test_errors(root):
    with pytest.raises(ValueError, match="expected a list of images"):
        read_entries("culane", root, ["none.txt"])
    with pytest.raises(ValueError, match="expected labelled images"):
        read_entries("openlane", root, ["clips"])
    with pytest.raises(ValueError, match="layout: expected tusimple"):
        read_entries("bdd", root, ["label.json"])
    (root / "clips/a/0.jpg").write_bytes(b"cut")
    entry = read_entries("tusimple", root, ["label.json"])[0]
    with pytest.raises(ValueError, match="expected a whole image, got: no image"):
        labelled_image(entry)
    line = LaneLine(np.zeros((0, 2)))
    blank = labelled_image(entry._replace(image=root / "driver/0.jpg", lines=FrameLines("a", [line])))
    assert not blank.painted.any()


def test_labels_in_pixels_of_other_images_are_noticed(root):
    entries = read_entries("culane", root, ["list.txt"])

    def scaled(factor, down=0.0):
        return [
            entry._replace(
                lines=entry.lines._replace(
                    lines=[
                        line._replace(points=line.points * factor - [0, down]) for line in entry.lines.lines
                    ]
                )
            )
            for entry in entries
        ]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_labels(entries)
    with pytest.raises(
        ValueError,
        match=r"driver/0 and others: lanes: .* of images of another size\? give the",
    ):
        check_labels(scaled(2.0))
    with pytest.warns(match=r"driver/0 and others: lanes: none of .*; of smaller images\? give the images"):
        check_labels(scaled(0.5))
    with pytest.warns(match=r"of images whose top was cut off\?"):
        check_labels(scaled(1.0, 70.0))


def test_labels_that_are_not_where_the_images_show_lines_are_noticed(root):
    entries = 10 * read_entries("culane", root, ["list.txt"])

    def moved(entry, by):
        lines = [line._replace(points=line.points + by) for line in entry.lines.lines]
        return entry._replace(lines=entry.lines._replace(lines=lines))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_labels(entries)
    with pytest.warns(
        match=r"driver/0 and others: lanes: the images show no edges along these lines; .* give the"
    ):
        check_labels([moved(entry, np.array([-25.0, 0.0])) for entry in entries])
    with pytest.raises(ValueError, match="none of the entries has a line"):
        check_labels([entry._replace(lines=entry.lines._replace(lines=[])) for entry in entries])
