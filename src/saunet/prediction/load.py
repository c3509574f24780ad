"""One way to any trained model: a checkpoint, an exported folder or file, or a model on the Hugging Face hub."""

from __future__ import annotations

import re
from pathlib import Path

from saunet.errors import CheckpointError, ConfigError
from saunet.prediction.pipeline import ImagePredictor

HUB = "hf://"
_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+(@[\w./-]+)?")
_FILE_SUFFIXES = (".ckpt", ".onnx", ".safetensors", ".pt", ".pth", ".pt2")
_WANTED = ("config.json", "model.safetensors", "model.onnx", "README.md")
"""What is fetched from the hub: numbers and text, nothing that could be run."""


def load(source: str | Path, *, device: str = "cpu", flip: bool = False, keep_aspect: bool = False) -> ImagePredictor:
    """Load a trained model for prediction; nothing in the file is run.

    Args:
        source: A checkpoint, a folder written by ``saunet-export``, a ``model.onnx`` (run by onnxruntime; torch is not
            even imported), or a hub id: ``hf://organization/name``, or short ``organization/name``, with ``@revision``
            where a certain one is meant.
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


def locate(source: str | Path) -> Path:
    """Return the local path of a model, fetched from the hub where ``source`` is a hub id.

    Raises:
        CheckpointError: if it cannot be fetched.
        ConfigError: if the package huggingface_hub is missing, or the id is not one.
    """
    text = str(source)
    if text.startswith(HUB):
        if not _HUB_ID.fullmatch(text[len(HUB) :]):
            raise ConfigError(
                f"'{text}' is not a hub id; give hf://organization/name or hf://organization/name@revision"
            )
        return _fetch(text[len(HUB) :])
    path = Path(source)
    local = path.exists() or path.parent.is_dir() or path.suffix.lower() in _FILE_SUFFIXES
    if isinstance(source, Path) or local or not _HUB_ID.fullmatch(text):
        return path
    return _fetch(text)


def _fetch(name: str) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError as missing:
        raise ConfigError(
            f"there is no file '{name}', and fetching it from the hub needs huggingface_hub; "
            "check the path, or run: pip install 'saunet[hub]'"
        ) from missing
    repository, _, revision = name.partition("@")
    try:
        return Path(snapshot_download(repository, revision=revision or None, allow_patterns=list(_WANTED)))
    except Exception as reason:  # the hub's errors, the network's and the HTTP client's share no base class
        first = next((line.strip() for line in str(reason).splitlines() if line.strip()), "")
        raise CheckpointError(
            f"cannot fetch '{name}' from the hub ({type(reason).__name__}: {first[:200]}); check the name and the "
            "connection; what was fetched once is used without one"
        ) from reason
