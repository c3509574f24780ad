"""Prediction from one exported ONNX file, with onnxruntime alone: without torch, a program starts quickly."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from saunet.errors import CheckpointError, ConfigError
from saunet.io.plain import parse_json
from saunet.prediction.prediction import ImagePredictor
from saunet.runs.record import ModelRecord

INPUT, OUTPUT = "image", "disparity"
METADATA = "saunet"
"""Name of the model record in the file's metadata."""


class OnnxPredictor(ImagePredictor):
    """Predicts depth with an exported network; the counterpart of `saunet.prediction.Predictor`.

    Args:
        path: A ``model.onnx`` written by `saunet.exporting.export`.
        device: ``"cpu"`` or ``"cuda"`` (with onnxruntime-gpu).
        threads: Threads to use; 0 lets onnxruntime choose.
        flip: Average with the prediction of the mirrored image (twice the time, slightly less error).

    Raises:
        CheckpointError: if the file is missing, broken, or not an exported saunet model.
        ConfigError: if onnxruntime is missing or does not support the device.
    """

    def __init__(self, path: str | Path, device: str = "cpu", threads: int = 0, flip: bool = False) -> None:
        self.path = Path(path)
        self._session = open_session(self.path, device, threads)
        plain = self._session.get_modelmeta().custom_metadata_map.get(METADATA)
        if plain is None:
            raise CheckpointError(
                f"{path} is an ONNX model, but not one that saunet exported: it has no model record; describe it "
                "with foreign.preset=... or foreign.output=... (docs/deploy.md)"
            )
        try:
            self.record = ModelRecord.from_plain(parse_json(plain, "the model record"))
        except ValueError as reason:
            raise CheckpointError(f"{path}: the model record inside cannot be read ({reason})") from reason
        super().__init__(self.record.height, self.record.width, self.record.scale)
        batch = self._session.get_inputs()[0].shape[0]
        self._batch: int | None = batch if isinstance(batch, int) else None
        self.flip = flip

    def disparity(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b h w"]:
        """Run the network: RGB in [0, 1] to disparity at the same size, before any scale."""
        if not self.flip:
            return self._run(images)
        return flip_blend(self._run(images), self._run(np.ascontiguousarray(images[..., ::-1])))

    def _run(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b h w"]:
        size = self._batch or max(1, len(images))
        parts = []
        for start in range(0, len(images), size):
            part = images[start : start + size]
            padded = np.concatenate([part, np.repeat(part[-1:], size - len(part), axis=0)])
            parts.append(self._session.run([OUTPUT], {INPUT: padded})[0][: len(part), 0])
        return np.asarray(np.concatenate(parts))

    @functools.cached_property
    def fingerprint(self) -> str:
        """A short hash of the file and of the settings that change results."""
        return hashlib.sha256(self.path.read_bytes() + (b"flip" if self.flip else b"")).hexdigest()[:16]


def flip_blend(
    disparity: Float32[np.ndarray, "b h w"], disparity_of_flipped: Float32[np.ndarray, "b h w"]
) -> Float32[np.ndarray, "b h w"]:
    """Blend as `saunet.metrics.functional.flip_blend` does, without torch."""
    other = disparity_of_flipped[..., ::-1]
    left = 1 - np.clip(20 * (np.linspace(0, 1, disparity.shape[-1]) - 0.05), 0, 1)
    right = left[::-1]
    mean = (disparity + other) / 2
    return np.asarray(right * disparity + left * other + (1 - left - right) * mean, dtype=np.float32)


def open_session(path: Path, device: str = "cpu", threads: int = 0, spinning: bool = True) -> Any:
    """Open an ONNX file with onnxruntime."""
    try:
        import onnxruntime
    except ImportError as missing:
        raise ConfigError("prediction from ONNX needs onnxruntime; run: pip install 'saunet[export]'") from missing
    wanted = f"{device.split(':')[0].upper()}ExecutionProvider"
    if wanted not in onnxruntime.get_available_providers():
        known = [name.removesuffix("ExecutionProvider").lower() for name in onnxruntime.get_available_providers()]
        raise ConfigError(f"device '{device}' is not supported by this onnxruntime; available: {', '.join(known)}")
    if not path.is_file():
        raise CheckpointError(f"no ONNX model at {path}; check the path")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    if not spinning:
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=[wanted])
    except Exception as reason:  # onnxruntime's errors share no base class but Exception
        raise CheckpointError(f"{path} is damaged, or not an ONNX model that onnxruntime can read") from reason
