"""Calibration files of other tools: what is read from each, what is refused, and that what is written is read back."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from saunet.data.video.calibrations import EXPORTS, export_camera
from saunet.data.video.camera import CameraFile, read_camera
from saunet.data.video.lens_models import pixels
from saunet.errors import ConfigError, DataError

ROS = """image_width: 752
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.283, 0.0739, 0.00019, 1.76e-05, 0.0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix:
  rows: 3
  cols: 4
  data: [420.0, 0, 370.0, 0, 0, 430.0, 249.0, 0, 0, 0, 1, 0]
"""
ROS_MESSAGE = """header: {stamp: {sec: 1, nanosec: 2}, frame_id: camera}
height: 480
width: 752
distortion_model: rational_polynomial
d: [1.0, 2.0, 0.001, 0.002, 3.0, 1.5, 2.5, 3.5]
k: [458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0]
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
p: [420.0, 0, 370.0, 0, 0, 430.0, 249.0, 0, 0, 0, 1, 0]
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""
OPENCV = """%YAML:1.0
---
calibration_time: "Mon 1 Jan 2024"
image_width: 752
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 4.58654e+02, 0., 3.67215e+02, 0., 4.57296e+02, 2.48375e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -2.83e-01, 7.39e-02, 1.9e-04, 1.76e-05, 0. ]
"""
OPENCV5 = """%YAML 1.2
---
image_size: [ 752, 480 ]
cameraMatrix: !!opencv-nd-matrix
   sizes: [ 3, 3 ]
   dt: d
   data: [ 4.58654e+02, 0., 3.67215e+02, 0., 4.57296e+02, 2.48375e+02, 0., 0., 1. ]
distCoeffs: !!opencv-nd-matrix
   sizes: [ 5 ]
   dt: d
   data: [ -2.83e-01, 7.39e-02, 1.9e-04, 1.76e-05, 0. ]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<!-- a comment -->
<image_Width>752</image_Width>
<image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>
    4.58654e+02 0. 3.67215e+02 0. 4.57296e+02 2.48375e+02 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt><data>
    -2.83e-01 7.39e-02 1.9e-04 1.76e-05 0.</data></Distortion_Coefficients>
</opencv_storage>
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.0034, 0.00072, -0.0020, 0.0002]
  distortion_model: equidistant
  intrinsics: [380.8, 380.9, 367.2, 248.3]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: omni
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [1.5, 779.2, 779.3, 379.0, 255.2]
  resolution: [752, 480]
"""
VINS = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 752
image_height: 480
projection_parameters:
   k2: 0.01
   k3: -0.02
   k4: 0.003
   k5: -0.0004
   mu: 380.8
   mv: 380.9
   u0: 367.2
   v0: 248.3
"""
KITTI360 = """%YAML:1.0
---
model_type: MEI
camera_name: image_02
image_width: 1400
image_height: 1400
mirror_parameters:
   xi: 2.2134
distortion_parameters:
   k1: 1.6798e-02
   k2: 1.6548
   p1: 4.2e-04
   p2: 4.1e-04
projection_parameters:
   gamma1: 1336.3
   gamma2: 1335.8
   u0: 716.94
   v0: 705.76
"""
KITTI = """calib_time: 25-May-2012 16:47:16
S_00: 1.392000e+03 5.120000e+02
K_00: 9.842439e+02 0 6.900000e+02 0 9.808141e+02 2.331966e+02 0 0 1
D_00: -3.728755e-01 2.037299e-01 2.219027e-03 1.383707e-03 -7.233722e-02
S_rect_00: 1.242000e+03 3.750000e+02
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
"""
ORB = """%YAML:1.0
# comment
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 380.8
Camera1.fy: 380.9
Camera1.cx: 367.2
Camera1.cy: 248.3
Camera1.k1: 0.01
Camera1.k2: -0.02
Camera1.k3: 0.003
Camera1.k4: -0.0004
Camera.width: 752
Camera.height: 480
Camera.fps: 20
Viewer.PointSize:2
IMU.T_b_c1: !!opencv-matrix
   rows: 1
   cols: 2
   dt: f
   data: [1.0, 0.0]
"""
NERF = {
    "camera_model": "OPENCV",
    **{"w": 752, "h": 480, "fl_x": 458.654, "fl_y": 457.296, "cx": 367.715, "cy": 248.875},
    **{"k1": -0.283, "k2": 0.0739, "p1": 0.00019, "p2": 1.76e-05},
    "frames": [{"file_path": "images/0.png", "transform_matrix": []}, {"file_path": "images/1.png"}],
}
MATLAB = {  # jsonencode(toStruct(cameraParams)): 1-based centers, the matrix transposed
    "ImageSize": [480, 752],
    "IntrinsicMatrix": [[458.654, 0, 0], [0, 457.296, 0], [368.215, 249.375, 1]],
    "RadialDistortion": [-0.283, 0.0739],
    "TangentialDistortion": [0.00019, 1.76e-05],
}
EUROC = ([458.654, 457.296, 367.215, 248.375], "pinhole", (-0.283, 0.0739, 0.00019, 1.76e-05, 0.0), (480, 752))
KB = ([380.8, 380.9, 367.2, 248.3], "fisheye", (0.01, -0.02, 0.003, -0.0004), (480, 752))
# written by pycolmap 4.2.1, Reconstruction.write_binary: camera 1 is OPENCV, 2 is SIMPLE_RADIAL
COLMAP_BINARY = base64.b64decode(
    "AgAAAAAAAAABAAAABAAAAIACAAAAAAAA4AEAAAAAAAAAAAAAAEB/QAAAAAAA4H9AAAAAAAAAdEAAAAAAABBuQJqZmZmZmbm/exSuR+F6lD/8qfHSTWJQ"
    "P/yp8dJNYmC/AgAAAAIAAACAAgAAAAAAAOABAAAAAAAAAAAAAAAAeUAAAAAAAAB0QAAAAAAAAG5AmpmZmZmZqb8="
)


def write(tmp_path, content, name="calibration"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("content", "name", "expected"),
    [
        (ROS, None, EUROC),
        (ROS, "narrow_stereo", EUROC),
        (ROS, "rect", ([420, 430, 370, 249], "pinhole", (), (480, 752))),
        (ROS_MESSAGE, None, (EUROC[0], "pinhole", (1, 2, 0.001, 0.002, 3, 1.5, 2.5, 3.5), (480, 752))),
        (ROS.replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4").replace(", 0.0]\nrect", "]\nrect"), None,
         (EUROC[0], "fisheye", EUROC[2][:4], (480, 752))),
        (OPENCV, None, EUROC),
        (OPENCV5, None, EUROC),
        (OPENCV_XML, None, EUROC),
        (OPENCV.replace("5\n   dt: d\n   data: [ -2.83e-01, 7.39e-02, 1.9e-04, 1.76e-05, 0. ]",
                        "4\n   dt: d\n   data: [ 0.01, -0.02, 0.003, -4e-4 ]\nfisheye_model: 1"), None,
         (EUROC[0], "fisheye", KB[2], (480, 752))),
        (KALIBR, "cam0", ([380.8, 380.9, 367.2, 248.3], "fisheye", (-0.0034, 0.00072, -0.002, 0.0002), (480, 752))),
        (KALIBR, "cam1", ([779.2, 779.3, 379, 255.2], "omni", (1.5, -0.1, 0.02, 0.001, -0.002), (480, 752))),
        (VINS, None, KB),
        (KITTI360, None,
         ([1336.3, 1335.8, 716.94, 705.76], "omni", (2.2134, 0.016798, 1.6548, 4.2e-4, 4.1e-4), (1400, 1400))),
        (KITTI, "rect_00", ([721.5377, 721.5377, 609.5593, 172.854], "pinhole", (), (375, 1242))),
        (KITTI, "raw_00", ([984.2439, 980.8141, 690, 233.1966], "pinhole",
                           (-0.3728755, 0.2037299, 0.002219027, 0.001383707, -0.07233722), (512, 1392))),
        (ORB, None, KB),
        (json.dumps(NERF), None, EUROC),
        (json.dumps({"w": 800, "h": 400, "camera_angle_x": np.pi / 2}), None,
         ([400, 400, 399.5, 199.5], "pinhole", (0,) * 5, (400, 800))),
        (json.dumps(MATLAB), None, EUROC),
        (COLMAP_BINARY, "1", ([500, 510, 319.5, 240], "pinhole", (-0.1, 0.02, 0.001, -0.002), (480, 640))),
        (COLMAP_BINARY, "2", ([400, 400, 319.5, 239.5], "pinhole", (-0.05, 0, 0, 0), (480, 640))),
    ],
)  # fmt: skip
def test_each_format_is_read_with_pixel_centers_at_integers(tmp_path, content, name, expected):
    path = write(tmp_path, content)
    camera = read_camera(f"{path}:{name}" if name else path)
    K, model, distortion, size = expected
    np.testing.assert_allclose(camera.K, [[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]], rtol=1e-12)
    assert (camera.model, camera.image_size) == (model, size)
    np.testing.assert_allclose(camera.distortion, distortion)
    assert camera.path == path


def test_opencv_reads_its_files_the_same_way(tmp_path):
    K, D = (
        np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]]),
        np.array([[-0.283, 0.07, 1e-4, 2e-5, 0]]),
    )
    for suffix in ("yml", "xml", "json"):
        path = tmp_path / f"calibration.{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for key, value in {"camera_matrix": K, "dist_coeffs": D, "image_width": 752, "image_height": 480}.items():
            storage.write(key, value)
        storage.release()
        camera = read_camera(path)
        np.testing.assert_array_equal(camera.K, K)
        assert camera.distortion == tuple(D[0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (KALIBR, r"Kalibr camchain\) has several cameras: cam0, cam1; choose one, such as .*calibration:cam0"),
        (KITTI, r"several cameras: raw_00, rect_00.* such as .*:rect_00"),
        (COLMAP_BINARY, r"several cameras: 1, 2"),
        (KALIBR.replace("equidistant", "radtan").replace("pinhole", "ds"), r"cam0 is ds with radtan; known are"),
        (VINS.replace("KANNALA_BRANDT", "SCARAMUZZA"), r"model_type is SCARAMUZZA; known are PINHOLE"),
        (VINS.replace("   mu: 380.8\n", ""), r"lacks 'mu'"),
        ("%YAML:1.0\n---\ncam0_calib: cam0_mei.yaml\nimage_width: 752\n", r"names other files \(cam0_mei.yaml"),
        (ORB.replace("Camera.width: 752\n", ""), r"ORB-SLAM settings but lacks 'Camera.width'; add it"),
        (OPENCV.replace("image_width: 752\n", ""), r"does not say the size of its images; add the lines image_width"),
        (OPENCV.replace("distortion_coefficients", "distortion_coefficents"), r"no distortion_coefficients"),
        (ROS.replace("plumb_bob", "omni7"), r"distortion model is omni7; known are plumb_bob"),
        (ROS_MESSAGE.replace("x_offset: 0", "x_offset: 8"), r"region of the sensor \(roi\)"),
        (ROS.replace("0.0739, 0.00019, ", ""), r"distortion needs a list of"),
        (ROS + "model_type: PINHOLE\n", r"read as VINS/KITTI-360 \(camodocal\) and as ROS"),
        ("1 EQUIRECTANGULAR 640 480 640 480\n", r"camera 1 is EQUIRECTANGULAR; known are SIMPLE_PINHOLE"),
        ("1 OPENCV 640 480 500 500 320 240\n", r"camera 1 has 4 parameters but OPENCV has 8"),
        (json.dumps(NERF | {"k4": 0.1}), r"k4 of a perspective camera"),
        (json.dumps(NERF | {"camera_model": "VR180_L"}), r"camera_model is VR180_L; known are"),
        (json.dumps({"frames": [], "camera_angle_x": 1.0}), r"Nerfstudio transforms.json but lacks 'w'"),
        (json.dumps(NERF | {"frames": [{"file_path": "a"}, {"file_path": "b", "fl_x": 400}]}),
         r"several cameras: a, b"),
        ("<!DOCTYPE x><opencv_storage/>", r"XML with DTD declarations"),
        ("<opencv_storage><a></opencv_storage>", r"cannot be read as XML"),
        (b"\x00\xff\xfe" * 40, r"neither text in UTF-8 nor a COLMAP cameras.bin"),
        ("name: something\nother: 3\n", r"not a readable calibration: camera.yaml, ROS, OpenCV, Kalibr"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_sentence(tmp_path, content, message):
    with pytest.raises(DataError, match=message) as caught:
        read_camera(write(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_a_camera_that_is_not_there_and_a_file_that_is_not(tmp_path):
    path = write(tmp_path, KALIBR)
    with pytest.raises(DataError, match=r"Kalibr camchain\) has no camera 'cam7'; it has: cam0, cam1"):
        read_camera(f"{path}:cam7")
    with pytest.raises(DataError, match=r"no camera file at .*gone:cam0"):
        read_camera(tmp_path / "gone:cam0")
    odd = write(tmp_path, ROS, "with:colon.yaml")
    assert read_camera(odd).K[0, 0] == 458.654


def camera(model, distortion, K=(458.654, 457.296, 367.215, 248.375)):
    fx, fy, cx, cy = K
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return CameraFile(Path("camera.yaml"), matrix, (480, 752), tuple(distortion), model)


CAMERAS = [
    camera("pinhole", []),
    camera("pinhole", [-0.283, 0.0739, 0.00019, 1.76e-05]),
    camera("pinhole", [-0.283, 0.0739, 0.00019, 1.76e-05, -0.004]),
    camera("pinhole", [1.0, 0.5, 0.001, 0.002, 0.3, 1.3, 0.8, 0.2]),
    camera("fisheye", []),
    camera("fisheye", [0.01, -0.02, 0.003, -0.0004]),
    camera("omni", [1.5, -0.1, 0.02, 0.001, -0.002], (779.2, 779.3, 379.0, 255.2)),
    camera("fov", [0.9]),
    camera("division", [-0.2]),
    camera("eucm", [0.6, 1.1]),
    camera("double_sphere", [-0.2, 0.55]),
    camera("thin_prism_fisheye", [0.05, -0.01, 0.001, -0.002, 0.004, -0.001, 0.003, -0.002]),
]
WRITTEN = {"ros": {0, 1, 2, 3, 4, 5}, "kalibr": {0, 1, 4, 5, 6, 7, 9, 10}, "colmap": {0, 1, 2, 3, 4, 5, 7, 8, 9, 11},
           "opencv": {0, 1, 2, 3, 4, 5}}  # fmt: skip


@pytest.mark.parametrize("kind", EXPORTS)
@pytest.mark.parametrize("number", range(len(CAMERAS)))
def test_what_is_written_sees_every_ray_where_it_was(tmp_path, kind, number):
    given, path = CAMERAS[number], tmp_path / "out"
    if number not in WRITTEN[kind]:
        with pytest.raises(ConfigError, match=rf"{kind} has no {given.model} lens with the distortion"):
            export_camera(path, given, kind)
        assert not path.exists()
        return
    export_camera(path, given, kind)
    again = read_camera(path)
    rays = np.array([[0.0, 0, 1], [0.3, -0.2, 1], [-0.5, 0.4, 1], [0.7, 0.6, 1]])
    seen = [pixels(each.model, each.distortion, each.K, rays) for each in (given, again)]
    np.testing.assert_allclose(*seen, atol=1e-9)
    assert again.image_size == given.image_size


def test_the_written_words_are_those_of_each_tool(tmp_path):
    given = CAMERAS[1]
    export_camera(tmp_path / "colmap", given, "colmap")
    words = (tmp_path / "colmap").read_text().splitlines()[1].split()
    assert words[:4] == ["1", "OPENCV", "752", "480"]
    assert [float(word) for word in words[6:8]] == [367.715, 248.875]  # the corner is their origin
    export_camera(tmp_path / "kalibr", given, "kalibr")
    kalibr = yaml.safe_load((tmp_path / "kalibr").read_text())["cam0"]
    assert (kalibr["camera_model"], kalibr["distortion_model"], kalibr["resolution"]) == (
        "pinhole",
        "radtan",
        [752, 480],
    )
    assert kalibr["intrinsics"] == [458.654, 457.296, 367.215, 248.375]
    export_camera(tmp_path / "ros", given, "ros")
    ros = yaml.safe_load((tmp_path / "ros").read_text())
    assert (ros["distortion_model"], len(ros["distortion_coefficients"]["data"])) == ("plumb_bob", 5)
    assert len(ros["projection_matrix"]["data"]) == 12
    export_camera(tmp_path / "opencv.yml", given, "opencv")
    storage = cv2.FileStorage(str(tmp_path / "opencv.yml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), given.K)
    np.testing.assert_array_equal(np.ravel(storage.getNode("distortion_coefficients").mat()), given.distortion)
    assert storage.getNode("image_width").real() == 752


def test_colmap_itself_sees_a_written_camera_where_we_do(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap (4.2.1 was tried) is not installed")
    rays = np.array([[0.0, 0, 1], [0.3, -0.2, 1], [-0.5, 0.4, 1], [0.7, 0.6, 1]])
    for number in WRITTEN["colmap"]:
        export_camera(tmp_path / "cameras.txt", CAMERAS[number], "colmap")
        _, name, width, height, *parameters = (tmp_path / "cameras.txt").read_text().splitlines()[1].split()
        theirs = pycolmap.Camera(
            model=name, width=int(width), height=int(height), params=[float(p) for p in parameters]
        )
        ours = pixels(CAMERAS[number].model, CAMERAS[number].distortion, CAMERAS[number].K, rays)
        np.testing.assert_allclose(np.array([theirs.img_from_cam(ray) for ray in rays]), ours + 0.5, atol=1e-9)


def test_export_needs_pixels_without_skew(tmp_path):
    skewed = CameraFile(Path("c"), np.array([[500.0, 3, 320], [0, 500, 240], [0, 0, 1]]), (480, 640))
    with pytest.raises(ConfigError, match="normalized or skewed"):
        export_camera(tmp_path / "out", skewed, "ros")
    with pytest.raises(ConfigError, match="export is 'roos'; did you mean 'ros'"):
        export_camera(tmp_path / "out", CAMERAS[0], "roos")
