"""Each part as ONNX equals eager, for batches that the example was not of, row by row, frame after frame."""

import pytest
import torch
from onnx import load as load_onnx
from onnxruntime import InferenceSession

from lanebev import (
    BEVGrid,
    BEVWarp,
    Camera,
    CanonicalView,
    Extrinsics,
    FarView,
    JointCalibrator,
    LaneBEV,
    LaneSegmenter,
    LineExtractor,
    SegmenterConfig,
    Status,
    TwoStageCalibrator,
)
from lanebev.batch import replace_rows
from lanebev.export.operators import translations
from lanebev.export.part import Part
from lanebev.export.parts import make_part
from lanebev.export.quantize import quantize_segmenter
from lanebev.export.runtime import OnnxPart, with_exported_step
from lanebev.export.state_parts import calibrator_part
from lanebev.export.write import export_program, write_onnx
from lanebev.tensors import constant
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes, no_lanes, stack_rows

SIZE = (64, 128)
GRID = BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5)
INTRINSICS = torch.tensor([[80.0, 0.0, 63.5], [0.0, 80.0, 31.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def camera(*distortion):
    return Camera(INTRINSICS, torch.tensor(distortion, dtype=torch.float64), "pinhole", SIZE)


def model(network_width=None, far_view=None):
    torch.manual_seed(0)
    config = SegmenterConfig(base_width=4, decoder_width=8)
    return LaneBEV(
        LaneSegmenter(config), LineExtractor.for_network(config), TwoStageCalibrator(num_hypotheses=20),
        BEVWarp(GRID), network_width, far_view=far_view,
    )  # fmt: skip


def onnx(part, folder):
    write_onnx(part, folder / "part.onnx")
    return OnnxPart(folder / "part.onnx")


def equals(found, expected, tolerance):
    for name, value in found.items():
        assert value.dtype == expected[name].dtype
        torch.testing.assert_close(value, expected[name], rtol=tolerance, atol=tolerance, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "distortion", "tolerance"),
    [("segmenter", (), 1e-5), ("warp", (-0.1, 0.01, 0.0, 0.0, 0.0), 1e-4)],
)
def test_a_part_equals_eager_for_any_batch(name, distortion, tolerance, tmp_path):
    part = make_part(name, model(), camera(*distortion))
    other = onnx(part, tmp_path)
    assert list(other.inputs) == list(part.inputs)
    assert other.outputs == list(part.outputs)
    for rows in (1, 3):
        inputs = {key: value[:1].repeat(rows, *[1] * (value.ndim - 1)) for key, value in part.inputs.items()}
        inputs["image"] = torch.rand(rows, *part.inputs["image"].shape[1:])
        with torch.no_grad():
            expected = dict(zip(part.outputs, part.module(*inputs.values()), strict=True))
        equals(other(inputs), expected, tolerance)


def test_the_update_by_the_speed_equals_eager(tmp_path):
    part, calibrator = make_part("speed", model(), camera()), JointCalibrator()
    other = onnx(part, tmp_path)
    for rows in (1, 3):
        state = calibrator.initial_state(rows, torch.float64)
        speed = torch.tensor([5.0, torch.nan, -1.0], dtype=torch.float64)[:rows]
        expected = calibrator.with_speed(state, speed)._asdict()
        found = other({**{name: getattr(state, name[6:]) for name in list(part.inputs)[:3]}, "speed": speed})
        equals({name.removeprefix("next_state_"): value for name, value in found.items()}, expected, 1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["bev", "canonical"])
def test_a_view_of_your_own_is_exported_for_images_of_any_size(kind, tmp_path):
    """By torch.onnx.export, as somebody does it whose network has the view as a layer."""

    class Layer(torch.nn.Module):
        def __init__(self):
            super().__init__()
            virtual = Extrinsics.from_values(0.0, 0.0, 0.0, 1.4)
            self.view = BEVWarp(GRID) if kind == "bev" else CanonicalView(INTRINSICS, SIZE, virtual)

        def forward(self, image, intrinsics, pose, distortion):
            return self.view(image, intrinsics, Extrinsics.unstack(pose), distortion)

    def arguments(rows, height, width):
        numbers = torch.Generator().manual_seed(rows)
        pose = torch.tensor([0.02, 0.01, -0.01, 1.5]) + 0.01 * torch.randn(rows, 4, generator=numbers)
        lens = torch.tensor([-0.1, 0.01, 0.0, 0.0, 0.0]).repeat(rows, 1)
        image = torch.rand(rows, 3, height, width, generator=numbers)
        return image, INTRINSICS.float().repeat(rows, 1, 1), pose, lens

    rows, *size = (
        torch.export.Dim(name, min=1 if name == "rows" else 16) for name in ("rows", "height", "width")
    )
    torch.onnx.export(
        Layer(), arguments(2, *SIZE), tmp_path / "view.onnx", dynamo=True, verbose=False,
        input_names=["image", "intrinsics", "pose", "distortion"],
        dynamic_shapes=({0: rows, 2: size[0], 3: size[1]}, {0: rows}, {0: rows}, {0: rows}),
        custom_translation_table=translations(),
    )  # fmt: skip
    session = InferenceSession(tmp_path / "view.onnx")
    for shape in ((2, *SIZE), (1, 50, 131), (3, 200, 90)):
        given = arguments(*shape)
        names = [each.name for each in session.get_inputs()]
        found = session.run(None, {name: part.numpy() for name, part in zip(names, given, strict=True)})
        for value, expected in zip(found, Layer()(*given), strict=True):
            torch.testing.assert_close(torch.from_numpy(value), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_segmenter_of_8_bits_is_near_that_of_float(tmp_path):
    """Weights and activations are stored with 8 bits, names and facts stay, logits differ by a little."""
    part = make_part("segmenter", model(), camera())
    path = tmp_path / "part.onnx"
    write_onnx(part, path)
    size, facts = path.stat().st_size, OnnxPart(path).facts
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(1, *part.inputs["image"].shape[1:], generator=generator) for _ in range(4)]
    quantize_segmenter(path, [{"image": image.numpy()} for image in images])
    other = OnnxPart(path)
    assert other.facts == facts
    assert list(other.inputs) == ["image"]
    assert path.stat().st_size < 0.6 * size
    image = torch.cat(images[:2])
    with torch.no_grad():
        (expected,) = part.module(image)
    off = (other({"image": image})["logits"] - expected).abs()
    assert 0 < off.mean() < 0.05 * expected.std()


@pytest.mark.slow
def test_a_calibrator_equals_eager_frame_after_frame(tmp_path):
    calibrator = TwoStageCalibrator(num_hypotheses=20)
    other = with_exported_step(calibrator, onnx(calibrator_part(calibrator, 48), tmp_path))
    state = again = calibrator.initial_state(3, dtype=torch.float64)
    for frame in range(3):
        segments = stack_rows(lanes(seed=frame), no_lanes(), lanes(boundaries=(2,), per=48, seed=frame))
        arguments = (K.expand(3, 3, 3), 1 / 30, 3.6)
        expected, state = calibrator(segments, arguments[0], state, *arguments[1:])
        found, again = other(segments, arguments[0], again, *arguments[1:])
        assert found.status.tolist() == expected.status.tolist()
        equals(again._asdict(), state._asdict(), 1e-9)
        torch.testing.assert_close(found.covariance, expected.covariance)
    assert expected.status.tolist() == [Status.TRACKING, Status.UNINITIALISED, Status.UNINITIALISED]


def test_a_row_that_is_reset_begins_anew():
    calibrator = TwoStageCalibrator(num_hypotheses=20)
    part = calibrator_part(calibrator, 48)
    _, after = calibrator(lanes(), K[None], calibrator.initial_state(1, torch.float64), 1 / 30)
    reset = torch.tensor([True, False])
    begun = part.module.begin(reset, [value.repeat(2, *[1] * (value.ndim - 1)) for value in after])
    for fresh, kept, value in zip(calibrator.initial_state(1, torch.float64), after, begun, strict=True):
        assert torch.equal(value[:1], fresh)
        assert torch.equal(value[1:], kept)


@pytest.mark.slow
def test_rows_that_ask_are_computed_anew_in_an_if(tmp_path):
    class Module(torch.nn.Module):
        def forward(self, asks, value):
            return (replace_rows(asks, value, lambda part: part * constant((2.0, 3.0), like=part), value),)

    value = torch.tensor([[4.0, 2.0], [-1.0, 1.0], [9.0, 1.0]], dtype=torch.float64)
    part = onnx(Part(Module(), {"asks": value[:2, 0] > 0, "value": value[:2]}, ("out",)), tmp_path)
    kinds = {node.op_type for node in load_onnx(tmp_path / "part.onnx").graph.node}
    assert "If" in kinds
    assert not {"Mul", "Where"} & kinds  # they are in its branch
    assert part({"asks": value[:, 0] > 5, "value": value})["out"].tolist() == [[4, 2], [-1, 1], [18, 3]]
    assert torch.equal(part({"asks": value[:, 0] > 10, "value": value})["out"], value)


def test_names_and_facts():
    part = make_part("step", model(96), camera(0.1, 0.0, 0.0, 0.0))
    assert list(part.inputs)[:6] == ["image", "dt", "lane_width", "reset", "intrinsics", "distortion"]
    assert part.facts["network_size"] == [64, 96]
    assert part.facts["lens"] == "pinhole"
    results = part.module(*part.inputs.values())
    named = dict(zip(part.outputs, results, strict=True))
    assert named["bev"].shape == (2, 3, *GRID.shape)
    for name, value in part.inputs.items():
        if name.startswith("state_"):
            assert named[f"next_{name}"].shape == value.shape
            assert named[f"next_{name}"].dtype == value.dtype
    with pytest.raises(ValueError, match=r"part: expected one of segmenter, .*, got 'all'"):
        make_part("all", model(), camera())


@pytest.mark.slow
def test_the_step_as_a_program_equals_eager_for_any_batch():
    part = make_part("step", model(96), camera())
    program = export_program(part).module()
    one = [value[:1] for value in part.inputs.values()]
    with torch.no_grad():
        for found, expected in zip(program(*one), part.module(*one), strict=True):
            torch.testing.assert_close(found, expected)


class _FarView(torch.nn.Module):
    """Image and vanishing point to the vertices of both views."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, image, point):
        logits, vertices = self.model.boundary_vertices(image, point)
        return logits, *vertices


@pytest.mark.slow
def test_a_far_view_equals_eager_where_it_is_known_and_where_it_is_not(tmp_path):
    """Each row has a far view of its own place; in the last one the vanishing point is not known."""
    made = model(96, far_view=FarView()).eval()
    image = torch.rand(3, 3, *SIZE, generator=torch.Generator().manual_seed(3))
    point = torch.tensor([[60.0, 20.0], [90.0, 30.0], [torch.nan, torch.nan]])
    names = ("logits", "points", "weight", "sigma", "boundary")
    other = onnx(Part(_FarView(made), {"image": image[:2], "point": point[:2]}, names), tmp_path)
    with torch.no_grad():
        expected = dict(zip(names, _FarView(made)(image, point), strict=True))
        whole = made.boundary_vertices(image)[1]
    equals(other({"image": image, "point": point}), expected, 1e-3)
    seen, alone = (each.gt(0).sum((1, 2)) for each in (expected["weight"], whole.weight))
    assert seen[2] == alone[2]
    assert (seen[:2] > alone[:2]).all()


@pytest.mark.slow
def test_the_segmenter_for_far_views_takes_images_of_any_size(tmp_path):
    made = model(96, far_view=FarView()).eval()
    other = onnx(make_part("segmenter", made, camera()), tmp_path)
    for rows, *size in ((2, 64, 96), (1, 96, 64), (3, 32, 32)):
        image = torch.rand(rows, 3, *size, generator=torch.Generator().manual_seed(3))
        with torch.no_grad():
            equals(other({"image": image}), {"logits": made.segmenter(image)}, 1e-4)


@pytest.mark.slow
def test_the_step_with_a_far_view_as_a_program_equals_eager():
    """In the first row the state knows where the lanes meet, in the second one it does not."""
    part = make_part("step", model(96, far_view=FarView()), camera())
    inputs = {name: value.clone() for name, value in part.inputs.items()}
    inputs["state_status"][0] = int(Status.TRACKING)
    inputs["state_direction_cov"][0] *= 1e-6
    plain = make_part("step", model(96), camera())
    with torch.no_grad():
        expected, without = (
            dict(zip(each.outputs, each.module(*inputs.values()), strict=True)) for each in (part, plain)
        )
        found = dict(zip(part.outputs, export_program(part).module()(*inputs.values()), strict=True))
    equals(found, expected, 1e-4)
    counts = [each["weight"].gt(0).sum(1) for each in (expected, without)]
    assert counts[0][0] != counts[1][0]
    assert counts[0][1] == counts[1][1]


def test_files_of_others_are_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a file that lanebev export writes, found none"):
        OnnxPart(tmp_path / "segmenter.onnx")
    (tmp_path / "segmenter.onnx").write_bytes(b"no model")
    with pytest.raises(ValueError, match="expected an ONNX file of lanebev export, got"):
        OnnxPart(tmp_path / "segmenter.onnx")
