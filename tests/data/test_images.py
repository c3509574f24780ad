from __future__ import annotations

import cv2
import numpy as np
import pytest

from saunet.checks import DataError
from saunet.data.images import image_size, read_depth, read_image


@pytest.fixture(params=[".png", ".jpg"])
def picture(request, tmp_path):
    path = tmp_path / f"ünï 中 {request.param}"
    image = np.full((40, 50, 3), (200, 100, 50), np.uint8)
    path.write_bytes(cv2.imencode(request.param, image)[1].tobytes())
    return path


def test_images_come_as_rgb(picture):
    assert np.abs(read_image(picture).astype(int) - [50, 100, 200]).max() <= 2
    assert image_size(picture) == (40, 50)


def test_grey_images_get_three_channels(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 5), 9, np.uint8))
    assert read_image(tmp_path / "grey.png").tolist() == np.full((4, 5, 3), 9).tolist()


@pytest.mark.parametrize("share", [0.3, 0.9, 0.99])
def test_a_cut_off_file_is_named(picture, share):
    whole = picture.read_bytes()
    picture.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(DataError, match=r"is cut off|is damaged"):
        read_image(picture)


def test_missing_empty_and_foreign_files_are_named(tmp_path):
    with pytest.raises(DataError, match=r"no file at .*gone.png"):
        read_image(tmp_path / "gone.png")
    (tmp_path / "empty.png").touch()
    with pytest.raises(DataError, match=r"empty.png is empty \(0 bytes\)"):
        read_image(tmp_path / "empty.png")
    (tmp_path / "text.png").write_text("not an image")
    for read in (read_image, read_depth, image_size):
        with pytest.raises(DataError, match=r"text.png is damaged or not an image"):
            read(tmp_path / "text.png")
    with pytest.raises(DataError, match="cannot read"):
        read_image(tmp_path)


def test_depth_is_a_256th_of_a_metre(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.array([[0, 256], [2560, 65535]], np.uint16))
    assert read_depth(tmp_path / "depth.png").tolist() == [[0, 1], [10, 65535 / 256]]


def test_an_8_bit_depth_map_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.zeros((2, 2), np.uint8))
    with pytest.raises(DataError, match="holds uint8"):
        read_depth(tmp_path / "depth.png")
