"""Where a measured factor to meters is kept: in a checkpoint, or in the ``config.json`` of an exported folder."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from saunet.errors import CheckpointError, ConfigError
from saunet.io.atomic import write_bytes, write_json
from saunet.io.plain import read_json
from saunet.runs.checkpoint import read_checkpoint
from saunet.runs.checkpoint import store_scale as store_in_checkpoint
from saunet.runs.record import Scale, scale_sentence, unit_of
from saunet.weights.files import read_config
from saunet.weights.locate import CARD, CONFIG, WEIGHTS, is_shipped, locate, of_run

_PROGRAMS = (".onnx", ".xml", ".pt2", ".ts", ".torchscript", ".jit")
"""Suffixes of files that run a network: what they say about themselves is fixed when they are made."""


def can_keep(checkpoint: str | Path) -> bool:
    """Say whether a model is the user's own and of a kind that keeps a factor."""
    path = locate(checkpoint)
    return path.suffix == ".ckpt" or ((path / WEIGHTS).is_file() and not is_shipped(path))


def scale_file(checkpoint: str | Path) -> Path:
    """Return the file that will keep a model's factor: its checkpoint, or its folder's ``config.json``.

    Raises:
        ConfigError: if the model belongs to saunet or to the hub, or its folder holds files that would not follow.
        CheckpointError: if it is no model that can keep a factor.
    """
    path, named = locate(checkpoint), Path(checkpoint).expanduser()
    if is_shipped(path) or path not in (named, of_run(named)):
        whose, own = ("with saunet", f"my{path.name}") if is_shipped(path) else ("from the hub", "mymodel")
        raise ConfigError(
            f"scale.store=true writes into the model, and '{checkpoint}' comes {whose} and stays as it is; make a copy "
            f"of your own with `saunet export {checkpoint} output={own} formats=[safetensors]`, then measure with "
            f"`scale.store=true checkpoint={own}`"
        )
    folder = path if path.is_dir() else path.parent
    if path.suffix.lower() == ".safetensors" or (path.is_dir() and (folder / WEIGHTS).is_file()):
        read_config(folder / CONFIG)
        others = sorted(file.name for file in folder.iterdir() if file.suffix.lower() in _PROGRAMS)
        if others:
            raise ConfigError(
                f"scale.store=true would change the depth of {folder / WEIGHTS} and not that of {others[0]} beside it; "
                "store the factor in the checkpoint and export that again, or make a copy with `saunet export "
                f"{folder} output={folder}_metric formats=[safetensors]` and store it there"
            )
        return folder / CONFIG
    if path.suffix.lower() in _PROGRAMS or (path.is_dir() and (path / CONFIG).is_file()):
        raise CheckpointError(
            f"scale.store=true writes into a checkpoint, or into a folder exported with formats=[safetensors], and "
            f"{path} is neither; store the factor in the model that it was exported from, then export that again"
        )
    try:
        read_checkpoint(path)
    except CheckpointError as reason:
        raise CheckpointError(
            f"scale.store=true writes into a checkpoint of saunet's, and {reason}; leave scale.store out, or train on "
            "from it with init_from= first"
        ) from reason
    return path


def store_scale(path: Path, scale: Scale) -> None:
    """Write a measured factor into what `scale_file` returned; everything else in the file stays as it is.

    The card beside a ``config.json`` says the unit of depth too, and is changed where it still reads as exported.
    """
    if path.name != CONFIG:
        store_in_checkpoint(path, scale)
        return
    before, card = read_config(path).scale, path.with_name(CARD)
    write_json(path, {**read_json(path), "scale": asdict(scale)})
    if card.is_file():
        text = card.read_text(encoding="utf-8")
        for told in (lambda known: f"| unit of depth | {unit_of(known)} |", scale_sentence):
            text = text.replace(told(before), told(scale))
        write_bytes(card, text.encode())
