"""Where a training starts from: nowhere, the weights of another model, or the middle of itself."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger, Logger
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor, nn

from saunet.errors import CheckpointError, ConfigError
from saunet.runs.checkpoint import load_weights, read_checkpoint
from saunet.training.module import SelfSupervisedDepth
from saunet.weights.files import read_model


def resume_path(resume: str | None, output_dir: str | Path, init_from: str | None = None) -> str | None:
    """Return the checkpoint to go on from, or None.

    Args:
        resume: A path; ``auto`` for ``checkpoints/last.ckpt`` in the run's own folder, if there is one; or None.
        output_dir: The run's folder.
        init_from: What the config gives for a warm start, which cannot be combined with a path.

    Raises:
        ConfigError: if both are given.
    """
    if resume == "auto":
        last = Path(output_dir) / "checkpoints" / "last.ckpt"
        return str(last.resolve()) if last.is_file() else None
    if resume and init_from:
        raise ConfigError(
            "resume= and init_from= are both set; resume= goes on with a training, init_from= starts a new one from "
            "its weights: leave one out"
        )
    return str(Path(resume).expanduser().resolve()) if resume else None


def check_unused(output_dir: str | Path) -> None:
    """Check that a new training would not replace what an earlier one left.

    Args:
        output_dir: The run's folder.

    Raises:
        ConfigError: if it holds checkpoints.
    """
    found = sorted((Path(output_dir) / "checkpoints").glob("*.ckpt"))
    if found:
        raise ConfigError(
            f"{output_dir} holds {found[0].name} of an earlier run; go on with it by resume=auto, choose another "
            "folder, or replace it with overwrite=true"
        )


def check_resume(model: SelfSupervisedDepth, path: str) -> int:
    """Check that a training can go on from a checkpoint, before the trainer finds out in its own words.

    Returns:
        The steps done by then.

    Raises:
        CheckpointError: if the file cannot be read or belongs to another model or other data.
    """
    checkpoint = read_checkpoint(path)
    checkpoint.record.check_same_training(model.record)
    load_weights(model.depth, checkpoint.weights("depth"), "depth network")
    if model.pose is not None:
        load_weights(model.pose, checkpoint.weights("pose"), "pose network")
    return checkpoint.global_step or 0


@rank_zero_only
def keep_rows(logger: Logger, steps: int) -> None:
    """Keep what a resumed run logged as CSV before; Lightning's logger would begin the file afresh.

    Args:
        logger: A logger of the resumed run; nothing is done for one that writes no CSV.
        steps: The steps done by the checkpoint; later rows are dropped, as they will be logged again.
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
    whole = (row for row in rows if row.get("step", "").isdecimal())  # a kill can cut the last one
    writer.metrics.extend(row for row in whole if int(row["step"]) < steps)
    writer.save()


def warm_start(model: SelfSupervisedDepth, source: str | Path) -> str:
    """Give a new training the weights of a trained model, as many as fit by name and shape.

    Args:
        model: The training.
        source: Any saunet model: a checkpoint, an exported folder, or the name of a shipped model such as ``street``.

    Returns:
        What was taken and what was not, in one sentence.

    Raises:
        CheckpointError: if the model cannot be read, or nothing of its depth network fits.
    """
    checkpoint = read_model(source)
    parts: list[tuple[str, nn.Module | None]] = [("depth", model.depth), ("pose", model.pose)]
    taken = []
    for name, network in parts:
        given = checkpoint.weights(name)
        if network is None:
            if given:
                taken.append(f"not the {name} network, which this training does not have")
            continue
        own = network.state_dict()
        fitting = {key: given[key] for key in own if key in given and given[key].shape == own[key].shape}
        if name == "depth" and not fitting:
            raise CheckpointError(
                f"nothing of {source} fits the depth network (it has '{next(iter(given), 'no weights')}' where the "
                f"model has '{next(iter(own))}'); choose the same model/encoder and model/decoder"
            )
        network.load_state_dict(fitting, strict=False)
        taken.append(_taken(name, own, given, fitting))
    theirs, ours = checkpoint.record.to_plain()["model"], model.record.get("model", {})
    for end in ("min_depth", "max_depth"):
        if ours.get(end, theirs[end]) != theirs[end]:
            taken.append(f"its {end} is {theirs[end]:g} and here {ours[end]:g}, so the same weights give other depths")
    return f"starting from {source}: {'; '.join(taken)}"


def _taken(name: str, own: Mapping[str, Tensor], given: Mapping[str, Tensor], fitting: Collection[str]) -> str:
    """Say how much of a network was taken, and of the rest the first tensor."""
    if len(fitting) == len(own) == len(given):
        return f"all {len(own)} tensors of the {name} network"
    rest = [key for key in own if key not in fitting]
    text = f"{len(fitting)} of {len(own)} tensors of the {name} network"
    if rest:
        why = "another shape" if rest[0] in given else "not in it"
        text += f" (left as they were: {rest[0]}, {why}{f', and {len(rest) - 1} more' if len(rest) > 1 else ''})"
    unused = [key for key in given if key not in own]
    if unused:
        text += f" (unused: {unused[0]}{f', and {len(unused) - 1} more' if len(unused) > 1 else ''})"
    return text
