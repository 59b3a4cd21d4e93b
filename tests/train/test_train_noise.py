"""The factor on a network's sigmas, measured on drives."""

import math

import pytest
import torch

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.testing.moments import CAMERA, FPS, WIDTH, moments
from lanebev.testing.moments import observe as see
from train.drives import DriveObservations, observe_drive
from train.noise import Summary, figures, main, outcome, summaries


@pytest.fixture(scope="module")
def drive():
    """Errors of 2 px that are said to be 1 px."""
    course = list(see(moments(1.0), 1, 2.0, 12, 0, torch.float64))
    segments = [seen._replace(sigma=torch.ones_like(seen.sigma)) for _, seen in course]
    poses = torch.tensor([moment.pose for moment, _ in course], dtype=torch.float64)
    width = [torch.full((1, 5), WIDTH, dtype=torch.float64)] * len(course)
    return DriveObservations(segments, width, poses, CAMERA[None], 1 / FPS)


@pytest.mark.slow
def test_sigmas_half_as_large_as_the_errors_are_found_out(drive):
    report = summaries([drive], (1.0, 2.0, 8.0))
    assert 0.5 < report[2.0].nees < 1.6  # one second is some ten independent errors an axis
    assert report[1.0].nees > report[2.0].nees > 2 * report[8.0].nees  # at 8 px it lags behind the swing
    assert (report[2.0].rmse < torch.tensor([0.05, 0.15, 0.1, 1.0])).all()


def test_watches_a_rendered_drive_through_a_network_without_its_factor():
    torch.manual_seed(0)
    config = SegmenterConfig(base_width=4, decoder_width=4, image_size=(64, 96), sigma_scale=3.0)
    (seen,) = observe_drive([LaneSegmenter(config).eval()], 5, 2, 20.0)
    assert len(seen.segments) == 2
    assert seen.poses.shape == (2, 4)
    assert math.isnan(outcome(seen, 1.0).nees)  # no frame after the warm-up


def test_what_no_frame_tells_is_null_in_json():
    unknown = torch.tensor(math.nan)
    said = figures(Summary(torch.tensor([1.0, 2.0, 3.0, math.nan]), torch.tensor(4.0), unknown))
    assert list(said.values()) == [1.0, 2.0, 3.0, None, 4.0, 2.0, None]


def test_no_frames_after_the_warm_up_are_refused_before_any_is_rendered(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["noise", "none.safetensors", "--frames=10"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert capsys.readouterr().err == (
        "error: --frames: expected more than 10, which are not evaluated, got 10\n"
    )
