"""Several runs together: how a sweep's jobs ended, which config keys differ, and short names made from them."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from saunet.io.atomic import write_json
from saunet.runs.folder import FILE, alive_elsewhere, mark_lost, read, read_file, read_mapping
from saunet.runs.run import Run

PLAN = "sweep.json"
"""In a sweep's folder: the jobs that it was to have."""
RATIO = "α/β"
"""A column of its own where the weights of SAU-Net eq. (14) differ."""
_UNKNOWN = "overrides unknown"
_SLOTS = ("model/encoder", "model/decoder", "model/pose", "objective", "data", "loss")
_UNTOLD = ("output_dir", "callbacks", "logger", "resume", "name")
"""Keys of a config that say where a run writes and what it is called, not what it computes."""
_OFF = (None, "null", "false", "[]", "{}", "0.0", "0")
"""What a key that is not there may as well be."""


def settings(run: Run) -> dict[str, str]:
    """Return all that decides what a run computes, as text by dotted key; a chosen component is one key more."""
    found = {slot.replace("/", "."): run.component(slot) for slot in _SLOTS if run.component(slot)}
    _flatten("", run.config, found)
    return {key: value for key, value in found.items() if key.split(".")[0] not in _UNTOLD}


def differing(runs: Sequence[Run], *, by_overrides: bool = False) -> list[str]:
    """Return the keys whose values are not the same for all runs, in the order they are first met.

    Parameters of components of different names are left out: they say nothing beyond the names. ``by_overrides``
    compares what the command lines said; for the jobs of one sweep that is what was swept.
    """
    tables = [_typed(run) if by_overrides else settings(run) for run in runs]
    tables = [table for table in tables if table]  # a job without a record tells nothing about the others
    keys = dict.fromkeys(key for table in tables for key in table)
    # A key that an older version did not have counts as one that is switched off.
    given = {key: {None if table.get(key) in _OFF else table.get(key) for table in tables} for key in keys}
    different = [key for key in keys if len(given[key]) > 1]
    chosen = tuple(f"{slot.replace('/', '.')}." for slot in _SLOTS if slot.replace("/", ".") in different)
    return [key for key in different if not key.startswith(chosen)]


def values(run: Run, keys: Sequence[str]) -> list[str]:
    """Return a run's values of these keys; empty where it has none."""
    table = settings(run) | _typed(run)
    return [table.get(key, "") for key in keys]


def _typed(run: Run) -> dict[str, str]:
    """Return what a command line said, numbers as the settings show them: 0.0002 for 2e-4."""
    return {key: _number(text) for key, text in run.overrides.items()}


def _number(text: str) -> str:
    if not re.fullmatch(r"-?(0|[1-9]\d*)?(\.\d+)?([eE][-+]?\d+)?", text) or not re.search(r"\d", text):
        return text
    return json.dumps(float(text)).removesuffix(".0") if re.search(r"[.eE]", text) else text


def ratio(run: Run) -> float | None:
    """Return alpha/beta of eq. (14); None where the objective has no such weights or beta is 0."""
    objective = run.config.get("objective")
    alpha, beta = (objective.get(key) if isinstance(objective, Mapping) else None for key in ("alpha", "beta"))
    if not isinstance(alpha, int | float) or not isinstance(beta, int | float) or not beta:
        return None
    return alpha / beta


def sweeps_ratio(runs: Sequence[Run]) -> bool:
    """Return whether the runs differ in the ratio of eq. (14) and in nothing else that was swept."""
    keys = set(differing(runs, by_overrides=True))
    ratios = {round(value, 6) for value in map(ratio, runs) if value is not None}
    return bool(keys) and keys <= {"objective.alpha", "objective.beta"} and len(ratios) > 1


def typed_names(runs: Sequence[Run]) -> list[str]:
    """Return a name for every run by which whoever named its folder knows it: the folder; a sweep's job by settings."""
    several = sum(run.swept for run in runs) > 1  # a job alone has no other that it differs from
    jobs = [run for run in runs if run.swept and several]
    singles = [run for run in runs if not (run.swept and several)]
    ends = dict(zip([run.path for run in singles], _ends([run.path for run in singles]), strict=True))
    ends |= {run.path: "/".join(run.path.parts[-2:]) for run in singles if run.swept and ends[run.path].isdecimal()}
    settled = dict(zip([run.path for run in jobs], labels([jobs])[0], strict=True))
    return [settled[run.path] if run.path in settled else ends[run.path] if run.config else run.name for run in runs]


def _ends(paths: Sequence[Path]) -> list[str]:
    """Return as many of the last parts of each path as make it unlike all others."""
    found = []
    for path in paths:
        others = [other.parts for other in paths if other != path]
        count = next(
            count
            for count in range(1, len(path.parts) + 1)
            if count == len(path.parts) or all(parts[-count:] != path.parts[-count:] for parts in others)
        )
        found.append(str(Path(*path.parts[-count:])))
    return found


_LONGEST_LABEL = 32  # characters; a run whose settings need more is called by its folder


def labels(groups: Sequence[Sequence[Run]]) -> list[list[str]]:
    """Return a short name for every run, unlike all others, made of what sets it apart within its group."""
    named = [_labels(group) for group in groups]
    counts = Counter(name for names in named for name in names)
    alike = [
        run.path
        for group, names in zip(groups, named, strict=True)
        for run, name in zip(group, names, strict=True)
        if counts[name] > 1
    ]
    ends = dict(zip(alike, _ends(alike), strict=True))
    return [
        [name if counts[name] == 1 else f"{name} ({ends[run.path]})" for run, name in zip(group, names, strict=True)]
        for group, names in zip(groups, named, strict=True)
    ]


def _labels(runs: Sequence[Run]) -> list[str]:
    ratios = [ratio(run) for run in runs]
    if sweeps_ratio(runs) and None not in ratios:
        return [f"{RATIO} = {value:.4g}" for value in ratios]
    keys = differing(runs, by_overrides=all(run.swept for run in runs))
    named = [_label(run, keys) for run in runs]
    single = any(not run.swept for run in runs)
    if single and max(map(len, named), default=0) > _LONGEST_LABEL:
        return [run.called for run in runs]
    return named


def _label(run: Run, keys: Sequence[str]) -> str:
    if not run.config and not run.overrides:  # another system's predictions, or a checkpoint alone
        return run.name
    slots = ("model/encoder", "model/decoder")
    others = [key for key in keys if key.replace(".", "/") not in slots]
    parts = []
    if len(others) < len(keys):  # even if only one of the two differs, both are named
        parts.append(" + ".join(run.component(slot) or "?" for slot in slots))
    for key, value in zip(others[:3], values(run, others[:3]), strict=True):
        if value:
            named = key in ("loss", "objective", "data", "experiment", "model")
            parts.append(value if named else f"{key.replace('/', '.').rpartition('.')[2]} = {value}")
    return ", ".join(parts) or run.called


def _flatten(prefix: str, node: Any, found: dict[str, str]) -> None:
    for key, value in node.items():
        if str(key).startswith("_"):
            continue
        path = f"{prefix}{key}"
        if isinstance(value, Mapping):
            _flatten(f"{path}.", value, found)
        else:
            found[path] = _number(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))


def write_plan(folder: Path, jobs: Sequence[Sequence[str]]) -> None:
    """Write down the overrides of every job that a sweep is to have."""
    write_json(folder / PLAN, {"jobs": [list(job) for job in jobs]})


def read_plan(folder: Path) -> list[list[str]] | None:
    """Return what `write_plan` wrote; None where that cannot be told, as with sweepers that search."""
    jobs = read_mapping(folder / PLAN).get("jobs")
    return [list(map(str, job)) for job in jobs if isinstance(job, list)] if isinstance(jobs, list) else None


def summary(folder: Path, planned: Sequence[Sequence[str]] | None = None) -> tuple[str, bool]:
    """Say how the jobs of a sweep ended, one line for each that did not finish; jobs that vanished are marked failed.

    Of the jobs that were to run, where they are known, those that never started count too. Also returned is whether
    there were jobs and all of them finished.
    """

    def in_order(path: Path) -> tuple[int, str]:
        name = path.parent.name
        return (int(name) if name.isdecimal() else -1, str(path))

    jobs = [path.parent for path in sorted(folder.glob(f"**/{FILE}"), key=in_order)]
    lines, finished = [], 0
    for job in jobs:
        if not alive_elsewhere(job):
            mark_lost(job)
        content = read(job)
        if content.get("status") == "finished":
            finished += 1
        else:
            reason = content.get("error") or "its record cannot be read"
            lines.append(f"  {job.relative_to(folder)} ({_overrides(job)}) {content.get('status', 'failed')}: {reason}")
    started = [_overrides(job) for job in jobs]
    all_jobs = [", ".join(job) for job in planned or []]
    waiting = [each for each in all_jobs if each not in started] if _UNKNOWN not in started else []
    lines += [f"  ({each}) not started" for each in waiting]
    count = len(jobs) + len(waiting)
    head = f"sweep: {finished} of {count} jobs finished; results: {folder}"
    return "\n".join([head, *lines]), 0 < finished == count


def _overrides(job: Path) -> str:
    given = read_file(job / ".hydra" / "overrides.yaml")
    return ", ".join(map(str, given)) if isinstance(given, list) else _UNKNOWN
