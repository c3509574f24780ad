"""Views of a run or a sweep: its table, its curves, and one page with everything, during the run and after."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from saunet import __version__
from saunet.errors import DataError, checked, require_matplotlib
from saunet.io.display import display
from saunet.io.images import natural_order
from saunet.reporting.figures import draw_curves, draw_results
from saunet.reporting.inputs import collect
from saunet.reporting.page import Document, Figure, Missing, Picture, Section, as_html
from saunet.reporting.tables import last_mean, runs_table
from saunet.runs.folder import read_mapping
from saunet.runs.run import Run as FolderRun
from saunet.runs.sweep import labels
from saunet.tables import Column, Row, Table, columns
from saunet.tables.drawing import Drawing, save

RESULTS = "results.png"
_CURVES = (
    ("train/loss", "training loss"),
    ("val/loss", "validation loss"),
    ("val/abs_rel", "Abs Rel, validation"),
    ("val/a1", "δ < 1.25, validation"),
)
_HEALTH = {
    "disparity_spread": "spread of disparity, 0 when depth has collapsed",
    "holes": "fraction of pixels in holes of depth",
    "automask": "fraction of pixels used by the loss",
    "translation": "motion between frames, relative units",
    "rotation": "rotation between frames, radians",
}


@checked
class Run(FolderRun):
    """A training's folder in its current state, during or after the run; a notebook shows its table and curves.

    Missing parts are empty. `history` has the rows of its log, `checkpoint` its best checkpoint, `config` its settings.

    Args:
        path: The folder with ``run.json``.

    Raises:
        DataError: if there is no training.

    Examples:
        >>> run = saunet.Run("outputs/train/2026-01-31_12-00-00")  # doctest: +SKIP
        >>> run.status, run.history[-1]["train/loss"]  # doctest: +SKIP
        ('running', 0.113)
        >>> saunet.Run("nowhere")
        Traceback (most recent call last):
        saunet.errors.DataError: there is nothing at nowhere...
    """

    def __init__(self, path: str | Path) -> None:
        runs = collect([path]).all_runs
        if len(runs) != 1:
            raise DataError(f"{path} holds {len(runs)} runs; name one of them, such as {runs[0].path}")
        super().__init__(**{each.name: getattr(runs[0], each.name) for each in fields(FolderRun)})

    @property
    def table(self) -> Table:
        """Its progress and scores."""
        return runs_table("run", f"{self.name}: {self.path}", {self.name: self}, swept=False)

    def plot(self) -> Drawing:
        """Draw the curves of losses and errors.

        Returns:
            The drawing; a notebook shows it, and `Drawing.save` writes it.

        Raises:
            ConfigError: if matplotlib is missing.
            DataError: if nothing has been logged yet.
        """
        require_matplotlib("a plot needs", "nothing, and use .table")
        drawn = draw_curves({self.name: self}, _CURVES)
        if drawn is None:
            raise DataError(f"{self.path} has logged nothing yet")
        return Drawing(drawn)

    def page(self) -> Document:
        """Return one page with everything about it, as in ``saunet watch``."""
        return page_of(self.path)

    def show(self) -> None:
        """Show table and curves in the notebook; outside a notebook open the page in the browser."""
        display(self, lambda: as_html(self.page()))

    def __repr__(self) -> str:
        steps = max((int(row["step"]) + 1 for row in self.history if "step" in row), default=0)
        loss = last_mean(self, "train/loss")
        return f"Run({self.path}: {self.status}, {steps} steps{'' if loss is None else f', loss {loss:.4g}'})"

    def _repr_html_(self) -> str:
        drawn = draw_curves({self.name: self}, _CURVES) if find_spec("matplotlib") else None
        return self.table._repr_html_() + (drawn or b"").decode()


def write_results(folder: Path) -> Path | None:
    """Draw curves, health and the last picture of a training into ``results.png``; None if it logged nothing.

    Raises:
        ConfigError: if matplotlib is missing.
        DataError: if the file cannot be written.
    """
    require_matplotlib("results.png needs", "nothing, and look with saunet watch")
    run = Run(folder)
    figure = draw_results(run, (_CURVES, _health_panels()), _last_picture(run))
    if figure is None:
        return None
    save(figure, folder / RESULTS)
    return folder / RESULTS


def page_of(path: str | Path) -> Document:
    """Return the page of a run, a sweep, or a folder with several of them."""
    inputs = collect([path])
    draw, missing, sections = find_spec("matplotlib") is not None, list[Missing](), list[Section]()
    if not draw:
        missing.append(Missing("Curves", "no matplotlib: run `pip install 'saunet[plot]'`"))
    several = len(inputs.all_runs) > 1
    groups = {f"sweep {sweep.name}": sweep.runs for sweep in inputs.sweeps}
    groups |= {"runs": inputs.runs} if inputs.runs else {}
    for number, (title, members) in enumerate(groups.items()):
        named = _named(members)
        sections.append(_overview(f"group_{number}", title, named, swept=title != "runs", draw=draw))
    for run in () if several else inputs.all_runs:
        found = (_pictures(run), _health(run, draw), _data(run))
        sections += [section for section in found if section.blocks]
        missing += [Missing(section.title, section.intro) for section in found if not section.blocks]
    running = sum(run.status == "running" for run in inputs.all_runs)
    states = f"{len(inputs.all_runs)} runs, {running} running" if several else inputs.all_runs[0].status
    facts = (states, str(path), f"as of {datetime.now(timezone.utc):%Y-%m-%d %H:%M:%S} UTC", f"saunet {__version__}")
    title = Path(path).resolve().name if several else inputs.all_runs[0].called
    return Document(title, facts, tuple(sections), tuple(missing))


def _named(runs: tuple[FolderRun, ...]) -> dict[str, FolderRun]:
    return dict(zip(labels([runs])[0], runs, strict=True))


def _overview(name: str, title: str, runs: Mapping[str, FolderRun], *, swept: bool, draw: bool) -> Section:
    """Return the progress of runs, and their curves."""
    ended = sum(run.status not in ("running", "unfinished") for run in runs.values())
    heading = f"{ended} of {len(runs)} jobs have ended" if swept else "Current state"
    blocks: list[Table | Figure] = [runs_table(name, heading, runs, swept=swept)]
    drawn = draw_curves(runs, _CURVES) if draw else None
    if drawn:
        caption = "Losses with different weights cannot be compared."
        blocks.append(Figure("Curves", Picture(f"{name}.svg", drawn, "losses and errors"), caption))
    return Section(title[0].upper() + title[1:] if len(runs) > 1 else "Progress", tuple(blocks))


def _last_picture(run: FolderRun) -> Path | None:
    found = sorted((run.path / "pictures").glob("*.png"), key=natural_order)
    return found[-1] if found else None


def _health_panels() -> list[tuple[str, str]]:
    return [(f"health/{name}", what.split(",")[0]) for name, what in list(_HEALTH.items())[:3]]


def _pictures(run: FolderRun) -> Section:
    """Return the last picture of the validation, with a description above each tile."""
    file, blocks = _last_picture(run), []
    if file is not None:
        epoch = int("".join(filter(str.isdigit, file.stem)) or 0) + 1
        alt = "validation images with disparity, warped neighbor, photometric error and mask"
        caption = (
            "Input, disparity, the neighbor warped into it, their difference (bright), the pixels that the mask keeps."
        )
        blocks.append(Figure(f"Epoch {epoch}", Picture(file.name, file.read_bytes(), alt), caption))
    return Section("Last pictures", tuple(blocks), "" if blocks else "they are drawn after each validation")


def _health(run: FolderRun, draw: bool) -> Section:
    """Return the health figures of a training, and the warnings about them."""
    said: Mapping[str, Any] = run.record.get("health") or {}
    latest = {key: value for row in run.history for key, value in row.items() if key.startswith("health/")}
    rows = [
        Row((what, latest.get(f"health/{name}")), "failed" if name in said else "plain", note=str(said.get(name, "")))
        for name, what in _HEALTH.items()
        if f"health/{name}" in latest
    ]
    rows += [Row((name, None), "failed", note=str(text)) for name, text in said.items() if name not in _HEALTH]
    if not rows:
        return Section("Health", (), "nothing was logged yet")
    verdict = f"Noticed: {', '.join(said)}" if said else "Nothing unusual was seen"
    blocks: list[Table | Figure] = [Table("health", verdict, columns("Measure", "Latest value|.4g"), tuple(rows))]
    if draw and (drawn := draw_curves({run.name: run}, _health_panels())):
        picture = Picture("health.svg", drawn, "health measures")
        blocks.append(Figure("Health measures", picture, "They change early if a training goes wrong."))
    return Section("Health", tuple(blocks))


def _data(run: FolderRun) -> Section:
    """Return which frames are used, and the findings of `saunet doctor` if its manifest is used."""
    blocks = []
    if used := run.record.get("samples"):
        rows = tuple(Row((split, line.strip())) for split, text in used.items() for line in str(text).splitlines())
        blocks.append(Table("samples", "Frames used", (Column("Split"), Column("Frames")), rows))
    data = run.config.get("data")
    manifest = data.get("manifest") if isinstance(data, Mapping) else None
    findings = read_mapping(Path(str(manifest))).get("findings") if manifest else None
    if isinstance(findings, list):
        told = [each for each in findings if isinstance(each, Mapping)]
        cells = tuple(Row(tuple(str(each.get(key, "")) for key in ("level", "text", "fix"))) for each in told)
        blocks.append(Table("findings", "What saunet doctor found", columns("Level", "Finding", "What to do"), cells))
    return Section("Data", tuple(blocks), "" if blocks else "this run did not record which frames it used")
