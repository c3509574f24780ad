"""Any network of timm as an encoder, and the sentence where timm is missing."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import pytest
import torch

import saunet
from saunet.errors import CheckpointError, ConfigError


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(ConfigError, match=r"needs the package timm.*pip install 'saunet\[timm\]'"):
        saunet.build("encoder", "timm")


class TestWithTimm:
    @pytest.fixture(autouse=True)
    def _timm(self) -> None:
        pytest.importorskip("timm", exc_type=Exception)

    @pytest.mark.parametrize(
        ("model", "size", "strides"),
        [
            ("resnet18", None, (2, 4, 8, 16, 32)),
            ("convnext_atto", None, (4, 8, 16, 32)),
            ("efficientnet_b0", None, (2, 4, 8, 16, 32)),
            ("swin_tiny_patch4_window7_224", (64, 96), (4, 8, 16, 32)),  # maps come with channels last
            ("vit_tiny_patch16_224", (64, 96), (16,)),  # three maps at one stride
        ],
    )
    def test_features_are_as_said(self, model: str, size: tuple[int, int] | None, strides: tuple[int, ...]) -> None:
        encoder = saunet.build("encoder", "timm", model=model, image_size=size)
        assert tuple(feature.stride for feature in encoder.features) == strides
        for found, spec in zip(encoder(torch.rand(1, 3, 64, 96)), encoder.features, strict=True):
            assert found.shape == (1, spec.channels, 64 // spec.stride, 96 // spec.stride)

    def test_images_are_normalized_as_the_network_expects(self) -> None:
        import timm

        encoder = saunet.build("encoder", "timm", model="vit_tiny_patch16_224", image_size=(64, 96))
        config = timm.get_pretrained_cfg("vit_tiny_patch16_224")
        assert tuple(encoder.mean.flatten().tolist()) == tuple(config.mean) == (0.5, 0.5, 0.5)
        assert tuple(encoder.std.flatten().tolist()) == tuple(config.std)

    def test_a_depth_network_trains_and_reads_a_file(self, tmp_path: Path) -> None:
        import timm

        torch.save(timm.create_model("resnet18").state_dict(), tmp_path / "w.pth")
        encoder = saunet.build("encoder", "timm", model="resnet18", weights=str(tmp_path / "w.pth"))
        expected = torch.load(tmp_path / "w.pth")
        assert torch.equal(encoder.network.state_dict()["layer1.0.conv1.weight"], expected["layer1.0.conv1.weight"])
        network = saunet.DepthNet(encoder, functools.partial(saunet.build, "decoder", "unet"))
        network(torch.rand(2, 3, 64, 96)).depth[0].mean().backward()
        assert network.encoder.network.conv1.weight.grad.abs().max() > 0  # type: ignore[union-attr]

    def test_mistakes_are_one_sentence(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="did you mean 'resnet18'"):
            saunet.build("encoder", "timm", model="resnet81")
        with pytest.raises(CheckpointError, match="no such file"):
            saunet.build("encoder", "timm", model="resnet18", weights=str(tmp_path / "w.pth"))
        torch.save({"x": torch.zeros(1)}, tmp_path / "w.pth")
        with pytest.raises(CheckpointError, match="not a file of timm's 'resnet18': it lacks"):
            saunet.build("encoder", "timm", model="resnet18", weights=str(tmp_path / "w.pth"))
        encoder = saunet.build("encoder", "timm", model="vit_tiny_patch16_224", image_size=(64, 96))
        with pytest.raises(ConfigError, match="64x128 but the encoder was built for 64x96"):
            encoder(torch.rand(1, 3, 64, 128))
