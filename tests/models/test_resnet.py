"""ResNet against torchvision's numbers, names and shapes."""

from __future__ import annotations

import pytest
import torch

from saunet.errors import ConfigError
from saunet.models.encoders.resnet import ResNet
from saunet.models.pretrained import tile_frames
from saunet.registry import encoders


@pytest.mark.parametrize(("name", "bottleneck"), [("resnet", False), ("resnet_bottleneck", True)])
def test_matches_torchvision(reference, name, bottleneck):
    state = {key: torch.from_numpy(value).float() for key, value in reference(f"{name}_state").items()}
    model = ResNet((1, 1, 1, 1), bottleneck).eval()
    model.load_state_dict(state)
    expected = reference(name)
    with torch.no_grad():
        features = model(torch.from_numpy(expected["input"]))
    for i, feature in enumerate(features):
        torch.testing.assert_close(feature, torch.from_numpy(expected[f"feature{i}"]), atol=1e-4, rtol=0)


# Published sizes: torchvision's parameter count less the classifier's (512 or 2048 inputs, 1000 classes with bias).
@pytest.mark.parametrize(
    ("name", "published", "width"),
    [
        ("resnet18", 11_689_512, 512),
        ("resnet34", 21_797_672, 512),
        ("resnet50", 25_557_032, 2048),
        ("resnet101", 44_549_160, 2048),
    ],
)
def test_parameter_count(name, published, width):
    with torch.device("meta"):
        model = encoders.build(name)
    assert sum(p.numel() for p in model.parameters()) == published - width * 1000 - 1000
    assert model.variant == name


def test_convolutions_start_from_he_s_normal_distribution_with_fan_out():
    model = ResNet((1, 1, 1, 1), bottleneck=True)
    for conv in (model.conv1, model.layer3[0].conv2, model.layer4[0].conv3, model.layer2[0].downsample[0]):
        fan_out = conv.weight[:, 0].numel()
        assert conv.weight.std().item() == pytest.approx((2 / fan_out) ** 0.5, rel=0.03)
        assert conv.weight.mean().abs().item() < 0.03 * (2 / fan_out) ** 0.5 + 1e-4


def test_torchvision_names():
    with torch.device("meta"):
        keys = set(encoders.build("resnet50").state_dict())
    for key in ("conv1.weight", "bn1.running_var", "layer1.0.conv1.weight", "layer1.0.downsample.0.weight",
                "layer1.0.downsample.1.weight", "layer4.2.bn3.bias"):  # fmt: skip
        assert key in keys
    assert not [key for key in keys if key.startswith(("fc", "mean", "std"))]
    assert "layer1.0.downsample.0.weight" not in ResNet((1, 1, 1, 1)).state_dict()


def test_frames_share_first_layer():
    torch.manual_seed(0)
    one, two = ResNet((1, 1, 1, 1)).eval(), ResNet((1, 1, 1, 1), frames=2).eval()
    state = one.state_dict()
    state["conv1.weight"] = tile_frames(state["conv1.weight"], 2)
    two.load_state_dict(state)
    image = torch.rand(1, 3, 32, 64)
    with torch.no_grad():
        for a, b in zip(one(image), two(torch.cat([image, image], 1)), strict=True):
            torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("blocks", [(2, 2, 2), (2, 0, 2, 2)])
def test_wrong_blocks(blocks):
    with pytest.raises(ConfigError, match="four stages with at least one block"):
        ResNet(blocks)


def test_wrong_frames():
    with pytest.raises(ConfigError, match="frames is 0"):
        ResNet(frames=0)
