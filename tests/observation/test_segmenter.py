import pytest
import torch
import torch.nn.functional as F

from lanebev.observation.resnet import STRIDES, BasicBlock, ResNet18
from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig, upsample_aligned
from lanebev.weights import load_segmenter, read_metadata, save_segmenter
from train.export import widen

SMALL = SegmenterConfig(base_width=8, decoder_width=8)


@pytest.fixture
def small():
    torch.manual_seed(0)
    return LaneSegmenter(SMALL).eval()


def test_parameters_are_torchvisions():
    """Names and shapes as torchvision 0.20's resnet18 has them, without fc."""
    state = ResNet18().state_dict()
    assert sum(value.numel() for name, value in ResNet18().named_parameters()) == 11_176_512
    assert state["conv1.weight"].shape == (64, 3, 7, 7)
    assert state["layer1.0.bn2.running_var"].shape == (64,)
    assert state["layer2.0.downsample.0.weight"].shape == (128, 64, 1, 1)
    assert state["layer4.1.conv2.weight"].shape == (512, 512, 3, 3)
    assert "layer1.0.downsample.0.weight" not in state
    assert len(state) == 120


def test_torchvision_state_loads_but_for_the_classifier():
    trunk = ResNet18(base_width=8)
    state = {name: torch.rand_like(value.float()) for name, value in trunk.state_dict().items()}
    trunk.load_torchvision({**state, "fc.weight": torch.zeros(1000, 64), "fc.bias": torch.zeros(1000)})
    torch.testing.assert_close(trunk.state_dict()["layer3.1.bn1.weight"], state["layer3.1.bn1.weight"])
    del state["conv1.weight"]
    with pytest.raises(RuntimeError, match=r"conv1\.weight"):
        trunk.load_torchvision(state)


@pytest.mark.parametrize(("output_stride", "last"), [(8, (8, 8)), (16, (16, 16)), (32, (16, 32))])
def test_output_stride(output_stride, last):
    maps = ResNet18(4, output_stride).eval()(torch.zeros(1, 3, 65, 97))
    strides = (*STRIDES[:3], *last)
    assert [m.shape[-2:] for m in maps] == [(-(-65 // s), -(-97 // s)) for s in strides]


@pytest.mark.parametrize("stride", [1, 2, 4])
@pytest.mark.parametrize("size", [(64, 96), (65, 97), (33, 50), (180, 319)])
def test_any_size(stride, size):
    model = LaneSegmenter(SegmenterConfig(base_width=4, decoder_width=4, output_stride=stride)).eval()
    assert model(torch.rand(2, 3, *size)).shape == (2, 7, -(-size[0] // stride), -(-size[1] // stride))


@pytest.mark.parametrize("stride", [1, 2])
def test_a_block_equals_the_published_one(stride):
    block = BasicBlock(4, 6, stride).double().eval()
    x = torch.randn(2, 4, 9, 12, dtype=torch.float64)
    projection, norm = block.downsample
    identity = norm(F.conv2d(x, projection.weight, stride=stride))
    residual = block.bn2(block.conv2(block.bn1(block.conv1(x)).relu()))
    assert torch.allclose(block(x), (residual + identity).relu())


def test_logits_are_in_the_usual_order(small):
    assert small(torch.rand(2, 3, 33, 64)).view(2, -1).shape == (2, 7 * 17 * 32)


def test_gradients_do_not_depend_on_the_order_of_memory():
    segmenter = LaneSegmenter(SMALL).double().eval()
    image = torch.rand(2, 3, 33, 64, dtype=torch.float64)
    gradients = []
    for order in (torch.contiguous_format, torch.channels_last):
        segmenter.zero_grad()
        trunk = segmenter.trunk(image.contiguous(memory_format=order))
        sum(each.square().sum() for each in trunk).backward()
        gradients.append([weight.grad for weight in segmenter.trunk.parameters()])
    torch.testing.assert_close(*gradients)


def test_convention_trunk_cells_sit_on_their_pixels():
    """With symmetric kernels, the response to a dot at (s·j, s·i) is symmetric about cell (i, j)."""
    trunk = ResNet18(2).eval()
    for module in trunk.modules():
        if isinstance(module, torch.nn.Conv2d):
            torch.nn.init.ones_(module.weight)
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.ones_(module.weight)
    image = torch.zeros(1, 3, 257, 321)
    image[..., 128, 160] = 1
    for stride, features in zip(STRIDES, trunk(image), strict=True):
        torch.testing.assert_close(features, features.flip(-1))  # columns 0..320 mirror about 160
        torch.testing.assert_close(features, features.flip(-2))
        row = features[0, 0, 128 // stride]
        assert row[160 // stride] == row.max()


def test_upsampling_keeps_cells_on_their_pixels():
    ramp = torch.arange(5.0).expand(1, 1, 3, 5)
    doubled = upsample_aligned(ramp, (6, 9))
    torch.testing.assert_close(doubled[0, 0, 0], torch.arange(9) / 2)  # fine cell 2i is coarse cell i
    assert upsample_aligned(ramp, (6, 10))[0, 0, 0, 9] == 4  # no right neighbour: repeats


def test_normalisation_is_inside(small):
    grey = torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1).expand(1, 3, 64, 64)
    seen = []
    small.trunk.conv1.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    small(grey)
    assert seen[0].abs().max() < 1e-6


def test_rows_of_a_batch_are_alone(small):
    image = torch.rand(3, 3, 64, 96)
    torch.testing.assert_close(small(image)[1:2], small(image[1:2]), atol=1e-5, rtol=1e-4)


@pytest.mark.slow
def test_overfits_one_image():
    torch.manual_seed(0)
    model = LaneSegmenter(SMALL).train()
    image = torch.rand(2, 3, 32, 64)
    target = torch.zeros(2, 16, 32, dtype=torch.long)
    target[:, :, 10], target[:, :, 20] = 3, 4
    optimizer = torch.optim.AdamW(model.parameters(), 1e-2)
    for _ in range(60):
        loss = F.cross_entropy(model(image), target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.05


@pytest.mark.slow
def test_export_equals_eager(small):
    image = torch.rand(2, 3, 64, 96)
    exported = torch.export.export(small, (image,)).module()
    torch.testing.assert_close(exported(image), small(image))


def test_widening_keeps_the_function(small):
    wide = LaneSegmenter(SegmenterConfig(base_width=16, decoder_width=8)).eval()
    for module in small.modules():  # not the identity it is at the start
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1)
            torch.nn.init.uniform_(module.running_mean, -0.1, 0.1)
    wide.load_state_dict(widen(small.state_dict(), wide.state_dict(), noise=0.0), strict=True)
    image = torch.rand(1, 3, 64, 96)
    torch.testing.assert_close(wide(image), small(image), atol=1e-5, rtol=1e-4)


def test_weights_round_trip_in_half_precision(small, tmp_path):
    path = tmp_path / "w.safetensors"
    save_segmenter(small, path, seed=3, metrics={"val/recall": 0.5})
    loaded = load_segmenter(path)
    assert loaded.config == SMALL
    assert not loaded.training
    assert read_metadata(path)["seed"] == 3
    assert loaded.head.weight.dtype == torch.float32
    image = torch.rand(1, 3, 64, 96)
    torch.testing.assert_close(loaded(image), small(image), atol=2e-2, rtol=1e-2)


def test_bad_weights_are_one_clear_line(small, tmp_path):
    path = tmp_path / "w.safetensors"
    with pytest.raises(ValueError, match="found none"):
        load_segmenter(path)
    save_segmenter(small, path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="whole safetensors"):
        load_segmenter(path)
    small.extra = torch.nn.Parameter(torch.zeros(1))
    save_segmenter(small, path)
    with pytest.raises(ValueError, match=r"do not fit.*extra"):
        load_segmenter(path)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: ResNet18(output_stride=4), "output_stride: expected"),
        (lambda: ResNet18(base_width=0), "base_width: expected"),
        (lambda: SegmenterConfig(output_stride=3), "output_stride: expected"),
        (lambda: SegmenterConfig(num_boundaries=0), "num_boundaries: expected"),
        (lambda: LaneSegmenter(SMALL)(torch.zeros(1, 1, 32, 32)), r"image: expected \(B, 3, H, W\)"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()


def test_images_of_whole_numbers_are_refused(small):
    with pytest.raises(ValueError, match=r"image: expected floating point in \[0, 1\], got torch.uint8"):
        small(torch.zeros(1, 3, 64, 96, dtype=torch.uint8))
