"""The runtime of the network: torch, or on a CPU another installed one that is faster and gives the same depth."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32

from saunet.errors import CheckpointError, ConfigError, one_of
from saunet.exporting import exporters
from saunet.exporting.openvino import export_openvino, has_bf16, run_openvino
from saunet.exporting.parity import Run, milliseconds, random_images
from saunet.io.atomic import replacing
from saunet.metrics.functional import flip_blend
from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.predictor import Predictor
from saunet.prediction.tool import RUNTIMES
from saunet.weights.files import read_model


class Change(NamedTuple):
    """Change of depth relative to torch's."""

    mean: float
    """Mean over an image: Abs Rel."""
    largest: float
    """Largest at any pixel."""

    def within(self, limit: Change) -> bool:
        """Return whether neither exceeds the other's; NaN does."""
        return self.mean <= limit.mean and self.largest <= limit.largest

    def __str__(self) -> str:
        return f"{self.mean:.1g} (Abs Rel), at most {self.largest:.1g} at a pixel"


LIMITS = {"f32": Change(1e-4, 1e-2), "bf16": Change(2e-3, 0.1)}
"""Largest allowed change for a runtime, by precision."""
ASKED = Change(5e-2, math.inf)
"""The same if bfloat16 is requested: it moves edges by a pixel, so single pixels say nothing."""
_BF16 = "-bf16"
"""Ending of the names of runtimes that compute in bfloat16."""
WORTH_FRAMES = 200
"""Fewest frames worth a conversion, which takes about as long as this many frames."""
_PACKAGES = {"openvino": ("openvino",), "onnx": ("onnxruntime", "onnx", "onnxscript")}
_EXTRAS = {"openvino": "openvino", "onnx": "export"}


class ConvertedPredictor(Predictor):
    """A predictor that runs its network in another runtime, and compares it with torch once more on the first images.

    Args:
        predictor: The original.
        run: The converted network: one image to its disparity.
        limit: Largest allowed change of depth.
    """

    def __init__(self, predictor: Predictor, run: Run, limit: Change) -> None:
        about = (predictor.device, predictor.scale, predictor.flip, predictor.keep_aspect)
        super().__init__(predictor.network, predictor.height, predictor.width, *about)
        self.source, self.undistort = predictor.source, predictor.undistort
        self.undistorted_by = predictor.undistorted_by
        self._converted, self._limit, self._compared = run, limit, False

    def disparity(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b h w"]:
        """Run the network: RGB in [0, 1] to disparity at the same size, before any scale."""
        if not self._compared:
            self._compared, change = True, depth_change(exporters.run_eager(self.network), self._converted, images[:1])
            if not change.within(self._limit):
                raise CheckpointError(
                    f"in this runtime, depth of the first image changes by {change}, but only {self._limit} is "
                    "allowed; set runtime=torch"
                )
        found = self._each(images)
        if self.flip:
            turned = self._each(np.ascontiguousarray(images[..., ::-1]))
            found = flip_blend(torch.from_numpy(found), torch.from_numpy(turned)).numpy()
        return found[:, 0]

    def _each(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b 1 h w"]:
        return np.concatenate([self._converted(image[None]) for image in images])


def depth_change(eager: Run, converted: Run, image: Float32[np.ndarray, "1 3 h w"]) -> Change:
    """Return the relative change of an image's depth."""
    apart = np.abs(eager(image) / converted(image) - 1)
    return Change(float(apart.mean()), float(apart.max()))


def choose_runtime(
    predictor: ImagePredictor, checkpoint: str | Path, runtime: str = "auto", frames: float | int = math.inf
) -> ImagePredictor:
    """Return a predictor in a runtime, and print one line if it is not torch.

    A network is converted once and kept in torch's cache folder. It is used if depth changes by at most `LIMITS`.

    Args:
        predictor: A loaded model.
        checkpoint: Where it came from.
        runtime: ``torch``, ``openvino``, ``onnx``; ``openvino-bf16``, which may change depth by as much as `ASKED`; or
            ``auto``, the first installed one that is faster than torch, if ``frames`` are worth a conversion or one
            exists already.
        frames: Largest number of frames that will be predicted.

    Raises:
        ConfigError: if the requested runtime is missing, does not fit, or changes depth too much.
    """
    one_of("runtime", runtime, RUNTIMES)
    if runtime == "torch":
        return predictor
    auto, wrong = runtime == "auto", _why_not(predictor)
    if wrong or not isinstance(predictor, Predictor):
        if auto:
            return predictor
        raise ConfigError(f"runtime={runtime} {wrong}; leave runtime out")
    plain = runtime.removesuffix(_BF16)
    found = [name for name in (_PACKAGES if auto else [plain]) if all(map(importlib.util.find_spec, _PACKAGES[name]))]
    if not found:
        if auto:
            return predictor
        raise ConfigError(f"runtime={runtime} is not installed; run: pip install 'saunet[{_EXTRAS[plain]}]'")
    name = found[0]
    path = _cached(predictor, name)
    if auto and frames < WORTH_FRAMES and not path.is_file():
        return predictor
    try:
        precision, run = _open(name, path, predictor, checkpoint)
    except (ConfigError, CheckpointError) as reason:
        if auto:
            print(f"runtime: torch ({name} cannot be used: {reason})")
            return predictor
        raise
    if plain != runtime and precision != "bf16":
        raise ConfigError(
            f"runtime={runtime} needs a processor with bfloat16, which this one does not have; set runtime={plain}"
        )
    images, limit, hint = random_images(predictor.height, predictor.width), LIMITS[precision], ""
    if plain != runtime:
        limit = ASKED
    eager = exporters.run_eager(predictor.network)
    change = _largest_change(eager, run, images)
    if not change.within(limit) and precision != "f32" and plain == runtime:
        hint = f"; bf16 would change it by {change.mean:.1g} (runtime={name}{_BF16})"
        precision, limit, run = "f32", LIMITS["f32"], run_openvino(path, path.with_suffix(".bin"))
        change = _largest_change(eager, run, images)
    if not change.within(limit):
        found_it = f"{name} changes depth by {change}, but only {limit} is allowed"
        if not auto:
            raise ConfigError(f"{found_it}; set runtime=torch")
        print(f"runtime: torch ({found_it})")
        return predictor
    before, after = milliseconds([eager, run], images[0], repeats=3)
    about = f"{name} {precision}, {after / before:.2f} of torch's time, depth changes by {change}{hint}"
    if auto and after >= before:
        print(f"runtime: torch ({about})")
        return predictor
    print(f"runtime: {about}")
    return ConvertedPredictor(predictor, run, limit)


def _largest_change(eager: Run, converted: Run, images: Sequence[Float32[np.ndarray, "1 3 h w"]]) -> Change:
    """Return the largest `depth_change` of several images; NaN if one of them is not finite."""
    means, largest = np.max([depth_change(eager, converted, image) for image in images], axis=0)
    return Change(float(means), float(largest))


def _why_not(predictor: ImagePredictor) -> str:
    """Return why a model cannot run in another runtime; empty if it can."""
    if type(predictor) is not Predictor:
        return "is for checkpoints and safetensors"
    if predictor.device.type != "cpu":
        return f"is for the CPU, not for device={predictor.device.type}"
    return "takes images of one size, which cannot be combined with keep_aspect" if predictor.keep_aspect else ""


def _cached(predictor: Predictor, name: str) -> Path:
    """Return the path of a conversion of exactly these weights at this size by these versions."""
    versions = [f"{package} {version(package)}" for package in ("torch", *_PACKAGES[name])]
    text = repr((predictor.weights_hash, predictor.height, predictor.width, versions))
    key = hashlib.sha256(text.encode()).hexdigest()[:24]
    return Path(torch.hub.get_dir()) / "saunet" / f"{key}{'.xml' if name == 'openvino' else '.onnx'}"


def _open(name: str, path: Path, predictor: Predictor, checkpoint: str | Path) -> tuple[str, Run]:
    """Return a converted network and its precision; convert it if there is no readable conversion yet."""
    precision = "bf16" if name == "openvino" and has_bf16() else "f32"
    openers: dict[str, Callable[[], Run]] = {
        "openvino": lambda: run_openvino(path, path.with_suffix(".bin"), precision),
        "onnx": lambda: exporters.run_onnx(path),
    }
    if path.is_file():
        with contextlib.suppress(CheckpointError):  # damaged: convert again
            return precision, openers[name]()
    print(f"converting the network for {name}, once")
    record = replace(read_model(checkpoint).record, height=predictor.height, width=predictor.width)
    path.parent.mkdir(parents=True, exist_ok=True)
    if name == "onnx":
        with replacing(path) as temporary:
            exporters.export_onnx(predictor.network, record, temporary, batch="one")
    else:  # the weights first: the graph marks the conversion as complete
        with replacing(path) as temporary, replacing(path.with_suffix(".bin")) as weights:
            export_openvino(predictor.network, record, temporary, weights, batch="one")
    return precision, openers[name]()
