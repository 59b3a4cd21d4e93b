"""Interpolated sampling maps against those computed cell by cell, and what is not interpolated."""

import itertools
import os
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics
from lanebev.view.blocks import blocks
from lanebev.view.cells import cells_and_lens
from lanebev.view.projection import image_coordinates, normalised_intrinsics, outside_image
from lanebev.view.sampling import MapSize, sampling_maps
from lanebev.view.thread_limits import small_products
from lanebev.view.tiles import (
    LARGEST_WEIGHTS,
    column_tiles,
    equal_edges,
    interpolant,
    interpolation,
    road_edges,
    row_tiles,
    tile_bounds,
    tile_nodes,
)

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
    seen = (
        torch.cat(
            [
                torch.zeros_like(block.points[:, 0]) if block.outside is None else block.outside
                for block in found
            ],
            dim=1,
        )
        == 0
    )
    assert (seen == outside).double().mean() < 1e-4  # on the edge itself
    assert (~outside).double().mean() > 0.01


@pytest.mark.parametrize("lens", LENSES)
def test_most_tiles_of_a_usual_view_are_interpolated_and_seen_as_a_whole(lens):
    cells, model = prepared(lens, USUAL, torch.float32)
    curves = interpolant(cells, model, 0.999)
    rows = np.diff(curves.rows.edges)
    assert curves.smooth.mean(0) @ rows >= 0.75 * GRID.shape[0]  # at 8 cm; more of a finer grid
    assert curves.inside @ rows >= 0.5 * GRID.shape[0]
    _, outside = exact(lens, USUAL)
    for first, last, inside in zip(curves.rows.edges, curves.rows.edges[1:], curves.inside, strict=False):
        assert not (inside and outside[:, first:last].any())


def test_cells_beyond_a_fold_are_interpolated_and_not_seen():
    """By a lens that images them beside those that it shows."""
    fine = BEVGrid(x=(-10.24, 10.24), z=(3.0, 43.96), resolution=0.04)
    cells, model = prepared("8 coefficients", USUAL[:1], torch.float32, fine)
    curves = interpolant(cells, model, 0.999)
    assert curves.smooth.all()
    assert curves.folds.any()
    _, hidden = image_coordinates(cells.rows(0, fine.shape[0]), model)
    found = [curves.hidden(tile, slice(None)) for tile in range(len(curves.folds))]
    for tile, (first, last) in enumerate(itertools.pairwise(curves.rows.edges)):
        expected = hidden[:, first:last]
        if found[tile] is None:
            assert (expected == 0).all()
        else:
            assert (found[tile] != expected).double().mean() < 1e-4  # on the fold itself
    assert max(part.mean() for part in found if part is not None) > 0.1


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


@pytest.mark.parametrize("columns", [64, 65, 90, 128, 401, 1140])
def test_tiles_cover_all_columns(columns):
    tiles = column_tiles(columns, 64)
    nodes = tiles.nodes.reshape(-1, 12)
    assert nodes[0, 0] == 0
    assert nodes[-1, -1] == columns - 1
    assert (np.diff(nodes, axis=1) > 0).all()
    assert len(nodes) * tiles.size - tiles.overlap == columns
    assert column_tiles(35, 64) is None


@pytest.mark.parametrize("rows", [20, 36, 71, 73, 1024])
def test_tiles_cover_all_rows_and_are_in_proportion_to_their_depth(rows):
    edges = np.array(road_edges(3.0 + 0.04 * rows, 0.04, rows))
    assert (edges[0], edges[-1]) == (0, rows)
    depth = 3.0 + 0.04 * (rows - edges)
    assert (depth[1:-1] <= 1.5 * depth[2:] + 1e-9).all()
    assert (np.diff(edges) >= min(rows, 36)).all()
    assert len(edges) <= 8
    tiles = row_tiles(tuple(edges.tolist()))
    if rows < 36:
        assert tiles is None
    else:
        assert set(edges[:-1]) | set(edges[1:] - 1) <= set(tiles.nodes)
    assert sum(np.diff(equal_edges(rows))) == rows


def test_rows_behind_the_camera_are_divided_too():
    edges = np.diff(road_edges(4.0, 0.1, 200))
    assert edges.min() >= 36
    assert edges.sum() == 200


def test_interpolation_reproduces_polynomials_and_finds_their_coefficients():
    nodes = tile_nodes(40, 6)
    weights, coefficients = interpolation(40, nodes)
    t = np.linspace(-1, 1, 40)
    np.testing.assert_allclose(weights @ (t**5 - 2 * t**3)[nodes], t**5 - 2 * t**3, atol=1e-12)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    fourth = 8 * t**4 - 8 * t**2 + 1  # Chebyshev polynomial of degree 4
    np.testing.assert_allclose(coefficients @ fourth[nodes], [0, 0, 0, 0, 1, 0], atol=1e-12)


def test_weights_of_a_cell_are_bounded():
    sums = [np.abs(interpolation(size, tile_nodes(size, 12))[0]).sum(1).max() for size in range(36, 400)]
    assert 2 < max(sums) < LARGEST_WEIGHTS


def test_small_products_are_those_of_the_whole(monkeypatch):
    """Of matrices in place, too, and of rows that are more than one product may have."""
    rng = np.random.default_rng(0)
    left, right = (rng.normal(size=shape).astype(np.float32) for shape in ((50, 12), (3, 2, 12, 700)))
    sizes = []
    multiply = np.matmul
    monkeypatch.setattr(np, "matmul", lambda a, b, out: sizes.append(len(a)) or multiply(a, b, out=out))
    out = np.zeros((3, 2, 60, 700), np.float32)
    small_products(left, right, out[:, :, 5:55])
    np.testing.assert_allclose(out[:, :, 5:55], left @ right, atol=1e-5)
    assert (out[:, :, :5] == 0).all()
    assert (out[:, :, 55:] == 0).all()
    assert sizes == [31, 19]  # 31 x 12 x 700 are just below 2 ** 18
    np.testing.assert_allclose(small_products(left, right[0]), left @ right[0], atol=1e-5)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no list of threads and their times")
@pytest.mark.parametrize("lens", LENSES)
def test_one_thread_computes_where_to_sample(lens):
    """PyTorch's and BLAS's would wait for each other at every short operation."""

    def others_time():
        tasks = Path("/proc/self/task").glob("*/schedstat")
        return sum(int(each.read_text().split()[0]) for each in tasks if each.parent.name != str(os.getpid()))

    def computed():
        with torch.no_grad():
            sampling_maps(*prepared(lens, USUAL, torch.float32), [MapSize(*SIZE)], SIZE)

    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        computed()  # makes constants
        started = others_time()
        torch.rand(1 << 17).sin_()
        more = []
        for _ in range(5):  # a thread of another test may run meanwhile, but not each time
            time.sleep(0.05)  # until the others no longer wait busily
            before = others_time()
            computed()
            more.append(others_time() - before)
        assert before > started
        assert min(more) == 0
    finally:
        torch.set_num_threads(threads)


def test_a_grid_of_few_cells_is_computed_cell_by_cell():
    cells, model = prepared("none", USUAL, torch.float32, BEVGrid((-4.0, 4.0), (5.0, 25.0), 0.5))
    assert interpolant(cells, model, 0.999) is None


def test_a_tile_is_bounded_by_its_coefficients():
    rows, columns = row_tiles((0, 40)), column_tiles(50, 64)
    y, x = (np.linspace(-1, 1, side)[tile_nodes(side, 12)] for side in (40, 50))
    low = (2 * y[:, None] ** 2 - 1) * x  # T2(y) T1(x)
    high = np.polynomial.chebyshev.chebval(x, [0] * 10 + [3]) + 0 * y[:, None]  # 3 T10(x)
    values = np.stack([low + high, low + 9]).astype(np.float32)[None, :, None, :, None, :]
    error, most, least = (bound.item() for bound in tile_bounds(values, rows, columns))
    assert error == pytest.approx(3, abs=1e-4)
    assert most == pytest.approx(10, abs=1e-4)
    assert least == pytest.approx(8, abs=0.05)  # of y, at the node nearest to where low is -1
