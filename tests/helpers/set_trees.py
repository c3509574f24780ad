"""Tiny trees in the true layouts of the field's data sets; what is in them is in the constants."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Axes of a camera that looks ahead (x right, y down, z forward), in a car's (x forward, y left, z up)."""


def picture(path: Path, size: tuple[int, int], seed: int) -> None:
    """Write an image whose red value at the top left is the seed."""
    noise = np.random.default_rng(seed).integers(0, 255, (6, 10, 3), dtype=np.uint8)
    image = cv2.resize(noise, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
    image[:2, :2] = (0, 0, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def motion(R: np.ndarray, t: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def wxyz(R: np.ndarray) -> list[float]:
    x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
    return [w, x, y, z]


def write_json(path: Path, plain: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(plain, indent=0))


# Cityscapes

CITYSCAPES_FX, CITYSCAPES_BASELINE = 2262.52, 0.209313


def cityscapes(root: Path, right: bool = False) -> Path:
    """One snippet of seven frames in each split, numbered as hanover's: one counter for the whole city."""
    for split, city in (("train", "aachen"), ("val", "munster"), ("test", "berlin")):
        for frame in range(161, 168):
            for kind in ("left", "right") if right else ("left",):
                name = f"{city}_000000_{frame:06d}_{kind}Img8bit.png"
                picture(root / f"{kind}Img8bit_sequence" / split / city / name, (64, 128), frame)
        start = f"{city}_000000_000164_"
        intrinsic = {"fx": CITYSCAPES_FX, "fy": 2265.3017905988554, "u0": 1096.98, "v0": 513.137}
        extrinsic = {
            "baseline": CITYSCAPES_BASELINE,
            "pitch": 0.038,
            "roll": 0.0,
            "x": 1.7,
            "y": 0.1,
            "yaw": 0,
            "z": 1.22,
        }
        camera = root / "camera" / split / city / f"{start}camera.json"
        write_json(camera, {"extrinsic": extrinsic, "intrinsic": intrinsic})
        stored = np.zeros((1024, 2048), np.uint16)
        stored[700, 100:103] = 1, 2, 12801  # infinitely far, 1/256 of a pixel, 50 pixels
        stored[800] = 5000  # the bonnet
        stored[300:700, 300:1700] = 6001
        path = root / "disparity" / split / city / f"{start}disparity.png"
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), stored)
    return root


# DDAD

DDAD_K = np.array([[60.0, 0, 31], [0, 58, 21], [0, 0, 1]])
DDAD_SIZE = (40, 64)
DDAD_T_CAR_CAM = motion(FORWARD, (1.7, 0.2, 1.5))


def ddad(root: Path, cameras: tuple[str, ...] = ("CAMERA_01", "CAMERA_05")) -> Path:
    """One scene to train and one to validate, of five samples; the car drives 1 m a sample, 0.3 m after a scan."""
    scenes = {}
    for split, name in (("0", "000000"), ("1", "000150")):
        data, samples = [], []
        for index in range(5):
            keys = []
            for sensor in ("LIDAR", *cameras):
                x, T = (
                    index + (0 if sensor == "LIDAR" else 0.3),
                    motion(Rotation.from_euler("z", 30, degrees=True).as_matrix(), (0, 0, 0)),
                )
                T = T @ motion(np.eye(3), (x, 0, 0))
                T = T if sensor == "LIDAR" else T @ DDAD_T_CAR_CAM
                key = f"{name}{index}{sensor}"
                stamp = f"2019-09-11T20:15:0{index}.{'000000' if sensor == 'LIDAR' else '300000'}Z"
                record = {"pose": dgp_pose(T), "annotations": {}, "metadata": {}}
                if sensor == "LIDAR":
                    file = f"point_cloud/LIDAR/{index}.npz"
                    path = root / name / file
                    path.parent.mkdir(parents=True, exist_ok=True)
                    points = [(12.0, 0.2, 1.5, 7), (300.0, 0.2, 1.5, 7), (12.0, 3.2, 1.0, 7), (-5.0, 0, 0, 7)]
                    np.savez(path, data=np.array(points, np.float32))
                    datum = {"point_cloud": {**record, "filename": file, "point_format": ["X", "Y", "Z", "INTENSITY"]}}
                else:
                    file = f"rgb/{sensor}/{index}.png"
                    picture(root / name / file, DDAD_SIZE, index)
                    height, width = DDAD_SIZE
                    datum = {"image": {**record, "filename": file, "height": height, "width": width, "channels": 3}}
                data.append(
                    {"key": key, "id": {"name": sensor, "timestamp": stamp, "index": "0", "log": ""}, "datum": datum}
                )
                keys.append(key)
            samples.append({"calibration_key": "cafe", "datum_keys": keys, "id": {"timestamp": stamp}})
        write_json(root / name / "scene_beef.json", {"data": data, "samples": samples, "name": "", "log": ""})
        zero = {"cx": 0.0, "cy": 0.0, "fx": 0.0, "fy": 0.0, "skew": 0.0}
        lens = {"fx": DDAD_K[0, 0], "fy": DDAD_K[1, 1], "cx": DDAD_K[0, 2], "cy": DDAD_K[1, 2], "skew": 0.0}
        calibration = {
            "names": ["LIDAR", *cameras],
            "intrinsics": [zero, *[lens] * len(cameras)],
            "extrinsics": [dgp_pose(np.eye(4)), *[dgp_pose(DDAD_T_CAR_CAM)] * len(cameras)],
        }
        write_json(root / name / "calibration" / "cafe.json", calibration)
        scenes[split] = {"filenames": [f"{name}/scene_beef.json"]}
    write_json(root / "ddad.json", {"metadata": {"name": "DDAD"}, "scene_splits": scenes})
    return root


def dgp_pose(T: np.ndarray) -> dict[str, dict[str, float]]:
    rotation = dict(zip(("qw", "qx", "qy", "qz"), wxyz(T[:3, :3]), strict=True))
    return {"rotation": rotation, "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True))}


# KITTI-360: its own calibration of 2013_05_28, to the digits printed there

KITTI_360_FISHEYE = """%YAML:1.0
---
model_type: MEI
camera_name: image_02
image_width: 1400
image_height: 1400
mirror_parameters:
   xi: 2.2134047507854890e+00
distortion_parameters:
   k1: 1.6798235660113681e-02
   k2: 1.6548773243373522e+00
   p1: 4.2223943394772046e-04
   p2: 4.2462134260997584e-04
projection_parameters:
   gamma1: 1.3363220825849971e+03
   gamma2: 1.3357883350012958e+03
   u0: 7.1694323510126321e+02
   v0: 7.0576498308221585e+02
"""
KITTI_360_PERSPECTIVE = (
    "calib_time: 14-Apr-2021 14:31:33\n"
    "S_rect_00: 1408.000000 376.000000\n"
    "R_rect_00: 0.999974 -0.007141 -0.000089 0.007141 0.999969 -0.003247 0.000112 0.003247 0.999995\n"
    "P_rect_00: 552.554261 0.000000 682.049453 0.000000 0.000000 552.554261 238.769549 0.000000 "
    "0.000000 0.000000 1.000000 0.000000\n"
    "S_rect_01: 1408.000000 376.000000\n"
    "R_rect_01: 0.999974 -0.007141 -0.000089 0.007141 0.999969 -0.003247 0.000112 0.003247 0.999995\n"
    "P_rect_01: 552.554261 0.000000 682.049453 -328.318735 0.000000 552.554261 238.769549 0.000000 "
    "0.000000 0.000000 1.000000 0.000000\n"
)
KITTI_360_TO_CAR = (
    "image_00: 0.0371783278 -0.0986182135 0.9944306009 1.5752681039 0.9992675562 -0.0053553387 "
    "-0.0378902567 0.0043914093 0.0090621821 0.9951109327 0.0983468786 -0.6500000000\n"
    "image_01: 0.0194000864 -0.1051529641 0.9942668106 1.5977241400 0.9997374956 -0.0100836652 "
    "-0.0205732716 0.5981494900 0.0121891942 0.9944049345 0.1049297370 -0.6488433108\n"
)
KITTI_360_LEFT = motion(
    Rotation.from_euler("xyz", [0.05, -0.04, 0.03]).as_matrix() @ [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]],
    (0.7, -0.4, -0.9),
)
"""The fisheye camera that looks to the left, in the car's frame (x forward, y right, z down); made up."""
KITTI_360_VELO = (
    "0.04307104361 -0.08829286498 0.995162929 0.8043914418 -0.999004371 0.007784614041 "
    "0.04392796942 0.2993489574 -0.01162548558 -0.9960641394 -0.08786966659 -0.1770225824\n"
)
KITTI_360_POSE = np.array(
    [
        [0.6804458798, -0.7314378405, 0.0446328361, 3639.236961],
        [-0.7298356009, -0.6819080306, -0.0483883609, 1708.205377],
        [0.0658285676, 0.000351028, -0.9978308857, 122.056814],
    ]
)
"""Of frame 0; the car drives 1 m a frame along the world's x."""
KITTI_360_POINTS = np.array([[12, 0.5, -1, 0.3], [30, -8, 0.5, 0.1], [3, 9, 0.2, 0.9], [-7, 1, 0, 0.2]], np.float32)
"""In the scanner's frame: x forward, y left, z up."""


def kitti_360(root: Path, fisheye: bool = False) -> Path:
    """Sequence 0003 with six frames and four poses, 0006 and 0009 with three of each; images a quarter as large."""
    for name, frames, posed in (
        ("0003", range(2, 8), range(3, 7)),
        ("0006", range(3), range(3)),
        ("0009", range(3), range(3)),
    ):
        sequence = f"2013_05_28_drive_{name}_sync"
        cameras = {"image_00": ("data_rect", (94, 352)), "image_01": ("data_rect", (94, 352))}
        cameras |= {"image_02": ("data_rgb", (140, 140))} if fisheye else {}
        for camera, (folder, size) in cameras.items():
            images = root / "data_2d_raw" / sequence / camera
            for frame in frames:
                picture(images / folder / f"{frame:010d}.png", size, frame)
            stamps = [f"2013-05-28 08:46:{2 + 0.1 * frame:012.9f}" for frame in range(max(frames) + 1)]
            (images / "timestamps.txt").write_text("\n".join(stamps) + "\n")
        poses = root / "data_poses" / sequence / "poses.txt"
        poses.parent.mkdir(parents=True)
        step = np.zeros((3, 4))
        step[0, 3] = 1
        rows = [[frame, *(KITTI_360_POSE + frame * step).ravel().tolist()] for frame in posed]
        poses.write_text("".join(" ".join(map(repr, row)) + "\n" for row in rows))
        scans = root / "data_3d_raw" / sequence / "velodyne_points" / "data"
        scans.mkdir(parents=True)
        for frame in frames:
            KITTI_360_POINTS.tofile(scans / f"{frame:010d}.bin")
    home = root / "calibration"
    home.mkdir()
    (home / "perspective.txt").write_text(KITTI_360_PERSPECTIVE)
    sides = " ".join(map(repr, KITTI_360_LEFT[:3].ravel().tolist()))
    (home / "calib_cam_to_pose.txt").write_text(f"{KITTI_360_TO_CAR}image_02: {sides}\nimage_03: {sides}\n")
    (home / "calib_cam_to_velo.txt").write_text(KITTI_360_VELO)
    (home / "image_02.yaml").write_text(KITTI_360_FISHEYE)
    return root


# nuScenes

NUSCENES_K = [
    [1266.417203046554, 0.0, 816.2670197447984],
    [0.0, 1266.417203046554, 491.50706579294757],
    [0.0, 0.0, 1.0],
]
NUSCENES_CAMERA = (
    [0.4998015430569128, -0.5030316162024876, 0.4997798114386805, -0.49737083824542755],
    [1.70079118954, 0.0159456324149, 1.51095763913],
)
NUSCENES_LIDAR = (
    [0.7077955119163518, -0.006492242056004365, 0.010646214713995808, -0.7063073142877817],
    [0.943713, 0.0, 1.84023],
)
NUSCENES_POINTS = np.array([[0.5, 14, -1, 9, 0], [-3, 25, 0.5, 9, 1], [0, -8, 0, 9, 2]], np.float32)
"""In the scanner's frame: x right, y forward, z up."""
NUSCENES_SCENES = {
    "scene-0061": "Parked truck, construction, intersection, turn left, following a van",
    "scene-0103": "Many peds right, wait for turning car, long bike rack left, cyclist",
    "scene-1077": "Night, big street, bus stop, high speed, construction vehicle",
    "scene-0916": "After rain, parking lot, bicycle rack",
}


def nuscenes(root: Path, version: str = "v1.0-mini", missing: tuple[str, ...] = ()) -> Path:
    """Four scenes of two samples 0.5 s apart and the sweeps between; the car drives 5 m/s along its own x and turns."""
    tables: dict[str, list[dict[str, object]]] = {
        "sensor": [{"token": f"s{c}", "channel": c} for c in ("CAM_FRONT", "CAM_BACK", "LIDAR_TOP")],
        "calibrated_sensor": [],
        "scene": [],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
    }
    for number, (scene, description) in enumerate(NUSCENES_SCENES.items()):
        tables["scene"].append({"token": f"t{scene}", "name": scene, "description": description, "nbr_samples": 2})
        calibrations = {"CAM_FRONT": (NUSCENES_CAMERA, NUSCENES_K), "CAM_BACK": (NUSCENES_CAMERA, NUSCENES_K)}
        for channel, ((rotation, translation), K) in {**calibrations, "LIDAR_TOP": (NUSCENES_LIDAR, [])}.items():
            row = {"token": f"c{scene}{channel}", "sensor_token": f"s{channel}", "rotation": rotation}
            tables["calibrated_sensor"].append({**row, "translation": translation, "camera_intrinsic": K})
        start = 1_532_402_927_000_000 + number * 60_000_000
        for sample in range(2):
            tables["sample"].append({"token": f"p{scene}{sample}", "scene_token": f"t{scene}", "timestamp": start})
        moments = [(0, 0), (100, None), (200, None), (250, None), (350, None), (450, None), (500, 1), (600, None)]
        moments += [(850, None), (950, None)]  # two frames are lost before
        rows = [("LIDAR_TOP", milliseconds + 36, sample) for milliseconds, sample in moments]
        rows += [(camera, milliseconds, sample) for camera in calibrations for milliseconds, sample in moments]
        for channel, milliseconds, sample in reversed(rows):  # the tables are in no order
            stamp = start + 1000 * milliseconds
            folder = "sweeps" if sample is None else "samples"
            ending = "pcd.bin" if channel == "LIDAR_TOP" else "jpg"
            file = f"{folder}/{channel}/{scene}__{channel}__{stamp}.{ending}"
            token = f"{scene}{channel}{milliseconds}"
            size = (0, 0) if channel == "LIDAR_TOP" else (900, 1600)
            tables["sample_data"].append(
                {
                    "token": f"d{token}",
                    "sample_token": f"p{scene}{0 if milliseconds < 400 else 1}",
                    "ego_pose_token": f"e{token}",
                    "calibrated_sensor_token": f"c{scene}{channel}",
                    "timestamp": stamp,
                    "fileformat": ending.split(".")[0],
                    "is_key_frame": sample is not None,
                    "height": size[0],
                    "width": size[1],
                    "filename": file,
                    "prev": "",
                    "next": "",
                }
            )
            yaw = 0.3 + 0.2 * milliseconds / 1000
            translation = [411.3 + 5 * milliseconds / 1000, 1180.9, 0.0]
            rotation = wxyz(Rotation.from_euler("z", yaw).as_matrix())
            pose = {"token": f"e{token}", "timestamp": stamp, "rotation": rotation, "translation": translation}
            tables["ego_pose"].append(pose)
            path = root / file
            path.parent.mkdir(parents=True, exist_ok=True)
            if folder in missing:
                continue
            if channel == "LIDAR_TOP":
                NUSCENES_POINTS.tofile(path)
            else:
                picture(path, (90, 160), milliseconds % 250)
    for name, table in tables.items():
        write_json(root / version / f"{name}.json", table)
    return root
