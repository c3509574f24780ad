"""Any image in, depth at its own size out, and the truth about its unit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import saunet
from saunet.errors import CheckpointError, ConfigError, DataError
from saunet.io.images import write_image
from saunet.models.depth import DepthNet
from saunet.prediction.predictor import Predictor
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord, Scale

Picture = NDArray[np.uint8]


@pytest.mark.parametrize("size", [(1, 1), (1, 50), (7, 3), (40, 90), (300, 200), (32, 64)])
def test_result_has_the_size_of_the_image(predictor: Predictor, size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    result = predictor.predict(image)
    assert result.depth.shape == result.disparity.shape == size
    assert result.depth.dtype == np.float32
    assert np.allclose(result.depth * result.disparity, 1, atol=1e-5)
    assert np.array_equal(result.image, image)


def test_path_array_and_tensor_agree(predictor: Predictor, picture: Picture, tmp_path: Path) -> None:
    write_image(tmp_path / "x.png", picture)
    tensor = torch.from_numpy(picture).permute(2, 0, 1)
    expected = predictor.predict(picture).depth
    for image in (tmp_path / "x.png", str(tmp_path / "x.png"), tensor, tensor.float() / 255, tensor.double() / 255):
        assert np.array_equal(predictor.predict(image).depth, expected)
    assert predictor.predict(tmp_path / "x.png").name == str(tmp_path / "x.png")


def test_pil_images_are_read_as_their_files_are(predictor: Predictor, picture: Picture, tmp_path: Path) -> None:
    pil = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    rotated = pil.Exif()
    rotated[0x0112] = 6  # a quarter turn
    pil.fromarray(picture).save(tmp_path / "turned.png", exif=rotated)
    deep = pil.fromarray((picture[:, :, 0].astype(np.uint16) << 8) + 255)
    for image, expected in (
        (pil.fromarray(picture), picture),
        (pil.fromarray(picture).convert("P", palette=pil.Palette.ADAPTIVE).convert("RGB").convert("RGBA"), None),
        (pil.open(tmp_path / "turned.png"), tmp_path / "turned.png"),
        (deep, np.asarray(deep)),
    ):
        depth = predictor.predict(image).depth
        assert expected is None or np.array_equal(depth, predictor.predict(expected).depth)
    gray = pil.fromarray(picture[:, :, 0]).convert("1")
    assert set(np.unique(predictor.predict(gray).image)) <= {0, 255}


def test_gray_and_rgba_arrays(predictor: Predictor, picture: Picture) -> None:
    gray = picture[:, :, 0]
    expected = predictor.predict(np.repeat(gray[:, :, None], 3, axis=2)).depth
    assert np.array_equal(predictor.predict(gray).depth, expected)
    rgba = np.dstack([picture, picture[:, :, 0]])
    assert np.array_equal(predictor.predict(rgba).depth, predictor.predict(picture).depth)


def test_batch_of_mixed_sizes_keeps_order_and_names(predictor: Predictor, picture: Picture) -> None:
    images = [picture, picture[:20], picture[:, ::-1].copy()]
    batch = predictor.predict_batch(images, ["a", "b", "c"])
    assert [result.name for result in batch] == ["a", "b", "c"]
    for image, result in zip(images, batch, strict=True):
        assert np.allclose(result.depth, predictor.predict(image).depth, rtol=1e-5)
    assert predictor.predict_batch([]) == []


def test_unit(network: DepthNet, picture: Picture) -> None:
    relative = Predictor(network, 32, 64).predict(picture)
    metric = Predictor(network, 32, 64, scale=Scale(30.0, "camera height 1.65 m")).predict(picture)
    assert not relative.metric
    assert relative.unit == "relative (meters times one unknown factor)"
    assert metric.metric
    assert metric.unit == "meters (scale from camera height 1.65 m)"
    assert np.allclose(metric.depth, 30 * relative.depth, rtol=1e-5)
    assert np.allclose(metric.disparity * metric.depth, 1, atol=1e-5)


def test_flip_averaging_is_symmetric(network: DepthNet, picture: Picture) -> None:
    """With it, mirroring the image mirrors the prediction; without, this network notices."""
    mirrored = np.ascontiguousarray(picture[:, ::-1])
    flipping = Predictor(network, 32, 64, flip=True)
    assert np.allclose(flipping.predict(picture).depth, flipping.predict(mirrored).depth[:, ::-1], rtol=1e-3)
    plain = Predictor(network, 32, 64)
    assert not np.allclose(plain.predict(picture).depth, plain.predict(mirrored).depth[:, ::-1], rtol=1e-2)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((375, 1242), (24, 80)), ((100, 100), (48, 48)), ((1, 1000), (8, 256)), ((1000, 1), (256, 8))],
)
def test_kept_aspect(network: DepthNet, size: tuple[int, int], expected: tuple[int, int]) -> None:
    predictor = Predictor(network, 32, 64, keep_aspect=True)
    assert predictor.input_size(*size) == expected
    assert predictor.predict(np.zeros((*size, 3), np.uint8)).depth.shape == size


class TestRefused:
    @pytest.mark.parametrize(
        ("image", "message"),
        [
            (np.zeros((3, 40, 60), np.uint8), r"arrays are h x w x 3"),
            (np.zeros((40, 60, 3), np.float32), "type float32"),
            (np.zeros((0, 60, 3), np.uint8), "has shape"),
            (torch.zeros(1, 3, 40, 60), "a tensor must be one image"),
            (torch.full((3, 4, 4), 255.0), r"values from 255 to 255; floating-point values must lie in \[0, 1\]"),
            (torch.full((3, 4, 4), float("nan")), "values from nan"),
            (None, "got NoneType"),
            (b"abc", "got bytes"),
            ("absent.png", "no file at absent.png"),
        ],
    )
    def test_images(self, predictor: Predictor, image: Any, message: str) -> None:
        with pytest.raises(DataError, match=message):
            predictor.predict(image)

    def test_network_that_diverged(self, network: DepthNet, picture: Picture) -> None:
        torch.nn.init.constant_(network.decoder.gain, float("nan"))  # type: ignore[union-attr, arg-type]
        with pytest.raises(CheckpointError, match="not finite"):
            Predictor(network, 32, 64).predict(picture)

    def test_size_that_does_not_divide(self, network: DepthNet) -> None:
        with pytest.raises(ConfigError, match=r"network input 30x64 .* is not divisible by the encoder stride 8"):
            Predictor(network, 30, 64)

    @pytest.mark.parametrize("device", ["cuda:77", "nonsense"])
    def test_device(self, network: DepthNet, device: str) -> None:
        with pytest.raises(ConfigError, match=f"device '{device}' cannot be used here; available: cpu"):
            Predictor(network, 32, 64, device=device)


def test_fingerprint_follows_weights_and_settings(network: DepthNet) -> None:
    one = Predictor(network, 32, 64).fingerprint
    assert Predictor(network, 32, 64).fingerprint == one
    assert Predictor(network, 32, 64, flip=True).fingerprint != one
    assert Predictor(network, 32, 72).fingerprint != one
    measured = Predictor(network, 32, 64)
    assert measured.fingerprint == one  # asked for before the scale is known, as by the choice of the runtime
    measured.scale = Scale(1.2, "speed")
    assert measured.fingerprint == Predictor(network, 32, 64, scale=Scale(1.2, "speed")).fingerprint != one
    torch.nn.init.constant_(network.decoder.gain, 0.25)  # type: ignore[union-attr, arg-type]
    assert Predictor(network, 32, 64).fingerprint != one


def test_load_in_one_line(node: Callable[..., dict[str, Any]], tmp_path: Path, picture: Picture) -> None:
    record = ModelRecord(
        node("encoder", "resnet18"), node("decoder", "unet"), None, 0.1, 100.0, 32, 64, scale=Scale(5.0, "LiDAR")
    )
    depth, _ = build_networks(record)
    state = {f"depth.{name}": value for name, value in depth.state_dict().items()}
    atomic_save({"state_dict": state, "saunet": record.to_plain()}, tmp_path / "last.ckpt")
    predictor = saunet.load(tmp_path / "last.ckpt")
    result = predictor.predict(picture)
    assert result.depth.shape == picture.shape[:2]
    assert result.unit == "meters (scale from LiDAR)"
    assert np.array_equal(result.depth, Predictor(depth, 32, 64, scale=Scale(5.0, "LiDAR")).predict(picture).depth)
    assert result._repr_png_().startswith(b"\x89PNG")
