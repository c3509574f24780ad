"""Where a trained model is: shipped with saunet, a local checkpoint or folder, or on the Hugging Face hub."""

from __future__ import annotations

import re
from pathlib import Path

from saunet.errors import CheckpointError, ConfigError

BOX = Path(__file__).parent
"""Each folder in it is a model that comes with saunet."""
DEFAULT = "street"
"""The shipped model that is used when no other is named."""
CONFIG, WEIGHTS, POSE, CARD = "config.json", "model.safetensors", "pose.safetensors", "README.md"
"""What a model's folder holds: record, weights (of the depth network alone where there is a ``POSE``), and card."""
HUB = "hf://"
_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+(@[\w./-]+)?")
_FILE_SUFFIXES = (".ckpt", ".onnx", ".safetensors", ".pt", ".pth", ".pt2")
_WANTED = [CONFIG, WEIGHTS, POSE, "model.onnx", CARD]
"""What is fetched from the hub: numbers and text, nothing that could be run."""


def shipped() -> list[str]:
    """Return the names of the models that come with saunet, sorted."""
    return sorted(path.parent.name for path in BOX.glob(f"*/{CONFIG}"))


def locate(source: str | Path) -> Path:
    """Return the local path of a model, fetched from the hub where ``source`` is a hub id.

    A text is the name of a shipped model such as ``street`` (``./street`` is a local folder of that name), a path, or a
    hub id: ``hf://organization/name``, or short ``organization/name``, with ``@revision`` for a certain one.
    """
    text, path = str(source), Path(source).expanduser()
    if isinstance(source, Path):
        return path
    if text.startswith(HUB):
        if not _HUB_ID.fullmatch(text[len(HUB) :]):
            raise ConfigError(
                f"'{text}' is not a hub id; give hf://organization/name or hf://organization/name@revision"
            )
        return _fetch(text[len(HUB) :])
    if text in shipped():
        return BOX / text
    if text == DEFAULT and not path.exists():
        raise CheckpointError(
            f"no model '{DEFAULT}' comes with this installation of saunet; give checkpoint= a model of your own"
        )
    local = path.exists() or path.parent.is_dir() or path.suffix.lower() in _FILE_SUFFIXES
    return path if local or not _HUB_ID.fullmatch(text) else _fetch(text)


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
        return Path(snapshot_download(repository, revision=revision or None, allow_patterns=_WANTED))
    except Exception as reason:  # the hub's errors, the network's and the HTTP client's share no base class
        first = next((line.strip() for line in str(reason).splitlines() if line.strip()), "")
        raise CheckpointError(
            f"cannot fetch '{name}' from the hub ({type(reason).__name__}: {first[:200]}); check the name and the "
            "connection; what was fetched once is used without one"
        ) from reason
