"""What a resumed training must share with the one that its checkpoint comes from, and what may change but is said."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from saunet.errors import CheckpointError

BOUND = {
    "seed": "seed",
    "batch_size": "data.batch_size",
    "train_split": "training frames (SHA-256 of their names)",
}
"""What decides the order of the data, with its name in a message."""


def settings(seed: int, datamodule: Any, objective: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what a checkpoint keeps of a training beside its recipe and its networks.

    Args:
        seed: The training's seed.
        datamodule: Its data; what is not known of them is left out.
        objective: Config node of its objective, if known.
    """
    kept: dict[str, Any] = {"seed": seed}
    if objective:
        kept["objective"] = dict(objective)
    batch_size, datasets = getattr(datamodule, "batch_size", None), getattr(datamodule, "datasets", {})
    if batch_size is not None:
        kept["batch_size"] = batch_size
    if "train" in datasets:
        kept["train_split"] = datasets["train"].fingerprint()
    return kept


def check_continues(before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that a resumed training sees the same samples in the same order.

    Args:
        before: The `settings` in the checkpoint; an older version's lacks some or all.
        now: Those of the resumed training.

    Raises:
        CheckpointError: naming the first that differs.
    """
    for key, name in BOUND.items():
        if key in before and key in now and before[key] != now[key]:
            was, is_ = (str(each)[:16] for each in (before[key], now[key]))
            raise CheckpointError(
                f"the checkpoint was trained with {name} {was} and this run has {is_}, so it cannot go on where it "
                "was; give the same settings, or start a new training from its weights with init_from= instead of "
                "resume="
            )


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """Say in one sentence which settings of networks and objective a resumed training changes; None for no change.

    Args:
        before: Config nodes by name (``objective``, ``model``) in the checkpoint.
        now: Those of the resumed training.
    """
    found = [each for name in now if name in before for each in _differences(before[name], now[name], name)]
    if not found:
        return None
    return (
        f"the resumed run goes on with the new {', '.join(found)}; "
        "to train on with other settings, start from its weights with init_from= instead of resume="
    )


def _differences(before: Any, now: Any, name: str) -> Iterator[str]:
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        if not before or not now:  # not known
            return
        kinds = [str(each.get("_target_")).rpartition(".")[2] for each in (before, now)]
        if kinds[0] != kinds[1]:
            yield f"{name} {kinds[1]} (it was {kinds[0]})"
            return
        for key in now:
            if key in before and key != "weights":  # what the networks started from is behind them
                yield from _differences(before[key], now[key], f"{name}.{key}")
    elif _plain(before) != _plain(now):
        yield f"{name} {now} (it was {before})"


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
