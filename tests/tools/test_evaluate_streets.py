"""The truth of the street images and what is made of the estimates."""

import math

import pytest
import torch

from lanebev import JointCalibrator, LaneBEV, LaneSegmenter, LineExtractor
from lanebev.geometry.rotation import road_from_cam
from lanebev.observation.segmenter import SegmenterConfig
from tools import evaluate_streets
from tools.evaluate_streets import kitti_truth
from tools.single_images import Answer, median_interval, plane_angles, summarise


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.03, -0.05), (-0.1, 0.2)])
def test_plane_angles_are_those_of_the_pose_at_zero_yaw(pitch, roll):
    angles = (torch.tensor([value], dtype=torch.float64) for value in (pitch, 0.0, roll))
    found = plane_angles(road_from_cam(*angles)[0, 1])
    assert found.tolist() == pytest.approx([pitch, roll], abs=1e-12)


def test_the_truth_is_the_second_row_of_the_calibration(tmp_path):
    file = tmp_path / "calib.txt"
    down = [math.sin(0.02), math.cos(0.02), 0.0]
    matrix = [1, 0, 0, 0, *down, -1.6, 0, 0, 1, 0]
    file.write_text("P2: 1 2 3\nTr_cam_to_road: " + " ".join(map(str, matrix)) + "\n")
    assert kitti_truth(file).tolist() == pytest.approx([0.0, -0.02])


def test_summary_counts_images_within_three_sigma():
    def answer(pitch, roll, sigma):
        plane = torch.tensor([pitch, roll], dtype=torch.float64)
        return Answer("", plane, torch.full((2,), sigma, dtype=torch.float64), 1.5, 0.1, sigma < 0.5)

    answers = [answer(0.1, 0.0, 0.1), answer(0.4, 0.2, 0.1), answer(0.5, 2.0, 1.0)]
    figures = summarise(answers, torch.zeros(3, 2, dtype=torch.float64))
    assert figures["tracking"] == 2
    assert figures["pitch_median_deg"] == pytest.approx(0.4)
    assert figures["pitch_within_3_sigma"] == pytest.approx(2 / 3)
    assert figures["roll_within_3_sigma"] == pytest.approx(1.0)
    assert figures["roll_worst_deg"] == pytest.approx(2.0)


def test_the_interval_of_a_median_holds_it_19_times_in_20():
    generator = torch.Generator().manual_seed(1)
    low, high = median_interval(torch.randn(27, 4000, generator=generator))
    held = ((low <= 0) & (high >= 0)).double().mean()
    assert 0.97 < held < 0.99  # 0.981; of one order statistic less on either side 0.948, of one more 0.994
    assert median_interval(torch.tensor([[3.0], [1.0]])) == (1.0, 3.0)


def test_rendered_views():
    """A network that has learned nothing sees nothing: the answer is the prior's."""
    config = SegmenterConfig(base_width=8, decoder_width=8, image_size=(64, 192))
    torch.manual_seed(1)
    model = LaneBEV(LaneSegmenter(config), LineExtractor.for_network(config), JointCalibrator()).eval()
    figures = evaluate_streets.rendered(model, 2, (64, 192))
    assert (figures["images"], figures["tracking"]) == (2, 0)
    assert figures["pitch_within_3_sigma"] == 1.0
