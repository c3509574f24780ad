"""Where a training starts: from scratch, from another model's weights, or from its own checkpoint."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightning.pytorch.loggers import CSVLogger, Logger
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor, nn

from saunet.errors import CheckpointError, ConfigError
from saunet.registry import Spec
from saunet.runs.checkpoint import Checkpoint, load_weights
from saunet.training.optim import OTHER_SETTINGS, Recipe
from saunet.weights.files import read_model
from saunet.weights.locate import run_of

if TYPE_CHECKING:
    from saunet.training.module import SelfSupervisedDepth

BOUND = {"seed": "seed", "batch_size": "data.batch_size", "train_split": "training frames (SHA-256 of their names)"}
"""The settings that decide the order of the data, with their names in messages."""


def resume_path(resume: str | None, output_dir: str | Path) -> str | None:
    """Return the checkpoint to resume from, or None; ``auto`` is the ``last.ckpt`` of the run's own folder, if any."""
    if resume == "auto":
        last = Path(output_dir) / "checkpoints" / "last.ckpt"
        return str(last.resolve()) if last.is_file() else None
    if resume in ("true", "True"):
        raise ConfigError("resume is 'true'; set resume=auto for the run's own last.ckpt, or give a checkpoint")
    return str(Path(resume).expanduser().resolve()) if resume else None


def check_unused(output_dir: str | Path) -> None:
    """Check that a new training would not replace the checkpoints of an earlier one."""
    found = sorted((Path(output_dir) / "checkpoints").glob("*.ckpt"))
    if found:
        raise ConfigError(
            f"{output_dir} holds {found[0].name} of an earlier run; continue it with resume=auto, choose another "
            "folder, or replace it with overwrite=true"
        )


def check_resume(model: SelfSupervisedDepth, checkpoint: Checkpoint, data: Any) -> int:
    """Check that a training can be resumed, before the trainer fails with its own message; return the steps done."""
    missing = _missing(checkpoint)
    if missing:
        raise CheckpointError(
            f"{checkpoint.path} has no {missing}, so the training cannot be resumed where it stopped; give the "
            f"last.ckpt of a run, or start a new training from its weights with init_from={checkpoint.path}"
        )
    checkpoint.record.check_same_training(model.record)
    before, now = (getattr(each.intrinsics, "mode", "fixed") for each in (checkpoint.record, model))
    if before != now:
        raise CheckpointError(
            f"the checkpoint was trained with model.intrinsics={before} but this run has {now}; give the same, or "
            f"start a new training from its weights with init_from={checkpoint.path}"
        )
    load_weights(model.depth, checkpoint.weights("depth"), "depth network")
    if model.pose is not None:
        load_weights(model.pose, checkpoint.weights("pose"), "pose network")
    continuation(checkpoint.rest, model, data)
    return checkpoint.global_step or 0


def _missing(checkpoint: Checkpoint) -> str | None:
    rest = checkpoint.rest
    if not isinstance(rest.get("loops"), Mapping) or not rest["loops"] or checkpoint.global_step is None:
        return "loop state (it holds weights only)"
    states = rest.get("optimizer_states")
    if not isinstance(states, list) or not states or not all(isinstance(each, Mapping) for each in states):
        return "optimizer state (it holds weights only)"
    if checkpoint.global_step > 0 and not all(each.get("state") for each in states):
        return "optimizer state (it is empty)"
    return None if rest.get("lr_schedulers") else "state of the learning-rate schedule"


def continuation(checkpoint: Mapping[str, Any], model: SelfSupervisedDepth, data: Any) -> list[str]:
    """Check that a resumed training sees the same samples in the same order; report what it changes."""
    training, now = checkpoint.get("saunet_training", {}), model.training_state(data)["settings"]
    before = training.get("settings", {})
    for key, name in BOUND.items():
        if key in before and key in now and before[key] != now[key]:
            was, is_ = (str(each)[:16] for each in (before[key], now[key]))
            raise CheckpointError(
                f"the checkpoint was trained with {name} {was} but this run has {is_}, so it cannot be resumed where "
                "it stopped; give the same settings, or start a new training from its weights with init_from= "
                "instead of resume="
            )
    old = {"objective": before.get("objective", {}), "model": checkpoint.get("saunet", {}).get("model", {})}
    new = {"objective": now.get("objective", {}), "model": model.record.get("model", {})}
    said = (model.recipe.resumed_from(training.get("recipe", {})), changes(old, new))
    return [sentence for sentence in said if sentence]


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """Return a sentence about the networks' and objective's settings that a resumed training changes; None if none."""
    found = [each for name in now if name in before for each in _differences(before[name], now[name], name)]
    return f"the resumed run uses the new {', '.join(found)}; {OTHER_SETTINGS}" if found else None


def _differences(before: Any, now: Any, name: str) -> Iterator[str]:
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        if not before or not now:  # not known
            return
        kinds = [str(each.get("_target_")).rpartition(".")[2] for each in (before, now)]
        if kinds[0] != kinds[1]:
            yield f"{name} {kinds[1]} (it was {kinds[0]})"
            return
        for key in now:
            if key in before and key != "weights":  # their starting weights no longer matter
                yield from _differences(before[key], now[key], f"{name}.{key}")
    else:
        was, is_ = (list(each) if isinstance(each, tuple) else each for each in (before, now))
        if was != is_:
            yield f"{name} {now} (it was {before})"


def stretched(checkpoint: Mapping[str, Any], recipe: Recipe, total: int, source: str | Path | None) -> str | None:
    """Say at what learning rate a resumed training continues whose end has moved; None if it has not.

    Args:
        checkpoint: What it resumes from.
        recipe: Its recipe.
        total: Steps of the whole training by now.
        source: File of the checkpoint.
    """
    before, step = checkpoint.get("saunet_training", {}).get("steps"), int(checkpoint["global_step"])
    if before in (None, total) or step >= total or recipe.schedule == "constant":
        return None
    state = checkpoint["lr_schedulers"][0]
    factor = recipe.factor_at(state["last_epoch"], total)
    rate = f"{state['base_lrs'][0] * factor:.3g}, {100 * factor:.3g}% of the highest"
    said = (
        f"the training now ends after step {total} (before: {before}), and its {recipe.schedule} schedule is fitted to "
        f"that: it continues at a learning rate of {rate}"
    )
    if factor >= 0.1 or step < recipe.warmup * total:
        return said
    file = Path(source or "RUN")
    run = run_of(file) or file
    return (
        f"{said}; so little is learned with it that a new run with init_from={run} and a schedule of its own is better"
    )


def validation_due(checkpoint: Mapping[str, Any]) -> bool:
    """Return whether a checkpoint was saved before a validation that followed its last step."""
    return bool(checkpoint.get("saunet_training", {}).get("validation_due"))


def owe_validation(loops: dict[str, Any]) -> None:
    """Change the recorded state of Lightning's loops to that of a run stopped during its validation.

    Lightning saves after a step as if no validation followed, and would resume with the next step.
    """
    step, validation = loops["epoch_loop.batch_progress"], loops["epoch_loop.val_loop.batch_progress"]
    for counts in (step["total"], step["current"]):
        counts["completed"] = counts["processed"]
    nothing = dict.fromkeys(validation["total"], 0)
    validation |= {"total": {**nothing, "ready": 1, "started": 1}, "current": nothing, "is_last_batch": False}


@rank_zero_only
def keep_rows(logger: Logger, checkpoint: Mapping[str, Any]) -> None:
    """Keep the CSV log of a resumed run; Lightning's logger would start a new file.

    Rows after the checkpoint's last step are dropped, because they will be logged again; so is the validation after it
    if that is still due. The last step's own row is added if the run was killed before logging it.
    """
    if not isinstance(logger, CSVLogger):
        return
    path = Path(logger.log_dir) / "metrics.csv"
    if not path.is_file():
        return
    with path.open(newline="") as file:
        rows = [{key: value for key, value in row.items() if value} for row in csv.DictReader(file)]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*will be deleted when the new ones are saved.*")
        writer = logger.experiment
    steps, due = int(checkpoint["global_step"]), validation_due(checkpoint)
    whole = (row for row in rows if row.get("step", "").isdecimal())  # a kill can truncate the last one
    kept = [row for row in whole if int(row["step"]) < steps]
    last = [row for row in kept if int(row["step"]) == steps - 1]
    again = [row for row in last if due and any(key[:4] == "val/" for key in row)]
    writer.metrics.extend(row for row in kept if row not in again)
    unlogged = checkpoint.get("saunet_training", {}).get("unlogged", {})
    if unlogged.get("step") == steps - 1 and not any("train/loss" in row for row in last):
        writer.metrics.append({key: str(value) for key, value in unlogged.items()})
    writer.save()


def warm_start(model: SelfSupervisedDepth, source: str | Path) -> str:
    """Start a new training from the weights of any saunet model that `saunet.load` reads, as far as name and shape fit.

    Returns:
        One sentence about which weights were used and which were not.
    """
    checkpoint = read_model(source)
    parts: list[tuple[str, nn.Module | None]] = [("depth", model.depth), ("pose", model.pose)]
    taken = []
    for name, network in parts:
        given = checkpoint.weights(name)
        if network is None:
            if given:
                taken.append(f"its {name} network is not used, as this training has none")
            continue
        own = network.state_dict()
        fitting = {key: given[key] for key in own if key in given and given[key].shape == own[key].shape}
        if name == "depth" and not fitting:
            raise CheckpointError(
                f"no weights in {source} fit the depth network (it has '{next(iter(given), 'no weights')}' where the "
                f"model has '{next(iter(own))}'); choose the same model/encoder and model/decoder"
            )
        network.load_state_dict(fitting, strict=False)
        lacks = f"it has no {name} network{' that fits' if given else ''}"
        nothing = f"{lacks}, so this training's {name} network starts from fresh weights"
        taken.append(_taken(name, own, given, fitting) if fitting else nothing)
    theirs, ours = checkpoint.record.to_plain()["model"], model.record.get("model", {})
    for end in ("min_depth", "max_depth"):
        if ours.get(end, theirs[end]) != theirs[end]:
            taken.append(
                f"its {end} is {theirs[end]:g} but {ours[end]:g} here, so the same weights give different depths"
            )
    for part in ("encoder", "decoder"):
        taken += [
            f"its {part} has {key} {was} but {now} here, so the same weights give different depths"
            for key, was, now in _other_behavior(theirs[part], ours.get(part, theirs[part]))
        ]
    return f"starting from {source}: {'; '.join(taken)}"


def _other_behavior(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield settings of the same component that change what its weights compute but not their shapes."""
    if theirs["_target_"] == ours["_target_"]:
        for key, parameter in Spec(ours).parameters.items():
            was, now = (node.get(key, parameter.default) for node in (theirs, ours))
            if key in ("normalization", "upsampling", "rates", "last_rates") and list(was) != list(now):
                yield key, was, now


def _taken(name: str, own: Mapping[str, Tensor], given: Mapping[str, Tensor], fitting: Mapping[str, Tensor]) -> str:
    """Describe how much of a network was used, and name the first tensor of the rest."""
    if len(fitting) == len(own) == len(given):
        return f"all {len(own)} tensors of the {name} network"

    def first(names: list[str], why: str = "") -> str:
        return f"{names[0]}{why}{f', and {len(names) - 1} more' if len(names) > 1 else ''}"

    text = f"{len(fitting)} of {len(own)} tensors of the {name} network"
    rest, unused = ([key for key in some if key not in others] for some, others in ((own, fitting), (given, own)))
    if rest:
        text += f" (left unchanged: {first(rest, ', of another shape' if rest[0] in given else ', not in it')})"
    return f"{text} (unused: {first(unused)})" if unused else text
