"""Feed wrong values to everything public, one argument at a time; print what came out that should not.

It runs in a process of its own, because under pytest all annotations are enforced by other means.
"""

from __future__ import annotations

import functools
import inspect
import json
import re
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import saunet

BINDING = re.compile(
    r"missing \d+ required|unexpected keyword|invalid keyword|takes (no|\d+ positional) argument"
    r"|Can't instantiate abstract class"
)
"""What Python itself says of a call."""
LONG = "long/" + "x" * 5000
ZOO: dict[str, Any] = {
    "None": None,
    "bf16": torch.rand(1, 1, 4, 6).bfloat16(),
    "shape": torch.rand(2, 5),
    "empty": torch.rand(0, 1, 4, 6),
    "integers": torch.ones(1, 1, 4, 6, dtype=torch.long),
    "array": np.ones((2, 3)),
    "number": 3,
    "negative": -1,
    "huge": 10**400,
    "nan": float("nan"),
    "text": "nonsense",
    "no text": "",
    "long path": LONG,
    "zero byte": "a\0b",
    "missing": Path("/nowhere/at/all"),
    "bytes": b"x",
    "list": [],
    "words": ["nonsense"],
    "nested": [[None]],
    "mapping": {"nonsense": 1},
    "object": object(),
    "function": lambda: None,
    "type": int,
}


def image(channels: int = 1) -> torch.Tensor:
    return torch.rand(1, channels, 8, 12) + 0.1


def network() -> saunet.DepthNet:
    decoder = functools.partial(saunet.build, "decoder", "aunet")
    return saunet.DepthNet(saunet.build("encoder", "stratified_nano"), decoder)


K, T = torch.eye(3)[None], torch.eye(4)[None]
PATHS = {"checkpoint": "/nowhere/x.ckpt", "output": "/nowhere/out"}
FLAT = np.ones((4, 6), np.float32)
MODEL = {
    "encoder": saunet.Spec.of("encoder", "stratified_nano"),
    "decoder": saunet.Spec.of("decoder", "aunet"),
    "pose": saunet.Spec.of("pose", "posecnn"),
}
GOOD: dict[str, dict[str, Any]] = {
    "app": {"options": None},
    "automask": {"error": image(), "identity": image()},
    "available": {"kind": "encoder"},
    "backproject": {"depth": image(), "K": K},
    "benchmark": {"options": None},
    "build": {"kind": "encoder", "name": "stratified_nano"},
    "calibrate": {"options": None},
    "combine_sources": {"errors": torch.rand(1, 2, 1, 8, 12)},
    "crop_intrinsics": {"K": K, "left": 1, "top": 1},
    "disparity_to_depth": {"disparity": image()},
    "doctor": {"options": None},
    "evaluate": {"options": None},
    "export": {"options": None},
    "flip_intrinsics": {"K": K, "width": 12},
    "gradient_loss": {"prediction": image(), "target": image()},
    "inspect": {"data": "/nowhere/clips", "frames": 1},
    "invert_pose": {"T": T},
    "load": {"source": "street"},
    "odometry": {"options": None},
    "photometric_error": {"prediction": image(3), "target": image(3)},
    "pose_matrix": {"axisangle": torch.rand(1, 3), "translation": torch.rand(1, 3)},
    "predict": {"options": None},
    "prepare": {"options": None},
    "project": {"points": image(3), "K": K, "T": T},
    "report": {"options": None},
    "scale_intrinsics": {"K": K, "scale_x": 0.5, "scale_y": 0.5},
    "sigmoid_to_disparity": {"sigmoid": image().clamp(0.1, 0.9), "min_depth": 0.1, "max_depth": 100.0},
    "smoothness_loss": {"disparity": image(), "image": image(3)},
    "ssim_loss": {"prediction": image(3), "target": image(3)},
    "synthesize": {
        "sources": torch.rand(1, 2, 3, 8, 12),
        "depth": image(),
        "K": K,
        "T_src_tgt": T[:, None].repeat(1, 2, 1, 1),
    },
    "train": {"options": None},
    "watch": {"options": None},
    "AppOptions": {},
    "BenchmarkOptions": {},
    "CalibrateOptions": {},
    "DepthDataModule": {},
    "DepthMetrics": {},
    "DepthNet": {"encoder": network().encoder, "decoder": functools.partial(saunet.build, "decoder", "aunet")},
    "DoctorOptions": {},
    "Drive": {},
    "EvaluateOptions": {},
    "ExportOptions": PATHS,
    "ForeignOptions": {},
    "ModelOptions": MODEL,
    "OdometryOptions": {},
    "PredictOptions": {**PATHS, "input": "/nowhere/images"},
    "Prediction": {"depth": FLAT, "disparity": FLAT, "image": np.zeros((4, 6, 3), np.uint8)},
    "Predictor": {"depth_net": network(), "height": 64, "width": 96},
    "PrepareOptions": {"job": "densify", "root": "/nowhere"},
    "ReportOptions": {},
    "Run": {"path": "/nowhere/run"},
    "Spec": {"node": {"_target_": "x"}},
    "TrainOptions": {},
    "WatchOptions": {"run": "/nowhere/run"},
}
"""Arguments that can work (but for ``options``, which are only given wrong)."""
MORE = {
    "build": ("weights", "drop_path", "depths", "window"),
    "DepthDataModule": ("height", "width", "offsets", "batch_size", "workers"),
}
"""Further arguments by keyword."""


def cases(name: str, target: Callable[..., Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    given = GOOD[name]
    parameters = [
        p for p in inspect.signature(target).parameters.values() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
    ]
    wanted = [p.name for p in parameters] + list(MORE.get(name, ()))
    wanted = ["options"] if "options" in given else wanted
    for key in wanted:
        for kind, value in ZOO.items():
            yield f"{key}={kind}", {**given, key: value}
    yield "nothing", {}
    yield "a wrong keyword", {**given, "nonsense": 1}


def call(target: Callable[..., Any], given: dict[str, Any]) -> None:
    ahead = [p.name for p in inspect.signature(target).parameters.values() if p.kind is p.POSITIONAL_ONLY]
    target(*(given[key] for key in ahead if key in given), **{k: v for k, v in given.items() if k not in ahead})


def strange(name: str) -> list[str]:
    """Return what a name let out that is no error of saunet's, and what took long."""
    target, found = getattr(saunet, name), []
    for case, given in cases(name, target):
        begin, said = time.monotonic(), ""
        try:
            call(target, given)
        except saunet.SaunetError as error:
            if "\n" in str(error) or len(str(error)) > 6000:
                said = f"says {len(str(error))} characters: {str(error)[:200]}"
        except BaseException as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            if not (isinstance(error, TypeError) and BINDING.search(str(error))):
                said = f"{type(error).__name__}: {str(error)[:200]} ({Path(last.filename).name}:{last.lineno})"
        if time.monotonic() - begin > 20:
            said += " after many seconds"
        if said:
            found.append(f"{name}({case}): {said}")
    return found


def public() -> list[str]:
    made = {name: getattr(saunet, name) for name in saunet.__all__}
    errors = [name for name, value in made.items() if inspect.isclass(value) and issubclass(value, Exception)]
    return [name for name, value in made.items() if callable(value) and name not in errors]


if __name__ == "__main__":
    print(json.dumps({name: strange(name) for name in public()}))
