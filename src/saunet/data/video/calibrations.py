"""Calibration files of other tools, converted to and from the keys of ``camera.yaml`` (docs/cameras.md).

A file's format is recognized by its content. The center of the first pixel is 0 here as in OpenCV, ROS and Kalibr, 0.5
in COLMAP and Nerfstudio, 1 in MATLAB.
"""

from __future__ import annotations

import math
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from saunet.data.video.lens_models import COEFFICIENTS
from saunet.errors import ConfigError, DataError, one_of
from saunet.io.atomic import write_bytes
from saunet.io.plain import parse_json, parse_yaml, read_bytes

if TYPE_CHECKING:
    from saunet.data.video.camera import CameraFile

Plain = dict[str, Any]
Cameras = Iterator[tuple[str, Plain]]
SUFFIXES = (".yaml", ".yml", ".json", ".txt", ".bin", ".xml")
FILE_NAME = "camera.yaml"
EXPORTS = {"ros": "_ros.yaml", "kalibr": "_kalibr.yaml", "colmap": "_colmap.txt", "opencv": "_opencv.yaml"}
"""Formats that can be written, with the endings of their file names."""


def split_name(given: str | Path) -> tuple[Path, str | None]:
    """Split ``FILE[:camera name]`` into the file and the camera's name."""
    path = Path(given).expanduser()
    before, colon, name = str(path).rpartition(":")
    return (Path(before), name) if colon and not path.exists() and Path(before).is_file() else (path, None)


def highest_folder(path: Path, base: Path) -> Path:
    """Return the topmost folder with a clip's camera file: the root, or the one around a clip that is the root."""
    return base.parent if path == base else base


def nearest_camera(path: Path, base: Path) -> Path | None:
    """Return the nearest camera file of a clip that was found below ``base``, or is it; None if there is none."""
    folders = [path, *path.parents] if path.is_dir() else list(path.parents)
    files = (folder / FILE_NAME for folder in folders[: folders.index(highest_folder(path, base)) + 1])
    return next((file for file in files if file.is_file()), None)


def find_camera(path: Path, name: str | None) -> Any:
    """Return one camera of a calibration file with the keys of ``camera.yaml``; such a file is returned unchanged.

    Raises:
        DataError: if the file is damaged, in no known format or in two, or has several cameras and none is named.
    """
    data = read_bytes(path)
    kind, cameras = _cameras(path, data)
    if not cameras:
        raise DataError(f"{path} is read as {kind} but has no camera in it")
    names = ", ".join(list(cameras)[:20]) + (" ..." if len(cameras) > 20 else "")
    if name is not None:
        if name not in cameras:
            raise DataError(f"{path} ({kind}) has no camera '{name}'; it has: {names or 'one without a name'}")
        return cameras[name]
    main = [each for each in cameras if each != "rect"] or names.split()
    if len(main) > 1 and any(cameras[each] != cameras[main[0]] for each in main):
        # KITTI publishes the rectified pictures
        rectified = next((each for each in main if each.startswith("rect_")), main[0])
        raise DataError(f"{path} ({kind}) has several cameras: {names}; choose one, such as {path}:{rectified}")
    return cameras[main[0]]


def _cameras(path: Path, data: bytes) -> tuple[str, dict[str, Any]]:
    """Return the format and the cameras by name."""
    binary = _colmap_binary(data)
    if binary is not None:
        return "COLMAP cameras.bin", _read(path, "COLMAP cameras.bin", lambda: _colmap(binary))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        raise DataError(
            f"{path} is neither text in UTF-8 nor a COLMAP cameras.bin; give a calibration file"
        ) from reason
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and all(re.match(r"\s*\d+ +[A-Z_0-9]+ +\d+ +\d+ ", line) for line in lines):
        return "COLMAP cameras.txt", _read(path, "COLMAP cameras.txt", lambda: _colmap(map(str.split, lines)))
    if any(re.match(r"(P_rect|K|S)_\d\d:", line) for line in lines):
        return "KITTI calibration", _read(path, "KITTI calibration", lambda: _kitti(lines))
    plain: Any
    if text.lstrip().startswith("{"):
        plain = parse_json(text, str(path), DataError)
    elif text.lstrip().startswith("<"):
        plain = _xml(path, text)
    else:
        if text.startswith("%YAML"):  # OpenCV's dialect: its own directive, and no space required after a key
            text = re.sub(r"(?m)^(\s*[\w.]+):(?=[^\s:])", r"\1: ", text.partition("\n")[2])
        documents = re.split(r"(?m)^(?:---|\.\.\.)[ \t]*$", text)
        filled = [each for each in documents if each.strip()]
        plain = parse_yaml(filled[0] if len(filled) == 1 else text, str(path), DataError)
    found = [(kind, reader) for kind, fits, reader in _KINDS if isinstance(plain, dict) and fits(plain)]
    if len(found) > 1:
        raise DataError(
            f"{path} can be read as {' and as '.join(kind for kind, _ in found)}; keep only one of them in it"
        )
    if found:
        kind, reader = found[0]
        return kind, _read(path, kind, lambda: reader(plain))
    return "camera.yaml", {"": plain}


def _read(path: Path, kind: str, cameras: Callable[[], Cameras]) -> dict[str, Any]:
    """Return a reader's result, and turn missing keys into one sentence."""
    try:
        return dict(cameras())
    except KeyError as reason:
        raise DataError(f"{path} is read as {kind} but lacks {reason}; add it, or write a camera.yaml") from reason
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError) as reason:
        if isinstance(reason, DataError):
            raise DataError(f"{path} is read as {kind}: {reason}") from reason
        raise DataError(f"{path} is read as {kind} and has an invalid value ({str(reason)[:80]})") from reason


def _camera(
    size: Sequence[Any], K: Sequence[Any], model: str, distortion: Sequence[Any], corner: float = 0.0, **more: Any
) -> Plain:
    """Return a camera with the keys of ``camera.yaml``; ``corner`` is the first pixel's center in the file."""
    numbers = [float(each) for each in K]
    x, y = (2, 3) if len(numbers) == 4 else (2, 5)
    numbers[x], numbers[y] = numbers[x] - corner, numbers[y] - corner
    bent = [float(each) for each in distortion]
    plain = {"image_size": [int(float(each)) for each in size], "K": numbers, "model": model, "distortion": bent}
    return plain | {key: value for key, value in more.items() if value is not None}


def _flat(value: Any) -> list[Any]:
    """Return the numbers of a matrix, as a list, rows, or OpenCV's and ROS' mapping."""
    value = value["data"] if isinstance(value, Mapping) else value
    value = value.split() if isinstance(value, str) else value
    return [number for row in value for number in (row if isinstance(row, list) else [row])]


# ROS camera_info files and messages, OpenCV FileStorage: the same keys in several spellings.
_SPELLINGS = {
    "K": ("cameramatrix", "k", "intrinsicmatrix", "intrinsics"),
    "D": ("distortioncoefficients", "distcoeffs", "d", "distcoeff"),
    "P": ("projectionmatrix", "p"),
    "width": ("imagewidth", "width"),
    "height": ("imageheight", "height"),
    "size": ("imagesize", "imageresolution", "calibrationresolution"),
    "model": ("distortionmodel", "cameramodel"),
}
_BENT = {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}


def _spelled(plain: Mapping[str, Any]) -> Plain:
    short = {re.sub("[^a-z]", "", str(key).lower()): value for key, value in plain.items()}
    return {word: short[key] for word, keys in _SPELLINGS.items() for key in keys if key in short}


def _is_opencv(plain: Plain) -> bool:
    words = _spelled(plain)
    return "K" in words and (isinstance(words["K"], Mapping) or {"D", "width"} <= set(words))


def _opencv(plain: Plain) -> Cameras:
    words = _spelled(plain)
    size = [words["width"], words["height"]] if "width" in words else _flat(words["size"]) if "size" in words else None
    if size is None:
        raise DataError("it does not say the size of its images; add the lines image_width: and image_height:")
    if "D" not in words:
        raise DataError("it has no distortion_coefficients; add them (zeros for undistorted images)")
    roi = plain.get("roi") or {}
    if roi.get("x_offset") or roi.get("y_offset"):
        raise DataError("its images are a region of the sensor (roi); crop K and size yourself in a camera.yaml")
    model = str(words.get("model") or ("fisheye" if float(plain.get("fisheye_model") or 0) else "plumb_bob"))
    if model not in _BENT:
        raise DataError(f"its distortion model is {model}; known are {', '.join(_BENT)}")
    yield str(plain.get("camera_name") or "raw"), _camera(size, _flat(words["K"]), _BENT[model], _flat(words["D"]))
    P = _flat(words.get("P", []))
    if len(P) == 12 and float(P[0]):
        yield "rect", _camera(size, [P[0], P[5], P[2], P[6]], "pinhole", [])


def _xml(path: Path, text: str) -> Any:
    try:
        if "<!" in re.sub("<!--.*?-->", "", text, flags=re.DOTALL):
            raise DataError(f"{path} is XML with DTD declarations, which no calibration needs; remove them")
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as reason:
        raise DataError(f"{path} cannot be read as XML ({reason})") from reason
    return {
        each.tag: {part.tag: part.text for part in each} if len(each) else (each.text or "").strip() for each in root
    }


_KALIBR = {
    ("pinhole", "radtan"): "pinhole",
    ("pinhole", "equidistant"): "fisheye",
    ("pinhole", "fov"): "fov",
    ("pinhole", "none"): "pinhole",
    ("omni", "radtan"): "omni",
    ("omni", "none"): "omni",
    ("eucm", "none"): "eucm",
    ("ds", "none"): "double_sphere",
}


def _is_kalibr(plain: Plain) -> bool:
    blocks = [plain, *(each for each in plain.values() if isinstance(each, dict))]
    return any({"intrinsics", "camera_model"} <= set(each) for each in blocks)


def _kalibr(plain: Plain) -> Cameras:
    for name, each in ({"cam0": plain} if "intrinsics" in plain else plain).items():
        if not isinstance(each, dict) or "intrinsics" not in each:
            continue
        bend = str(each.get("distortion_model") or "none")
        bend = {"equi": "equidistant", "radial-tangential": "radtan"}.get(bend, bend)
        model = _KALIBR.get((each["camera_model"], bend))
        if model is None:
            raise DataError(
                f"{name} is {each['camera_model']} with {bend}; known are {', '.join(map('-'.join, _KALIBR))}"
            )
        *mirror, fx, fy, cx, cy = each["intrinsics"]
        key = "distortion_coefficients" if "distortion_coefficients" in each else "distortion_coeffs"
        bent = each[key] if bend != "none" else [0, 0, 0, 0] if model == "omni" else []
        yield name, _camera(each["resolution"], [fx, fy, cx, cy], model, [*mirror, *bent], fps=each.get("rate_hz"))


# VINS, camodocal, KITTI-360's fisheye cameras: focal lengths and center, then distortion.
_CAMODOCAL = {
    "PINHOLE": ("pinhole", "fx fy cx cy", "k1 k2 p1 p2"),
    "PINHOLE_FULL": ("pinhole", "fx fy cx cy", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "KANNALA_BRANDT": ("fisheye", "mu mv u0 v0", "k2 k3 k4 k5"),
    "MEI": ("omni", "gamma1 gamma2 u0 v0", "xi k1 k2 p1 p2"),
}


def _camodocal(plain: Plain) -> Cameras:
    kind = str(plain["model_type"]).upper()
    if kind not in _CAMODOCAL:
        raise DataError(f"its model_type is {kind}; known are {', '.join(_CAMODOCAL)}")
    model, K, bent = _CAMODOCAL[kind]
    blocks = ("projection_parameters", "distortion_parameters", "mirror_parameters")
    numbers = {key: value for block in blocks for key, value in (plain.get(block) or {}).items()}
    size = plain["image_width"], plain["image_height"]
    yield (
        str(plain.get("camera_name") or "camera"),
        _camera(size, [numbers[key] for key in K.split()], model, [numbers[key] for key in bent.split()]),
    )


def _orb(plain: Plain) -> Cameras:
    kind = str(plain.get("Camera.type", "PinHole"))
    if kind not in ("PinHole", "Rectified", "KannalaBrandt8"):
        raise DataError(f"its Camera.type is {kind}; known are PinHole, Rectified, KannalaBrandt8")
    for name in ("Camera", "Camera1", "Camera2"):
        if f"{name}.fx" not in plain:
            continue
        K = [plain[f"{name}.{key}"] for key in ("fx", "fy", "cx", "cy")]
        bent: list[Any] = []
        if kind == "KannalaBrandt8":
            bent = [plain[f"{name}.k{number}"] for number in (1, 2, 3, 4)]
        elif kind == "PinHole":
            bent = [plain.get(f"{name}.{key}", 0) for key in ("k1", "k2", "p1", "p2", "k3")]
        model = "fisheye" if kind == "KannalaBrandt8" else "pinhole"
        size = plain["Camera.width"], plain["Camera.height"]
        yield name, _camera(size, K, model, bent, fps=plain.get("Camera.fps"))
    for side in ("LEFT", "RIGHT"):
        if f"{side}.K" in plain:
            size = plain[f"{side}.width"], plain[f"{side}.height"]
            yield side, _camera(size, _flat(plain[f"{side}.K"]), "pinhole", _flat(plain[f"{side}.D"]))


# COLMAP's models by number: name, focal lengths, all parameters, our model if any; the rest is distortion in our order.
_COLMAP: dict[int, tuple[str, int, int, str]] = {
    0: ("SIMPLE_PINHOLE", 1, 3, "pinhole"),
    1: ("PINHOLE", 2, 4, "pinhole"),
    2: ("SIMPLE_RADIAL", 1, 4, "pinhole"),
    3: ("RADIAL", 1, 5, "pinhole"),
    4: ("OPENCV", 2, 8, "pinhole"),
    5: ("OPENCV_FISHEYE", 2, 8, "fisheye"),
    6: ("FULL_OPENCV", 2, 12, "pinhole"),
    7: ("FOV", 2, 5, "fov"),
    8: ("SIMPLE_RADIAL_FISHEYE", 1, 4, "fisheye"),
    9: ("RADIAL_FISHEYE", 1, 5, "fisheye"),
    10: ("THIN_PRISM_FISHEYE", 2, 12, "thin_prism_fisheye"),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 2, 16, ""),
    12: ("SIMPLE_DIVISION", 1, 4, "division"),
    13: ("DIVISION", 2, 5, "division"),
    14: ("SIMPLE_FISHEYE", 1, 3, "fisheye"),
    15: ("FISHEYE", 2, 4, "fisheye"),
    16: ("EUCM", 2, 6, "eucm"),
    17: ("EQUIRECTANGULAR", 0, 2, ""),
}


def _colmap_binary(data: bytes) -> list[list[Any]] | None:
    """Return the rows of a cameras.bin as in a cameras.txt; None if the bytes are not a cameras.bin."""
    rows: list[list[Any]] = []
    try:
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(min(count, len(data))):
            number, model, width, height = struct.unpack_from("<IiQQ", data, at)
            name, _, parameters, _ = _COLMAP[model]
            rows.append([number, name, width, height, *struct.unpack_from(f"<{parameters}d", data, at + 24)])
            at += 24 + 8 * parameters
    except (struct.error, KeyError):
        return None
    return rows if rows and at == len(data) else None


def _colmap(rows: Any) -> Cameras:
    known = {entry[0]: entry for entry in _COLMAP.values() if entry[3]}
    for number, name, width, height, *parameters in rows:
        if name not in known:
            raise DataError(f"camera {number} is {name}; known are {', '.join(known)}")
        _, focals, count, model = known[name]
        if len(parameters) != count:
            raise DataError(f"camera {number} has {len(parameters)} parameters but {name} has {count}")
        K = [parameters[0], parameters[focals - 1], *parameters[focals : focals + 2]]
        bent = list(parameters[focals + 2 :])
        bent += [0.0] * (next(each for each in COEFFICIENTS[model] if each >= len(bent)) - len(bent))
        yield str(number), _camera([width, height], K, model, bent, corner=0.5)


def _kitti(lines: Sequence[str]) -> Cameras:
    fields = {key.strip(): value.split() for key, _, value in (line.partition(":") for line in lines)}
    for key in fields:
        number = key[-2:]
        if re.fullmatch(r"K_\d\d", key):
            yield f"raw_{number}", _camera(fields[f"S_{number}"], fields[key], "pinhole", fields[f"D_{number}"])
        elif re.fullmatch(r"P_rect_\d\d", key):
            P = fields[key]
            yield f"rect_{number}", _camera(fields[f"S_rect_{number}"], [P[0], P[5], P[2], P[6]], "pinhole", [])


def _nerfstudio(plain: Plain) -> Cameras:
    for number, frame in enumerate(plain.get("frames") or [{}]):
        words = {**plain, **frame}
        size = words["w"], words["h"]
        if "fl_x" not in words and "camera_angle_x" not in words:
            raise KeyError("fl_x")
        fx = float(words.get("fl_x") or float(size[0]) / 2 / math.tan(float(words["camera_angle_x"]) / 2))
        K = [fx, words.get("fl_y", fx), words.get("cx", float(size[0]) / 2), words.get("cy", float(size[1]) / 2)]
        kind = str(words.get("camera_model", "OPENCV_FISHEYE" if words.get("is_fisheye") else "OPENCV"))
        fisheye = kind in ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
        if not fisheye and kind not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
            raise DataError(f"its camera_model is {kind}; known are the pinhole models, OPENCV and OPENCV_FISHEYE")
        k1, k2, k3, k4, p1, p2 = (float(words.get(key) or 0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
        if not fisheye and k4:
            raise DataError("k4 of a perspective camera has different meanings in different tools; give COLMAP's file")
        bent = [k1, k2, k3, k4] if fisheye else [k1, k2, p1, p2, k3]
        camera = _camera(size, K, "fisheye" if fisheye else "pinhole", bent, corner=0.5)
        yield str(frame.get("file_path", number)), camera


def _matlab(plain: Plain) -> Cameras:
    height, width = _flat(plain["ImageSize"])
    if "IntrinsicMatrix" in plain and "K" not in plain:  # transposed
        K = _flat(plain["IntrinsicMatrix"])
        K = [K[0], K[3], K[6], K[1], K[4], K[7], 0, 0, 1]
    else:
        K = _flat(plain["K"]) if "K" in plain else [*plain["FocalLength"], *plain["PrincipalPoint"]]
    k1, k2, k3 = [*_flat(plain["RadialDistortion"]), 0][:3]
    p1, p2 = _flat(plain["TangentialDistortion"])
    yield "camera", _camera([width, height], K, "pinhole", [k1, k2, p1, p2, k3], corner=1.0)


def _elsewhere(plain: Plain) -> Cameras:
    raise DataError(f"it only names other files ({plain['cam0_calib']} ...); give one of these")


_KINDS: tuple[tuple[str, Callable[[Plain], bool], Callable[[Plain], Cameras]], ...] = (
    ("Kalibr camchain", _is_kalibr, _kalibr),
    ("VINS/KITTI-360 (camodocal)", lambda plain: "model_type" in plain and "cam0_calib" not in plain, _camodocal),
    ("VINS settings", lambda plain: "cam0_calib" in plain, _elsewhere),
    ("ORB-SLAM settings", lambda plain: "Camera.fx" in plain or "Camera1.fx" in plain, _orb),
    ("MATLAB cameraParameters", lambda plain: "RadialDistortion" in plain, _matlab),
    (
        "Nerfstudio transforms.json",
        lambda plain: "fl_x" in plain or "camera_angle_x" in plain or ("frames" in plain and "K" not in plain),
        _nerfstudio,
    ),
    ("ROS camera_info/OpenCV FileStorage", _is_opencv, _opencv),
)


def export_camera(path: str | Path, camera: CameraFile, kind: str) -> None:
    """Write a camera for another tool, whole or not at all.

    Raises:
        ConfigError: if the format is unknown or has no such lens model.
    """
    write_bytes(path, _exported(camera, kind).encode())


def export_rig(path: str | Path, cameras: Sequence[CameraFile], poses: Sequence[Any]) -> None:
    """Write the cameras of a rig as a Kalibr camchain; ``poses`` are T_cn_cnm1 of all but the first, 4 x 4, meters."""
    chain: Plain = {}
    for number, camera in enumerate(cameras):
        chain[f"cam{number}"] = {**yaml.safe_load(_exported(camera, "kalibr"))["cam0"], "rostopic": f"/cam{number}"}
        if number:
            chain[f"cam{number}"]["T_cn_cnm1"] = [[float(each) for each in row] for row in poses[number - 1]]
    write_bytes(path, _dump(chain).encode())


def _exported(camera: CameraFile, kind: str) -> str:
    one_of("export", kind, EXPORTS)
    if camera.image_size is None or camera.K[0, 1]:
        raise ConfigError("export needs K in pixels and without skew; this camera's is normalized or skewed")
    height, width = camera.image_size
    K = [float(camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]
    bent, model = [float(each) for each in camera.distortion], camera.model
    text = {"ros": _to_ros, "kalibr": _to_kalibr, "colmap": _to_colmap, "opencv": _to_opencv}[kind](
        width, height, K, bent, model
    )
    if text is None:
        raise ConfigError(
            f"{kind} has no {model} lens with the distortion {bent}; choose another export "
            "(for kalibr calibrate with export=kalibr, which leaves k3 out)"
        )
    return text


def _to_ros(width: int, height: int, K: list[float], bent: list[float], model: str) -> str | None:
    names = {("pinhole", 0): "plumb_bob", ("pinhole", 4): "plumb_bob", ("pinhole", 5): "plumb_bob"}
    names |= {("pinhole", 8): "rational_polynomial"} | {("fisheye", count): "equidistant" for count in range(5)}
    name = names.get((model, len(bent)))
    if name is None:
        return None
    bent = bent + [0.0] * ({"plumb_bob": 5, "equidistant": 4}.get(name, 8) - len(bent))
    fx, fy, cx, cy = K
    plain = {
        "image_width": width,
        "image_height": height,
        "camera_name": "camera",
        "camera_matrix": _rows([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], 3),
        "distortion_model": name,
        "distortion_coefficients": _rows(bent, 1),
        "rectification_matrix": _rows([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], 3),
        "projection_matrix": _rows([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0], 3),
    }
    return _dump(plain)


def _to_kalibr(width: int, height: int, K: list[float], bent: list[float], model: str) -> str | None:
    if model == "pinhole" and any(bent[4:]):
        return None
    names = {ours: theirs for theirs, ours in reversed(_KALIBR.items())}
    if model not in names:
        return None
    mirror = {"omni": 1, "eucm": 2, "double_sphere": 2}.get(model, 0)
    lens, bend = names[model]
    bent = (bent if model != "pinhole" else bent[:4]) + [0.0] * ({"pinhole": 4, "fisheye": 4}.get(model, 0) - len(bent))
    plain: Plain = {"camera_model": lens, "intrinsics": [*bent[:mirror], *K], "distortion_model": bend}
    plain |= {"distortion_coeffs": bent[mirror:], "resolution": [width, height], "rostopic": "/camera/image_raw"}
    return _dump({"cam0": plain})


def _to_colmap(width: int, height: int, K: list[float], bent: list[float], model: str) -> str | None:
    fitting = ("PINHOLE", "OPENCV", "FULL_OPENCV", "FISHEYE", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE")
    for name, focals, count, ours in _COLMAP.values():
        room = count - focals - 2
        if name in (*fitting, "DIVISION", "EUCM") and ours == model and not any(bent[room:]):
            numbers = [K[0], K[1], K[2] + 0.5, K[3] + 0.5, *(bent + [0.0] * room)[:room]]
            values = " ".join(map(repr, numbers))
            return f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {name} {width} {height} {values}\n"
    return None


def _to_opencv(width: int, height: int, K: list[float], bent: list[float], model: str) -> str | None:
    if model not in ("pinhole", "fisheye"):
        return None
    fx, fy, cx, cy = K
    bent = bent + [0.0] * ((4 if model == "fisheye" else 5 if not bent else 0) - len(bent))
    matrices = {"camera_matrix": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], "distortion_coefficients": bent}
    text = f"%YAML:1.0\n---\nimage_width: {width}\nimage_height: {height}\nfisheye_model: {int(model == 'fisheye')}\n"
    for key, numbers in matrices.items():
        rows = 3 if key == "camera_matrix" else 1
        text += f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {len(numbers) // rows}\n   dt: d\n"
        text += f"   data: [ {', '.join(map(repr, numbers))} ]\n"
    return text


def _rows(numbers: list[float], rows: int) -> Plain:
    return {"rows": rows, "cols": len(numbers) // rows, "data": numbers}


def _dump(plain: Plain) -> str:
    return str(yaml.safe_dump(plain, sort_keys=False, default_flow_style=None))
