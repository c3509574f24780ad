"""Reading what cameras and users produce, refusing what is broken, writing whole files."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from drives import NumberDrive
from numpy.typing import NDArray
from PIL import Image

from saunet.data.loading.windows import WindowDataset
from saunet.errors import ConfigError, DataError
from saunet.io.images import (
    as_rgb_bytes,
    image_size,
    natural_order,
    network_input,
    read_bytes,
    read_depth,
    read_image,
    resize,
    write_image,
)


@pytest.fixture(scope="module")
def picture() -> NDArray[np.uint8]:
    """A smooth color picture, 40 x 90, with different corners."""
    y, x = np.mgrid[0:40, 0:90]
    return np.stack([x * 255 // 89, y * 255 // 39, 255 - x * 255 // 89], axis=-1).astype(np.uint8)


needs_rights = pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")


@pytest.mark.parametrize("name", ["x.png", "straße 東京 🚗.png", "x.bmp", "x.tiff", "X.PNG"])
def test_lossless_formats_round_trip(tmp_path: Path, picture: NDArray[np.uint8], name: str) -> None:
    write_image(tmp_path / name, picture)
    assert np.array_equal(read_image(tmp_path / name), picture)


def test_gray_is_repeated(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    write_image(tmp_path / "x.png", picture[:, :, 0])
    assert np.array_equal(read_image(tmp_path / "x.png"), np.repeat(picture[:, :, :1], 3, axis=2))


def test_sixteen_bits_keep_black_and_white(tmp_path: Path) -> None:
    write_image(tmp_path / "x.png", np.array([[0, 257, 32896, 65535]], np.uint16))
    assert read_image(tmp_path / "x.png")[0, :, 0].tolist() == [0, 1, 128, 255]


def test_transparency_is_dropped(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    Image.fromarray(np.dstack([picture, np.full(picture.shape[:2], 9, np.uint8)])).save(tmp_path / "x.png")
    assert np.array_equal(read_image(tmp_path / "x.png"), picture)


def test_colormap_image(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    few = picture // 128 * 128
    Image.fromarray(few).convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "x.png")
    assert np.abs(read_image(tmp_path / "x.png").astype(int) - few).max() <= 2


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, -1), (8, 1)])
def test_exif_rotation_is_applied(tmp_path: Path, picture: NDArray[np.uint8], orientation: int, turns: int) -> None:
    image = Image.fromarray(picture)
    exif = image.getexif()
    exif[0x112] = orientation
    image.save(tmp_path / "x.jpg", exif=exif, quality=95)
    image.save(tmp_path / "x.png", exif=exif)
    expected = np.rot90(picture, turns)
    for name in ("x.jpg", "x.png"):
        got = read_image(tmp_path / name)
        assert got.shape == expected.shape
        assert image_size(tmp_path / name) == expected.shape[:2]
        assert np.abs(got.astype(int) - expected).mean() < 4


def test_one_pixel(tmp_path: Path) -> None:
    write_image(tmp_path / "x.png", np.array([[[1, 2, 3]]], np.uint8))
    assert read_image(tmp_path / "x.png").tolist() == [[[1, 2, 3]]]


class TestBroken:
    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".webp", ".tiff"])
    @pytest.mark.parametrize("keep", [0.3, 0.9, 0.99])
    def test_truncated(self, tmp_path: Path, suffix: str, keep: float) -> None:
        noise = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
        path = tmp_path / f"x{suffix}"
        write_image(path, noise)
        path.write_bytes(path.read_bytes()[: int(path.stat().st_size * keep)])
        with pytest.raises(DataError, match=r"x\.\w+ (is truncated|is not an image|cannot be decoded)") as error:
            read_image(path)
        assert "\n" not in str(error.value)

    def test_empty(self, tmp_path: Path) -> None:
        (tmp_path / "x.png").touch()
        with pytest.raises(DataError, match=r"x\.png is empty \(0 bytes\)"):
            read_image(tmp_path / "x.png")

    def test_text(self, tmp_path: Path) -> None:
        (tmp_path / "x.png").write_text("not a picture")
        with pytest.raises(DataError, match=r"x\.png is not an image"):
            read_image(tmp_path / "x.png")

    def test_missing_and_folder(self, tmp_path: Path) -> None:
        with pytest.raises(DataError, match="no file at"):
            read_image(tmp_path / "x.png")
        with pytest.raises(DataError, match="is a folder"):
            read_image(tmp_path)

    def test_floating_point_image(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        cv2.imwrite(str(tmp_path / "x.tiff"), np.ones((4, 4, 3), np.float32))
        with pytest.raises(DataError, match="type float32"):
            read_image(tmp_path / "x.tiff")
        assert not caplog.records  # nothing about bits in use, which such an image does not have

    @pytest.mark.parametrize("shape", [(3,), (4, 5, 2), (2, 4, 5, 3), (0, 5, 3)])
    def test_array_shapes(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(DataError, match="has shape"):
            as_rgb_bytes(np.zeros(shape, np.uint8))


class TestWrite:
    def test_unknown_suffix(self, tmp_path: Path, picture: NDArray[np.uint8]) -> None:
        with pytest.raises(ConfigError, match=r"the suffix of x\.pgn is '\.pgn'; did you mean '\.png'"):
            write_image(tmp_path / "x.pgn", picture)

    def test_format_that_cannot_hold_it(self, tmp_path: Path) -> None:
        with pytest.raises(DataError, match="cannot encode"):
            write_image(tmp_path / "x.png", np.zeros((0, 0), np.uint8))
        assert list(tmp_path.iterdir()) == []

    def test_parent_is_a_file(self, tmp_path: Path, picture: NDArray[np.uint8]) -> None:
        (tmp_path / "f").touch()
        with pytest.raises(DataError, match=r"cannot write .*x\.png"):
            write_image(tmp_path / "f" / "x.png", picture)

    @needs_rights
    def test_no_permission(self, tmp_path: Path, picture: NDArray[np.uint8]) -> None:
        tmp_path.chmod(0o500)
        with pytest.raises(DataError, match="Permission denied"):
            write_image(tmp_path / "x.png", picture)

    def test_refused_by_the_system(
        self, tmp_path: Path, picture: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write_image(tmp_path / "x.png", picture)

        def refuse(*_: object) -> None:
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(os, "replace", refuse)
        with pytest.raises(DataError, match=r"cannot write .*x\.png: Permission denied"):
            write_image(tmp_path / "x.png", picture[:, ::-1])
        assert [path.name for path in tmp_path.iterdir()] == ["x.png"]
        assert np.array_equal(read_image(tmp_path / "x.png"), picture)


def test_names_are_ordered_by_their_numbers() -> None:
    wanted = [Path(name) for name in ("a2/frame_1", "a2/frame_02", "a2/frame_2", "a2/frame_10", "a10/frame_1", "b")]
    for paths in (wanted[::-1], sorted(wanted)):
        assert sorted(paths, key=natural_order) == wanted


def test_resize_follows_the_pixel_convention() -> None:
    """A ramp keeps its slope: pixel u of the result lies at (u + 0.5) * s - 0.5 of the source."""
    ramp = np.tile(np.arange(64, dtype=np.float32), (16, 1))
    assert resize(ramp, 16, 64) is ramp
    half = resize(ramp, 8, 32)
    assert np.allclose(half[4], (np.arange(32) + 0.5) * 2 - 0.5)
    double = resize(half, 16, 64)
    assert np.allclose(double[8, 2:-2], ramp[8, 2:-2], atol=1e-4)


def test_network_input() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[:, :, 0] = 255
    values = network_input(image, 8, 12)
    assert values.shape == (3, 8, 12)
    assert values[0].min() == 1.0
    assert values[1:].max() == 0.0


def test_jpeg_with_a_thumbnail_is_still_found_truncated(tmp_path: Path, picture: NDArray[np.uint8]) -> None:
    """A preview inside the header has an end of its own, which must not pass for the picture's."""
    thumbnail = io.BytesIO()
    Image.fromarray(picture).save(thumbnail, "JPEG")
    whole = io.BytesIO()
    Image.fromarray(np.tile(picture, (4, 4, 1))).save(whole, "JPEG", comment=thumbnail.getvalue())
    (tmp_path / "whole.jpg").write_bytes(whole.getvalue())
    assert read_image(tmp_path / "whole.jpg").shape == (160, 360, 3)
    (tmp_path / "part.jpg").write_bytes(whole.getvalue()[:-200])
    with pytest.raises(DataError, match=r"part\.jpg is truncated"):
        read_image(tmp_path / "part.jpg")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_data_after_the_end_of_an_image_is_no_damage(tmp_path: Path, picture: NDArray[np.uint8], suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    write_image(path, picture)
    expected = read_image(path)
    path.write_bytes(path.read_bytes() + bytes(9000))
    assert np.array_equal(read_image(path), expected)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_size_without_decoding(tmp_path: Path, picture: NDArray[np.uint8], suffix: str) -> None:
    write_image(tmp_path / f"ünï 中{suffix}", picture)
    assert image_size(tmp_path / f"ünï 中{suffix}") == (40, 90)


class TestDepth:
    def test_it_is_a_256th_of_a_meter(self, tmp_path: Path) -> None:
        write_image(tmp_path / "depth.png", np.array([[0, 256], [2560, 65535]], np.uint16))
        assert read_depth(tmp_path / "depth.png").tolist() == [[0, 1], [10, 65535 / 256]]

    def test_8_bits_are_refused(self, tmp_path: Path) -> None:
        write_image(tmp_path / "depth.png", np.zeros((2, 2), np.uint8))
        with pytest.raises(DataError, match="holds uint8"):
            read_depth(tmp_path / "depth.png")


@pytest.mark.parametrize("read", [read_depth, image_size, read_image, read_bytes])
def test_every_reader_names_what_is_missing_or_empty(tmp_path: Path, read: Callable[[Path], object]) -> None:
    with pytest.raises(DataError, match=r"no file at .*gone\.png"):
        read(tmp_path / "gone.png")
    (tmp_path / "empty.png").touch()
    with pytest.raises(DataError, match=r"empty\.png is empty \(0 bytes\)"):
        read(tmp_path / "empty.png")
    with pytest.raises(DataError, match="is a folder"):
        read(tmp_path)
    if read is not read_bytes:
        (tmp_path / "text.png").write_text("not an image")
        with pytest.raises(DataError, match=r"text\.png is not an image"):
            read(tmp_path / "text.png")


class PictureDrive(NumberDrive):
    """One frame that is an image file."""

    def __init__(self, path: Path) -> None:
        super().__init__("drive", (0,))
        self.file = path

    def image(self, index: int) -> NDArray[np.uint8]:
        return read_image(self.file)


@pytest.mark.parametrize("size", [(16, 24), (40, 90), (64, 128), (20, 128)])
def test_training_and_prediction_see_the_same_pixels(tmp_path: Path, size: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (40, 90, 3), dtype=np.uint8)
    write_image(tmp_path / "x.png", noise)
    dataset = WindowDataset([PictureDrive(tmp_path / "x.png")], [(0, 0)], offsets=(), height=size[0], width=size[1])
    trained = dataset[0]["frames"][0].numpy()
    used = network_input(read_image(tmp_path / "x.png"), *size)
    assert np.array_equal(trained.astype(np.float32) / np.float32(255), used)


def test_ten_and_twelve_bits_are_scaled_by_the_bits_in_use(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Machine vision cameras store them in 16-bit PNG; a dark frame among them is scaled like the others."""
    ramp = np.linspace(0, 255, 60).astype(np.uint8)[None].repeat(20, 0)
    for bits in (10, 12, 16):
        full = np.round(ramp * ((2**bits - 1) / 255)).astype(np.uint16)
        write_image(tmp_path / str(bits) / "0.png", full)
        write_image(tmp_path / str(bits) / "1.png", (full // 8).astype(np.uint16))
        for name, wanted in (("1.png", ramp / 8), ("0.png", ramp)):
            assert np.abs(read_image(tmp_path / str(bits) / name)[..., 1].astype(float) - wanted).max() <= 1
    said = [record.getMessage() for record in caplog.records]
    assert [f"use {bits} bits" in text for bits, text in zip((10, 12), said, strict=True)] == [True, True]
    twelve = np.dstack([ramp] * 3).astype(np.uint16) * 16
    assert np.abs(as_rgb_bytes(twelve)[..., 0].astype(int) - ramp).max() <= 1


def test_times_in_names_are_in_order() -> None:
    """Seconds as Python writes them; without their decimals' zeros they are not in the order of whole numbers."""
    times = ["1403636579.5", "1403636579.55", "1403636579.6", "1403636579.763555", "1403636580"]
    assert sorted((f"{time}.png" for time in times[::-1]), key=natural_order) == [f"{time}.png" for time in times]
    assert sorted(["shot_2.10.png", "shot_2.9.png"], key=natural_order) == ["shot_2.9.png", "shot_2.10.png"]


def test_a_png_that_promises_more_than_its_bytes_can_hold_is_damaged(tmp_path: Path) -> None:
    data = bytearray(cv2.imencode(".png", np.zeros((6, 9), np.uint16))[1].tobytes())
    data[20:22] = b"\x7f\x10"
    (tmp_path / "huge.png").write_bytes(bytes(data))
    with pytest.raises(DataError, match="damaged"):
        read_depth(tmp_path / "huge.png")
    write_image(tmp_path / "flat.png", np.zeros((2000, 3000, 3), np.uint8))  # which shrinks as far as can be
    assert read_image(tmp_path / "flat.png").shape == (2000, 3000, 3)


def test_a_png_whose_chunk_is_longer_than_the_file_is_not_decoded(tmp_path: Path) -> None:
    data = bytearray(cv2.imencode(".png", np.zeros((6, 9), np.uint16))[1].tobytes())
    data[33] = 0xCC  # of the length of the first chunk after the header
    (tmp_path / "long.png").write_bytes(bytes(data))
    with pytest.raises(DataError, match="truncated"):
        read_depth(tmp_path / "long.png")
