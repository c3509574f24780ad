"""One way to any trained model: shipped with saunet, a checkpoint, an exported folder or file, or on the hub."""

from __future__ import annotations

from pathlib import Path

from saunet.errors import CheckpointError, ConfigError
from saunet.prediction.prediction import ImagePredictor
from saunet.weights.locate import locate


def load(source: str | Path, *, device: str = "cpu", flip: bool = False, keep_aspect: bool = False) -> ImagePredictor:
    """Load a trained model for prediction; nothing in the file is run.

    Args:
        source: A checkpoint, a folder written by ``saunet export``, a ``model.onnx`` (run by onnxruntime; torch is not
            even imported), the name of a shipped model such as ``street``, or a hub id: ``hf://organization/name``, or
            short ``organization/name``, with ``@revision`` where a certain one is meant.
        device: Where to run, such as ``"cpu"`` or ``"cuda"``.
        flip: Average with the prediction of the mirrored image (twice the time, a little less error).
        keep_aspect: Feed each image at its own aspect ratio; an ONNX file has one fixed size and cannot.

    Raises:
        CheckpointError: if it is missing, broken, cannot be fetched, or is not a saunet model.
        ConfigError: if a package is missing or the device does not exist.
    """
    path = locate(source)
    if path.is_dir() and (path / "model.onnx").is_file() and not (path / "model.safetensors").is_file():
        path = path / "model.onnx"
    if path.suffix.lower() == ".onnx":
        from saunet.exporting.onnx import OnnxPredictor

        if keep_aspect:
            raise ConfigError(
                f"{path} is ONNX and takes one size of images; leave keep_aspect out or load a checkpoint"
            )
        return OnnxPredictor(path, device=device, flip=flip)
    if path.suffix.lower() == ".pt2":
        raise CheckpointError(f"{path} runs with torch alone; load the folder, its model.onnx or model.safetensors")
    from saunet.prediction.predictor import Predictor

    return Predictor.from_checkpoint(path, device, flip, keep_aspect)
