"""Depth models of other systems, as ONNX or TorchScript files, with their inputs and outputs described by name."""

from __future__ import annotations

import functools
import hashlib
import warnings
import zipfile
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float32

from saunet.errors import CheckpointError, ConfigError, checked, one_of, positive
from saunet.prediction.prediction import ImagePredictor
from saunet.runs.record import Scale

Meaning = Literal["depth", "log_depth", "disparity", "affine_disparity"]
MEANINGS: tuple[str, ...] = get_args(Meaning)
"""Meters; their natural logarithm; 1/depth up to a factor; the same up to a factor and a shift."""
SCRIPT_SUFFIXES = (".ts", ".torchscript", ".jit", ".pt", ".pth")
_SMALLEST = 1e-3
"""Smallest affine disparity, as a fraction of an image's largest, because its shift is unknown."""


@checked
@dataclass(frozen=True, kw_only=True)
class ForeignOptions:
    """Input and output of another system's depth model, an ONNX or TorchScript file.

    Args:
        preset: Settings of a known family of models, one of `PRESETS`; the other options override them.
        output: Meaning of the model's numbers: ``depth`` in meters, ``log_depth`` (natural logarithm), ``disparity`` up
            to a factor, or ``affine_disparity``, up to a factor and a shift.
        mean: Subtracted from RGB in [0, 1], per channel.
        std: Divisor after that, per channel.
        height: Height of the model's input; by default the file's.
        width: Width of the model's input; by default the file's.
        multiple: The sides of the input must be multiples of this.
        factor: First multiplies the numbers; ``affine_disparity`` then counts as disparity in 1/m.
        shift: Then added to ``affine_disparity``, 1/m.
        run_code: Allow running a TorchScript file, which is a program; only if you trust its source.

    Raises:
        ConfigError: if a value is out of range or a choice is unknown.

    Examples:
        >>> saunet.ForeignOptions(preset="midas", height=256, width=512).output is None
        True
    """

    preset: str | None = None
    output: Meaning | None = None
    mean: tuple[float, ...] | None = None
    std: tuple[float, ...] | None = None
    height: int | None = None
    width: int | None = None
    multiple: int | None = None
    factor: float | None = None
    shift: float | None = None
    run_code: bool = False

    def __post_init__(self) -> None:
        if self.preset is not None:
            one_of("foreign.preset", self.preset, PRESETS)
        if self.output is not None:
            one_of("foreign.output", self.output, MEANINGS)
        for name in ("mean", "std"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, tuple(map(float, values)))
                if len(values) != 3 or (name == "std" and not all(value > 0 for value in values)):
                    raise ConfigError(f"foreign.{name} is {list(values)}; give three numbers for R, G and B")
        for name in ("height", "width", "multiple", "factor"):
            if getattr(self, name) is not None:
                positive(f"foreign.{name}", getattr(self, name))
        if (self.height is None) != (self.width is None):
            raise ConfigError("foreign.height and foreign.width belong together; set both or neither")
        if self.shift is not None and self.factor is None:
            raise ConfigError("foreign.shift is added after foreign.factor; set both")

    @property
    def given(self) -> bool:
        """Whether any option about a model of another system is set."""
        return self != NOTHING

    def _settled(self, path: Path) -> ForeignOptions:
        """Return the options with those of the preset filled in."""
        known = PRESETS.get(self.preset or "", NOTHING)
        own = {each.name: getattr(self, each.name) for each in fields(self) if getattr(self, each.name) is not None}
        found = replace(known, **own)
        if found.output is None:
            raise ConfigError(
                f"{path} is a model of another system; say what it is with foreign.preset={'|'.join(PRESETS)}, or "
                f"what it returns with foreign.output={'|'.join(MEANINGS)} (and foreign.mean, foreign.std)"
            )
        return found


NOTHING = ForeignOptions()
"""For models that saunet knows."""
_IMAGENET: dict[str, Any] = {"mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)}
_HALF: dict[str, Any] = {"mean": (0.5, 0.5, 0.5), "std": (0.5, 0.5, 0.5)}
PRESETS: dict[str, ForeignOptions] = {}
PRESETS |= {
    "depth_anything": ForeignOptions(output="affine_disparity", height=518, width=518, multiple=14, **_IMAGENET),
    "depth_anything_metric": ForeignOptions(output="depth", height=518, width=518, multiple=14, **_IMAGENET),
    "dpt": ForeignOptions(output="affine_disparity", height=384, width=384, multiple=32, **_HALF),
    "midas": ForeignOptions(output="affine_disparity", height=384, width=384, multiple=32, **_IMAGENET),
    "midas_small": ForeignOptions(output="affine_disparity", height=256, width=256, multiple=32, **_IMAGENET),
    "ultralytics_depth": ForeignOptions(output="depth", height=640, width=640, multiple=32),
}
"""Families of models by name: Depth Anything 1 and 2 (relative, and fine-tuned to meters), MiDaS 3 (DPT) and 2.1, and
Ultralytics' ``*-depth``, as their owners' scripts export them."""


def is_foreign(path: Path) -> bool:
    """Return whether a file is a TorchScript program; an ONNX file itself records whether it is ours."""
    suffix = path.suffix.lower()
    if suffix not in SCRIPT_SUFFIXES or not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any("/code/" in name for name in archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return suffix in SCRIPT_SUFFIXES[:3]


class ForeignPredictor(ImagePredictor):
    """Predicts depth with a model of another system.

    Args:
        path: An ONNX or TorchScript file that takes images, b x 3 x h x w, and returns b x h x w or b x 1 x h x w.
        options: Its input and output.
        device: ``"cpu"`` or ``"cuda"``.
        flip: Average with the prediction of the mirrored image.
        keep_aspect: Keep each image's aspect ratio, if the file allows any size.

    Raises:
        CheckpointError: if the file is missing or broken.
        ConfigError: if options are missing, it is a program that is not allowed to run, or sizes do not fit.
    """

    def __init__(
        self, path: Path, options: ForeignOptions, device: str = "cpu", flip: bool = False, keep_aspect: bool = False
    ) -> None:
        self.path, self.options, self.flip = path, options._settled(path), flip
        if path.suffix.lower() == ".onnx":
            self._run, fixed = _onnx(path, device)
        else:
            if not options.run_code:
                raise ConfigError(
                    f"{path} is TorchScript, a program that could do anything on this machine; set "
                    "foreign.run_code=true if you trust its source, or use ONNX"
                )
            self._run, fixed = _script(path, device), None
        asked = (options.height, options.width)
        if fixed is not None and None not in asked and asked != fixed:
            raise ConfigError(
                f"{path} takes images of {fixed[0]}x{fixed[1]} (height x width) only, but foreign.height and "
                f"foreign.width are {asked[0]}x{asked[1]}; leave them out"
            )
        if fixed is not None and keep_aspect:
            raise ConfigError(f"{path} takes one size of images; leave keep_aspect out")
        height, width = fixed or (self.options.height, self.options.width)
        if height is None or width is None:
            raise ConfigError(f"{path} takes images of any size; set foreign.height and foreign.width")
        multiple = 1 if fixed else self.options.multiple or 1
        own = self.options.output in ("depth", "log_depth") or self.options.factor is not None
        scale = Scale(1.0, "the model itself") if own else None
        super().__init__(height, width, scale, keep_aspect, multiple)

    @property
    def shifted(self) -> bool:
        """Whether the disparity has an unknown shift, which a factor alone cannot align."""
        return self.options.output == "affine_disparity" and self.options.factor is None

    @property
    def unit(self) -> str:
        if self.shifted:
            return (
                "relative, and disparity also has an unknown shift, so shapes are distorted (set foreign.factor and "
                "foreign.shift)"
            )
        return super().unit

    def disparity(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b h w"]:
        """Run the model: RGB in [0, 1] to disparity above 0."""
        found = self.raw_disparity(images)
        if self.shifted:
            found = np.maximum(found, _SMALLEST * np.abs(found).max(axis=(1, 2), keepdims=True))
        return np.asarray(np.maximum(found, np.float32(1e-9)), np.float32)

    def raw_disparity(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b _ _"]:
        """Run the model: RGB in [0, 1] to disparity, which may be 0 or negative if its zero is arbitrary."""
        if not self.flip:
            return self._disparity(images)
        from saunet.exporting.onnx import flip_blend

        return flip_blend(self._disparity(images), self._disparity(np.ascontiguousarray(images[..., ::-1])))

    def _disparity(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b _ _"]:
        mean, std = (
            np.asarray(values or neutral, np.float32)[:, None, None]
            for values, neutral in ((self.options.mean, (0, 0, 0)), (self.options.std, (1, 1, 1)))
        )
        values = np.asarray(self._run((images - mean) / std), dtype=np.float32)
        if values.ndim == 4 and values.shape[1] == 1:
            values = values[:, 0]
        if values.ndim != 3 or len(values) != len(images):
            raise CheckpointError(
                f"{self.path} returns shape {values.shape} for {len(images)} images; a depth model returns "
                f"({len(images)}, height, width) or ({len(images)}, 1, height, width)"
            )
        factor, meaning = np.float32(self.options.factor or 1.0), self.options.output
        if meaning == "affine_disparity":
            return values * factor + np.float32(self.options.shift or 0.0)
        if meaning == "disparity":
            return values * factor
        with np.errstate(divide="ignore"):  # depth 0 is refused as not finite
            return 1 / (values * factor) if meaning == "depth" else np.exp(-values) / factor

    @functools.cached_property
    def fingerprint(self) -> str:
        """A short hash of the file and of all settings that change results."""
        settings = repr((sorted(asdict(self.options).items()), self.flip, self.keep_aspect)).encode()
        return hashlib.sha256(self.path.read_bytes() + settings).hexdigest()[:16]


def _onnx(path: Path, device: str) -> tuple[Any, tuple[int, int] | None]:
    """Return a function that runs an ONNX file, and its input's (height, width) if fixed."""
    from saunet.exporting.onnx import open_session

    session = open_session(path, device)
    given, output = session.get_inputs(), session.get_outputs()[0].name
    if len(given) != 1 or len(given[0].shape) != 4 or given[0].shape[1] != 3:
        shapes = ", ".join(f"{each.name} {each.shape}" for each in given)
        raise CheckpointError(f"{path} takes {shapes}; a depth model takes one input, images x 3 x height x width")
    kinds = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
    kind = kinds[one_of("type of the model's input", given[0].type, kinds)]
    batch, _, *size = given[0].shape

    def run(images: np.ndarray) -> np.ndarray:
        parts, step = [], batch if isinstance(batch, int) else len(images)
        for start in range(0, len(images), step):
            part = images[start : start + step]
            padded = np.concatenate([part, np.repeat(part[-1:], step - len(part), axis=0)])
            parts.append(session.run([output], {given[0].name: padded.astype(kind)})[0][: len(part)])
        return np.concatenate(parts)

    fixed = all(isinstance(side, int) for side in size)
    return run, (size[0], size[1]) if fixed else None


def _script(path: Path, device: str) -> Any:
    """Return a function that runs a TorchScript program."""
    import torch

    if not path.is_file():
        raise CheckpointError(f"no model at {path}; check the path")
    try:
        with warnings.catch_warnings():  # torch recommends torch.export, but the file exists already
            warnings.simplefilter("ignore", DeprecationWarning)
            read: Any = torch.jit.load
            program = read(str(path), map_location=device).eval()
    except RuntimeError as reason:
        raise CheckpointError(f"{path} is damaged, or not a TorchScript file that torch can read") from reason

    def run(images: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            found = program(torch.from_numpy(images).to(device))
        while isinstance(found, tuple | list | dict):
            found = next(iter(found.values() if isinstance(found, dict) else found))
        array: np.ndarray = found.float().cpu().numpy()
        return array

    return run
