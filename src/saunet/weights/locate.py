"""Locating a trained model: shipped with saunet, a local checkpoint or folder, or on the Hugging Face hub."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from saunet.errors import CheckpointError, ConfigError, suggest

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


def is_shipped(path: Path) -> bool:
    """Return whether a path is the folder of a model that comes with saunet."""
    return path.parent == BOX


def locate(source: str | Path) -> Path:
    """Return the local path of a model, fetched from the hub where ``source`` is a hub id.

    A text is the name of a shipped model such as ``street`` (``./street`` is a local folder of that name), a path, or a
    hub id: ``hf://organization/name``, or short ``organization/name``, with ``@revision`` for a certain one. A
    training's folder means its ``best.ckpt``.
    """
    text, path = str(source), Path(source).expanduser()
    if isinstance(source, Path):
        return of_run(path)
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
            f"no model '{DEFAULT}' comes with this installation of saunet; set checkpoint= to your own model"
        )
    hint = suggest(text, shipped()) if path.name == text and not path.exists() else ""
    if hint and path.suffix.lower() not in _FILE_SUFFIXES:
        raise CheckpointError(f"no model '{text}'{hint} saunet comes with: {', '.join(shipped())}")
    local = path.exists() or path.parent.is_dir() or path.suffix.lower() in _FILE_SUFFIXES
    return of_run(path) if local or not _HUB_ID.fullmatch(text) else _fetch(text)


def of_run(path: Path, names: Sequence[str] = ("best", "last")) -> Path:
    """Return the checkpoint that a training's folder stands for, the first there is; other paths as they are."""
    files = (path / "checkpoints" / f"{name}.ckpt" for name in names)
    return next((file for file in files if file.is_file()), path)


def run_of(checkpoint: Path) -> Path | None:
    """Return the folder of the run that a checkpoint is in; None for a file that is nowhere below ``checkpoints``."""
    return checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else None


def check_push(name: str) -> None:
    """Check a hub id to upload to, and that there is a package which can."""
    if not _HUB_ID.fullmatch(name) or "@" in name:
        raise ConfigError(f"push is '{name}'; give a hub repository as organization/name")
    if find_spec("huggingface_hub") is None:
        raise ConfigError("push needs huggingface_hub; run: pip install 'saunet[hub]'")


def push(folder: Path, name: str) -> str:
    """Upload a model's files, and no others of its folder, to a repository; return its address.

    A repository that is new is private.
    """
    from huggingface_hub import HfApi

    try:
        api = HfApi()
        address = api.create_repo(name, private=True, exist_ok=True)
        api.upload_folder(repo_id=name, folder_path=folder, allow_patterns=_WANTED, commit_message="Upload by saunet")
    except Exception as reason:  # as in `_fetch`
        raise CheckpointError(
            f"{folder} is complete but could not be uploaded to '{name}' ({_first_line(reason)}); check the "
            f"connection, and that `hf auth login` has your token, then run: hf upload {name} {folder}"
        ) from reason
    return str(address)


def _first_line(reason: Exception) -> str:
    first = next((line.strip() for line in str(reason).splitlines() if line.strip()), "")
    return f"{type(reason).__name__}: {first[:200]}"


def _fetch(name: str) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError as missing:
        raise ConfigError(
            f"there is no file '{name}', and downloading it from the hub needs huggingface_hub; check the path, or "
            "run: pip install 'saunet[hub]'"
        ) from missing
    repository, _, revision = name.partition("@")
    try:
        return Path(snapshot_download(repository, revision=revision or None, allow_patterns=_WANTED))
    except Exception as reason:  # the hub's errors, the network's and the HTTP client's share no base class
        raise CheckpointError(
            f"cannot download '{name}' from the hub ({_first_line(reason)}); check the name and the connection "
            "(earlier downloads need none)"
        ) from reason
