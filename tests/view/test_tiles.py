"""Interpolated sampling maps against those computed cell by cell, and what is not interpolated."""

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics
from lanebev.view.blocks import blocks
from lanebev.view.cells import cells_and_lens
from lanebev.view.projection import image_coordinates, normalised_intrinsics, outside_image
from lanebev.view.tiles import axis_tiles, interpolant, interpolation, tile_coefficients, tile_nodes

SIZE = (1020, 1920)
GRID = BEVGrid(x=(-10.24, 10.24), z=(3.0, 43.96), resolution=0.08)  # 512 x 256
LENSES = {
    "none": ((), "pinhole"),
    "5 coefficients": ((-0.2, 0.03, 0.001, -0.001, 0.005), "pinhole"),
    "that folds over": ((-0.35, 0.12, 0.001, -0.001, -0.02), "pinhole"),
    "8 coefficients": ((-0.2, 0.03, 0.001, -0.001, 0.005, 0.1, 0.05, 0.01), "pinhole"),
    "fisheye": ((-0.05, 0.01, -0.003, 0.001), "fisheye"),
    "omni": ((0.9, -0.2, 0.03, 0.001, -0.001), "omni"),
}
USUAL = [[0.03, 0.02, 0.01, 1.5], [-0.02, 0.1, 0.05, 1.2]]
WILD = [[-0.4, 0.3, 0.2, 1.4], [0.2, -1.2, 0.1, 0.02], [0.9, 0.0, 0.0, 1.5], [0.1, 0.0, 0.0, -1.0]]


def prepared(lens, values, dtype, grid=GRID):
    """Cells and lens of a batch of poses."""
    camera = Camera.from_parameters(1050, 1050, 959.5, 509.5, SIZE[1], SIZE[0], *LENSES[lens])
    poses = torch.tensor(values, dtype=dtype)
    intrinsics = normalised_intrinsics(camera.intrinsics.to(dtype), SIZE).expand(len(poses), 3, 3)
    distortion = camera.distortion.to(dtype).expand(len(poses), -1)
    return cells_and_lens(grid, intrinsics, Extrinsics.unstack(poses), distortion, camera.model, dtype)


def exact(lens, values, grid=GRID):
    """Points and what is outside, cell by cell in double precision."""
    cells, model = prepared(lens, values, torch.float64, grid)
    points, hidden = image_coordinates(cells.rows(0, grid.shape[0]), model)
    return points, outside_image(points, hidden) > 0


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("values", [USUAL, WILD], ids=["usual", "wild"])
def test_interpolated_cells_are_as_exact_as_float32_cell_by_cell(lens, values):
    """Near the camera, at the image's border, behind the camera and beyond a fold too."""
    grid = GRID if values is USUAL else BEVGrid(x=(-10.24, 10.24), z=(-6.0, 34.96), resolution=0.08)
    points, outside = exact(lens, values, grid)
    cells, model = prepared(lens, values, torch.float32, grid)
    found = list(blocks(cells, model, 0.999))
    assert [block.first for block in found] == [0, *(block.last for block in found[:-1])]
    assert found[-1].last == grid.shape[0]
    by_cell, _ = image_coordinates(cells.rows(0, grid.shape[0]), model)  # what float32 itself rounds
    off, rounded = (
        (each.double() - points).norm(dim=1)[~outside].max() * SIZE[1] / 2
        for each in (torch.cat([block.points for block in found], dim=2), by_cell)
    )
    assert off < rounded + 4e-4  # px
    assert off < (2e-3 if values is USUAL else 0.02)  # some of the wild are 2 cm over the road
    valid = torch.cat([block.valid() for block in found], dim=1)
    assert (valid == outside).double().mean() < 1e-4  # on the edge itself
    assert (~outside).double().mean() > 0.01


@pytest.mark.parametrize("lens", LENSES)
def test_most_tiles_of_a_usual_view_are_interpolated_and_seen_as_a_whole(lens):
    cells, model = prepared(lens, USUAL, torch.float32)
    curves = interpolant(cells, model, 0.999)
    assert curves.smooth.mean() >= 0.75  # at 8 cm; more of a finer grid
    assert sum(curves.inside) >= 0.5 * len(curves.inside)
    _, outside = exact(lens, USUAL)
    for tile, inside in enumerate(curves.inside):
        assert not (inside and outside[:, curves.row(tile) : curves.row(tile + 1)].any())


def test_a_row_of_the_batch_does_not_depend_on_the_others():
    values = [USUAL[0], WILD[1], WILD[3]]
    cells, model = prepared("that folds over", values, torch.float32)
    together = torch.cat([block.points for block in blocks(cells, model, 0.999)], dim=2)
    for row, pose in enumerate(values):
        cells, model = prepared("that folds over", [pose], torch.float32)
        alone = torch.cat([block.points for block in blocks(cells, model, 0.999)], dim=2)
        seen = alone[0].abs() < 1
        assert torch.allclose(together[row][seen], alone[0][seen], atol=1e-6, rtol=0)


def test_gradients_of_interpolated_maps_are_those_of_exact_ones():
    """Of an image of two ramps: those of others jump from pixel to pixel."""
    y, x = torch.meshgrid(
        *(torch.linspace(0, 1, side, dtype=torch.float64) for side in (51, 96)), indexing="ij"
    )
    image = torch.stack([x, y])[None]
    camera = Camera.from_parameters(1050, 1050, 959.5, 509.5, SIZE[1], SIZE[0])
    weight = torch.rand(1, 2, *GRID.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = []
    for dtype in (torch.float32, torch.float64):
        inputs = [
            torch.tensor([values], dtype=dtype, requires_grad=True)
            for values in (USUAL[0], LENSES["5 coefficients"][0])
        ]
        pose, distortion = inputs
        taken, ideal = image.to(dtype), camera.intrinsics[None].to(dtype)
        bev, _ = BEVWarp(GRID)(taken, ideal, Extrinsics.unstack(pose), distortion, image_size=SIZE)
        found.append(torch.autograd.grad((bev * weight.to(dtype)).sum(), inputs))
    for single, double in zip(*found, strict=True):
        torch.testing.assert_close(single.double(), double, rtol=1e-3, atol=1e-4 * double.abs().max().item())


@pytest.mark.parametrize("cells", [64, 65, 90, 128, 401, 1140])
def test_tiles_cover_an_axis(cells):
    axis = axis_tiles(cells, 64, 10)
    assert axis.nodes[0, 0] == 0
    assert axis.nodes[-1, -1] == cells - 1
    assert (np.diff(axis.nodes, axis=1) > 0).all()
    assert len(axis.nodes) * axis.size - axis.overlap == cells
    assert axis_tiles(19, 64, 10) is None


def test_interpolation_reproduces_polynomials_and_finds_their_coefficients():
    nodes = tile_nodes(40, 6)
    weights, coefficients = interpolation(40, nodes)
    t = np.linspace(-1, 1, 40)
    np.testing.assert_allclose(weights @ (t**5 - 2 * t**3)[nodes], t**5 - 2 * t**3, atol=1e-12)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    fourth = 8 * t**4 - 8 * t**2 + 1  # Chebyshev polynomial of degree 4
    np.testing.assert_allclose(coefficients @ fourth[nodes], [0, 0, 0, 0, 1, 0], atol=1e-12)


def test_a_grid_of_few_cells_is_computed_cell_by_cell():
    cells, model = prepared("none", USUAL, torch.float32, BEVGrid((-4.0, 4.0), (5.0, 25.0), 0.5))
    assert interpolant(cells, model, 0.999) is None


def test_coefficients_of_a_tile_are_those_of_its_polynomial_highest_degrees_last():
    rows, columns, nodes = 40, 50, 6
    x, y = (np.linspace(-1, 1, side)[tile_nodes(side, nodes)] for side in (columns, rows))
    values = (2 * y[:, None] ** 2 - 1) * x[None] + 3 * (
        16 * x**5 - 20 * x**3 + 5 * x
    )  # T2(y) T1(x) + 3 T5(x)
    found = values.reshape(-1) @ tile_coefficients(rows, nodes, columns, nodes)
    expected = np.zeros(nodes * nodes)
    expected[2 * 4 + 1] = 1  # of the 4 x 4 lower degrees, row by row
    expected[16 + 1] = 3  # after them: degree 0 of y, 5 of x
    np.testing.assert_allclose(found, expected, atol=1e-5)
