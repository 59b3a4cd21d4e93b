"""Rotated versions of a video: the poses expected of them, and that estimates follow."""

import cv2
import pytest
import torch

from lanebev import BEVWarp, Camera, Extrinsics, LaneBEV
from lanebev.observation.frames import image_bytes
from lanebev.render import Drive
from tools import evaluate_rotated
from tools.evaluate_rotated import ROTATIONS, Poses, follow, rotations, table, turned_pose, views


def test_the_pose_of_a_turned_level_camera_is_the_rotation():
    level = torch.tensor([0.0, 0.0, 0.0, 1.4], dtype=torch.float64)
    found = turned_pose(level, rotations(ROTATIONS))
    assert torch.allclose(found[:, :3].rad2deg(), torch.tensor(ROTATIONS, dtype=torch.float64), atol=1e-9)
    assert found[:, 3].tolist() == [1.4] * len(ROTATIONS)


@pytest.mark.parametrize("row", range(len(ROTATIONS)))
def test_the_turned_camera_sees_the_same_road(row):
    camera = Camera.from_parameters(fx=160, fy=160, cx=95.5, cy=63.5, width=192, height=128)
    smooth = torch.nn.functional.interpolate(
        torch.rand(1, 3, 4, 6, generator=torch.Generator().manual_seed(1)), (128, 192), mode="bicubic"
    ).clamp(0, 1)
    turned = evaluate_rotated._turned(views(camera)[1 + row], smooth, camera)
    before = torch.tensor([0.05, 0.02, -0.01, 1.5], dtype=torch.float64)
    after = turned_pose(before, rotations(ROTATIONS)[row])
    warp, intrinsics = BEVWarp(), camera.intrinsics[None].float()
    (one, seen), (other, seen_turned) = (
        warp(image, intrinsics, Extrinsics.unstack(pose[None].float()))
        for image, pose in ((smooth, before), (turned, after))
    )
    black = torch.nn.functional.max_pool2d((other == 0).all(1, keepdim=True).float(), 5, 1, 2) > 0
    both = (seen & seen_turned & ~black).expand_as(one)
    assert both.float().mean() > 0.05
    assert float((one - other)[both].abs().quantile(0.9)) < 0.01  # not at the border of the turned image


def test_estimates_follow_the_rotations(tmp_path, monkeypatch):
    drive = Drive(5, (180, 320), 3, 30.0)
    for number, image in enumerate(image_bytes(drive.frames(range(3)).image)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image[..., ::-1])
    camera = drive.camera
    monkeypatch.setattr(evaluate_rotated, "WARM_UP", 0.0)
    found = follow(LaneBEV.from_pretrained(), str(tmp_path), camera, 3.7, every=2)
    assert found.pose.shape == (2, 1 + len(ROTATIONS), 4)
    assert found.times.tolist() == pytest.approx([0.0, 2 / 30])
    expected = turned_pose(found.pose[:, :1], rotations(ROTATIONS))
    assert float((found.pose[:, 1:3] - expected[:, :2])[..., :2].abs().max()) < 0.01
    assert len(table(found)) == 2 + len(ROTATIONS)


def test_the_table_has_rms_and_sigmas():
    rows = 1 + len(ROTATIONS)
    base = torch.tensor([0.01, 0.0, 0.0, 1.5], dtype=torch.float64)
    pose = torch.cat([base[None], turned_pose(base, rotations(ROTATIONS))])
    pose[1, 3] += 0.02
    found = Poses(
        pose.expand(2, rows, 4),
        torch.full((2, rows, 4), 0.01),
        torch.ones(2, rows).long(),
        torch.tensor([0.0, 1.0]),
    )
    lines = table(found)
    assert "| +3° 0 0 | 100 % | 0.000° 0.000° 0.000° 2.0 cm | 0.0 0.0 0.0 2.0 |" in lines
