from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saunet.data.video.camera import CameraFile, Lens, read_camera, write_camera
from saunet.errors import DataError

GOOD = "image_size: [640, 480]\nK: [500, 510, 321, 242]\n"


def write(tmp_path, text):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    return path


def test_what_is_written_down_is_read(tmp_path):
    text = (
        GOOD
        + "distortion: [-0.3, 0.1, 0, 0, 0]\nfps: 30\ncamera_height: 1.4\ncondition: cloudy\ncrop: [0, 0.1, 0, 0]\n"
    )
    camera = read_camera(write(tmp_path, text))
    assert camera.image_size == (480, 640)
    assert camera.K.tolist() == [[500, 0, 321], [0, 510, 242], [0, 0, 1]]
    assert (camera.fps, camera.camera_height, camera.condition, camera.model) == (30, 1.4, "cloudy", "pinhole")
    assert camera.distortion == (-0.3, 0.1, 0, 0, 0)
    assert camera.crop == (0, 0.1, 0, 0)
    write_camera(tmp_path / "again.yaml", camera, "two\nlines")
    again = read_camera(tmp_path / "again.yaml")
    assert (again.K == camera.K).all()
    assert (again.distortion, again.crop, again.fps) == (camera.distortion, camera.crop, camera.fps)
    rows = read_camera(write(tmp_path, "image_size: [640, 480]\nK: [[500, 0, 321], [0, 510, 242], [0, 0, 1]]\n"))
    assert (rows.K == camera.K).all()


def test_intrinsics_follow_the_size_of_the_frames(tmp_path):
    camera = read_camera(write(tmp_path, GOOD))
    half = camera.intrinsics(240, 320)
    np.testing.assert_allclose(half, [[250, 0, 160.25], [0, 255, 120.75], [0, 0, 1]])
    normalized = read_camera(write(tmp_path, "normalized: true\nK: [0.78125, 1.0625, 0.5, 0.5]\n"))
    np.testing.assert_allclose(normalized.intrinsics(480, 640), [[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]])
    with pytest.raises(DataError, match=r"the frames are 640x360 .*camera.yaml is for 640x480; give frames of the"):
        camera.intrinsics(360, 640)


def test_an_unknown_camera_is_guessed_where_that_is_allowed(tmp_path):
    path = write(tmp_path, "camera: unknown\nfps: 30\ncamera_height: 1.4\ncrop: [0, 0.1, 0, 0]\n")
    camera = read_camera(path, may_be_unknown=True)
    assert not camera.is_known
    assert (camera.fps, camera.camera_height, camera.crop) == (30, 1.4, (0, 0.1, 0, 0))
    focal = 320 / np.tan(np.radians(30))
    np.testing.assert_allclose(camera.intrinsics(480, 640), [[focal, 0, 319.5], [0, focal, 239.5], [0, 0, 1]])
    with pytest.raises(DataError, match=r"camera: unknown, which only data=video .*saunet calibrate video="):
        read_camera(path)
    for text in ("camera: unknown\nK: [500, 510, 321, 242]\n", "camera: mine\n"):
        with pytest.raises(DataError, match=r"only 'unknown' is allowed, instead of K"):
            read_camera(write(tmp_path, text), may_be_unknown=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image_size: [640, 480]\n", "camera.yaml lacks K; expected 'K: "),
        ("K: [500, 500, 320, 240]\n", "camera.yaml lacks image_size"),
        ("image_size: [640, 480]\nK: [500, 500, 320]\n", "K needs a list of 4 or 9 numbers, got 3"),
        ("image_size: [640, 480]\nK: 500\n", "K needs a list of 4 or 9 numbers, got 500"),
        ("image_size: [640, 480]\nK: [500, .nan, 320, 240]\n", "K needs 4 or 9 finite numbers, got 'nan' among them"),
        ("image_size: [640, 480]\nK: [500, x, 320, 240]\n", "finite numbers, got 'x' among them"),
        ("image_size: [640]\nK: [500, 500, 320, 240]\n", "image_size needs a list of 2 numbers, got 1"),
        ("image_size: [640, 0]\nK: [500, 500, 320, 240]\n", r"image_size is \[640, 0\]; expected whole numbers"),
        ("image_size: [640, 480]\nK: [500, 500, 700, 240]\n", "the center must lie inside"),
        ("image_size: [640, 480]\nK: [0.8, 1.0, 0.5, 0.5]\n", "or normalized \\(then set normalized: true\\)"),
        ("image_size: [621, 187]\nK: [721, 721, 609, 173]\n", "the center must lie inside, not near the left or"),
        ("image_size: [1242, 374]\nK: [180, 180, 152, 43]\n", "a focal length is about 0.3 to 3 image widths"),
        (
            "image_size: [1242, 374]\nK: [360, 360, 304, 86]\n",
            "a center near a corner belongs to images of another size",
        ),
        ("image_size: [640, 480]\nK: [500, 1" + "0" * 400 + ", 320, 240]\n", "an integer of 401 digits"),
        ("image_size: [640, 480]\nK: [500, 1" + "0" * 5000 + ", 320, 240]\n", "camera.yaml cannot be read as YAML"),
        ("normalized: true\nK: [500, 500, 320, 240]\n", "normalized K has fx 500 and center 320, 240"),
        ("normalized: maybe\nK: [1, 1, 0.5, 0.5]\n", "normalized is 'maybe'"),
        (GOOD + "distortion: [0.1, 0.2]\n", "distortion needs a list of 0 or 4 or 5 or 8"),
        (
            GOOD + "distortion: [0.1, 0.2, 0, 0, 0]\nmodel: fisheye\n",
            "distortion needs a list of 0 or 1 or 2 or 3 or 4 numbers, got 5",
        ),
        (GOOD + "model: fish\n", "model is 'fish'; did you mean 'fisheye'"),
        (GOOD + "fsp: 10\n", "unknown key 'fsp'; did you mean 'fps'"),
        (GOOD + "fps: 0\n", "fps is 0; it must be greater than 0"),
        (GOOD + "camera_height: tall\n", "camera_height needs 1 finite numbers, got 'tall'"),
        (GOOD + "crop: [0.6, 0.5, 0, 0]\n", "crop is .* that leave a tenth"),
        ("image_size: [640, 480]\nK: [[500, 0, 320], [3, 500, 240], [0, 0, 1]]\n", r"expected \[\[fx, skew, cx\]"),
        ("- 1\n- 2\n", "camera.yaml holds list; expected keys"),
        ("K: [1, 2\n", "camera.yaml cannot be read as YAML"),
        ("", "camera.yaml holds NoneType"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, text, message):
    with pytest.raises(DataError, match=message):
        read_camera(write(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    [
        "image_size: [1242, 375]\nK: [721.5, 721.5, 608.6, 171.9]\n",  # KITTI
        "image_size: [1216, 352]\nK: [721.5, 721.5, 595.6, 148.9]\n",  # KITTI, cropped at the top and the sides
        "image_size: [640, 192]\nK: [372, 368, 313, 88]\n",  # KITTI, squeezed
        "image_size: [640, 240]\nK: [500, 510, 321, 2]\n",  # all above the horizon cut off
        "image_size: [450, 480]\nK: [500, 510, 131, 242]\n",  # a third cut off at the left
        "image_size: [1280, 720]\nK: [229, 229, 640, 360]\nmodel: fisheye\n",  # 180 degrees in a circle
        "image_size: [1080, 1920]\nK: [1500, 1500, 540, 960]\n",  # a telephone held upright
    ],
)
def test_cameras_and_crops_that_can_be_are_accepted(tmp_path, text):
    assert read_camera(write(tmp_path, text)).K[0, 0] > 0


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"no camera file at .*gone.yaml; make one with saunet calibrate"):
        read_camera(tmp_path / "gone.yaml")


def camera(distortion, model="pinhole"):
    K = np.array([[200.0, 0, 160], [0, 201, 98], [0, 0, 1]])
    from pathlib import Path

    return CameraFile(Path("camera.yaml"), K, (200, 320), tuple(distortion), model)


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
@settings(max_examples=15, deadline=None)
@given(
    st.floats(-0.2, 0.1),  # beyond, the pinhole model folds back inside the picture
    st.floats(-0.4, 0.4),
    st.floats(-0.25, 0.25),
    st.sampled_from([(0, 0, 0, 0), (0.1, 0.2, 0.05, 0.15)]),
    st.sampled_from([1.0, 0.5, 2.0]),
)
def test_a_point_is_found_where_k_says_after_undistortion_crop_and_size(model, k1, x, y, crop, size):
    """A bright dot where the distorting lens shows a direction lies, straightened, where K projects that direction."""
    numbers = [k1, 0.02, 0.0, 0.0] if model == "fisheye" else [k1, 0.02, 0.001, -0.001, 0.0]
    described = camera(numbers, model)
    height, width = round(200 * size), round(320 * size)
    lens = Lens(described, height, width, crop)
    K = described.intrinsics(height, width)
    ray, still, dist = np.array([[[x, y, 1.0]]]), np.zeros(3), np.array(numbers)
    project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    seen = np.ravel(project(ray, still, still, K, dist)[0])
    expected = (lens.K @ [x, y, 1])[:2]
    v, u = np.mgrid[:height, :width]
    blob = np.exp(-((u - seen[0]) ** 2 + (v - seen[1]) ** 2) / (2 * (3 * size) ** 2))
    straight = lens(np.repeat(np.round(255 * blob)[..., None], 3, axis=2).astype(np.uint8))[..., 0].astype(float)
    inside = (12 * size < expected[0] < lens.width - 12 * size) and (12 * size < expected[1] < lens.height - 12 * size)
    assert straight.shape == (lens.height, lens.width)
    if inside:
        v, u = np.mgrid[: lens.height, : lens.width]
        peak = np.array([(straight * u).sum(), (straight * v).sum()]) / straight.sum()
        np.testing.assert_allclose(peak, expected, atol=0.6 * max(1, size))


def test_frames_of_another_size_are_named():
    lens = Lens(camera([]), 200, 320)
    with pytest.raises(DataError, match=r"a.png is 100x50 .* but other frames of its clip are 320x200"):
        lens(np.zeros((50, 100, 3), np.uint8), "a.png")


def test_numbers_that_yaml_reads_as_text_are_numbers(tmp_path):
    camera = read_camera(write(tmp_path, "image_size: [752, 480]\nK: [4.58654e2, 4.57296e2, 3.67e2, 248.4]\n"
                            "distortion: [-2.83e-01, 7.39e-2, 1e-5, -1E-5]\nfps: 1e1\n"))  # fmt: skip
    assert camera.K[0, 0] == 458.654
    assert camera.distortion == (-0.283, 0.0739, 1e-5, -1e-5)
    assert camera.fps == 10
    with pytest.raises(DataError, match="finite numbers, got 'many'"):
        read_camera(write(tmp_path, "image_size: [752, 480]\nK: [many, 457, 367, 248]\n"))
