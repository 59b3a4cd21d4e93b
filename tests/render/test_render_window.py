"""Windows: other intrinsics, the same truth."""

import pytest
import torch

from lanebev.geometry.lens import denormalise_points, distort_points
from lanebev.geometry.rotation import vanishing_dir_from_pitch_yaw
from lanebev.render import RenderedFrame, WindowConfig, render_views

SIZE = (64, 112)


def horizon_row(frame: RenderedFrame) -> torch.Tensor:
    """Height of the vanishing point as taken, (B,) share of the image from the top."""
    direction = vanishing_dir_from_pitch_yaw(frame.extrinsics.pitch, frame.extrinsics.yaw)
    ideal = denormalise_points((direction[:, :2] / direction[:, 2:])[:, None], frame.intrinsics)
    taken = distort_points(ideal, frame.intrinsics, frame.distortion)
    return (taken[:, 0, 1] + 0.5) / frame.image.shape[2]


def test_windows_lie_about_the_horizon_at_the_scales_asked_for() -> None:
    config = WindowConfig(scale=(0.5, 0.6), stretch=0.0, horizon=(0.1, 0.2))
    whole = render_views(6, SIZE, torch.Generator().manual_seed(3), ideal_sensor=True)
    frame = render_views(6, SIZE, torch.Generator().manual_seed(3), window=config, ideal_sensor=True)
    row = horizon_row(frame)
    assert row.min() > 0.1 - 1e-3
    assert row.max() < 0.2 + 1e-3
    scale = whole.intrinsics[:, 0, 0] / frame.intrinsics[:, 0, 0]
    assert scale.min() >= 0.5 - 1e-6
    assert scale.max() <= 0.6 + 1e-6
    torch.testing.assert_close(scale, whole.intrinsics[:, 1, 1] / frame.intrinsics[:, 1, 1])
    assert torch.equal(whole.distortion, frame.distortion)
    assert torch.equal(whole.extrinsics.pitch, frame.extrinsics.pitch)


def test_points_of_a_window_are_those_of_the_whole_image_by_its_intrinsics() -> None:
    """Undistorted, a window is an affine map of the whole image."""
    whole = render_views(3, SIZE, torch.Generator().manual_seed(5), ideal_sensor=True)
    frame = render_views(3, SIZE, torch.Generator().manual_seed(5), window=WindowConfig(), ideal_sensor=True)
    matrix = frame.intrinsics @ torch.linalg.inv(whole.intrinsics)
    # the first point is the nearest road in the image and differs: compare the farthest
    far = whole.boundaries[:, :, -1] @ matrix[:, :2, :2].mT + matrix[:, None, :2, 2]
    torch.testing.assert_close(frame.boundaries[:, :, -1], far, atol=0.02, rtol=1e-4)


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ({"scale": (0.0, 1.0)}, "scale: expected 0 < low <= high"),
        ({"horizon": (0.5, 0.1)}, "horizon: expected low <= high"),
        ({"stretch": -0.1}, "stretch, shift >= 0"),
    ],
)
def test_impossible_windows_are_refused(values: dict[str, tuple[float, float]], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        WindowConfig(**values)  # type: ignore[arg-type]
