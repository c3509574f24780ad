"""`report`: one page of the paper's tables and figures with our runs beside them, or how runs differ."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from saunet import __version__
from saunet.errors import ConfigError, checked, one_of, positive, usable_device
from saunet.io.atomic import check_folder, write_bytes
from saunet.published import published
from saunet.reporting import figures, tables
from saunet.reporting.compare import compared
from saunet.reporting.inputs import Inputs, collect
from saunet.reporting.page import Document, Figure, Gallery, Missing, Picture, Scene, Section, write
from saunet.reporting.scenes import Seen, View, look, read_views, scene
from saunet.reporting.tables import Groups, comparable
from saunet.runs.run import Run
from saunet.runs.sweep import differing, labels, sweeps_ratio
from saunet.tables import Table, notebook_html, show
from saunet.tables.drawing import Point, draw_speed, svg

Named = dict[str, Run]
IMAGES = "images.csv"
"""What a comparison writes: what was paired, an image a line."""
Scenes = str | Sequence[str] | Mapping[str, str | Sequence[str]] | None


@checked
@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Options of `report`: its inputs, and how to present them.

    Args:
        runs: Folders of runs, sweeps, evaluations and benchmarks, folders that hold such folders, and checkpoints.
        compare: Report how the runs differ instead of making a page; ``images.csv`` has each run's errors for every
            image.
        checkpoint: Which checkpoint of a run to use, ``best`` or ``last``.
        title: Heading of the page.
        labels: Names of the single runs, in order; by default made from their differing settings.
        scenes: Images to show: folders or patterns, or a mapping of such by condition.
        scenes_limit: Largest number of images per condition.
        zooms: Number of enlarged parts per scene.
        figures: Draw curves, if matplotlib is installed.
        device: Where to predict scenes; ``auto`` uses a GPU if there is one.
        flip: Average with the prediction of the mirrored image.
        output_dir: Folder for the page, its Markdown, its tables and its pictures; None, the default in Python, writes
            none.

    Raises:
        ConfigError: if an option is invalid.

    Examples:
        >>> saunet.ReportOptions(runs=("outputs/train",)).zooms
        2
    """

    runs: tuple[str | Path, ...] = ()
    compare: bool = False
    checkpoint: str = "best"
    title: str = "saunet report"
    labels: tuple[str, ...] = ()
    scenes: Scenes = None
    scenes_limit: int = 3
    zooms: int = 2
    figures: bool = True
    device: str = "auto"
    flip: bool = False
    output_dir: str | Path | None = None

    def __post_init__(self) -> None:
        one_of("checkpoint", self.checkpoint, ("best", "last"))
        positive("scenes_limit", self.scenes_limit)
        positive("zooms", self.zooms, allow_zero=True)
        _by_condition(self.scenes)


@dataclass(frozen=True)
class ReportResult:
    """A report, or a comparison."""

    document: Document | None = None
    """The page; None for a comparison."""
    tables: tuple[Table, ...] = ()
    """Tables of the page or the comparison."""
    left_out: tuple[str, ...] = ()
    """One sentence for each part without data."""
    folder: Path | None = None
    """Folder of the files."""

    def _repr_html_(self) -> str:
        return notebook_html(self.tables)

    def show(self) -> None:
        """Print a comparison, or the path of the page and what it lacks."""
        if self.document is None:
            show(self.tables)
        for sentence in self.left_out:
            print(f"left out: {sentence}", file=sys.stdout if self.document is None else sys.stderr)
        if self.folder is not None:
            place = self.folder / ("report.html" if self.document is not None else IMAGES)
            print(f"{'image by image' if self.document is None else 'report'}: {place}")


def report(options: ReportOptions) -> ReportResult:
    """Make one page of tables, curves and pictures from finished runs, or report how runs differ.

    Args:
        options: The inputs, and how to present them.

    Raises:
        ConfigError: if the labels do not fit the runs.
        DataError: if a path holds no run, sweep, checkpoint, evaluation or benchmark, or a file cannot be read or
            written.

    Examples:
        >>> report(ReportOptions(runs=("outputs/train",), output_dir="page")).show()  # doctest: +SKIP

    Returns:
        The page, or the tables of a comparison; `ReportResult.show` prints it.
    """
    folder = None if options.output_dir is None else check_folder(options.output_dir)
    inputs = collect(options.runs, options.checkpoint, strangers=not options.compare)
    if options.compare:
        found, left_out, images = compared(inputs, options.labels)
        if folder is not None and images:
            write_bytes(folder / IMAGES, images.encode())
        return ReportResult(None, tuple(found), tuple(left_out), folder if images else None)
    with Console(stderr=True).status("reading") as status:
        document = build(inputs, options, status.update)
    if folder is not None:
        write(document, folder)
    left_out = [f"{missing.what}: {missing.why}" for missing in document.missing]
    return ReportResult(document, tuple(document.tables), tuple(left_out), folder)


def _by_condition(scenes: Scenes) -> dict[str, str | Sequence[str]]:
    """Return the images to show by condition; a list or a single path has no condition."""
    if isinstance(scenes, Mapping):
        return {str(key): value for key, value in scenes.items()}
    return {"scenes": scenes} if scenes else {}


@dataclass(frozen=True)
class _Group:
    """Single runs, or the jobs of a sweep, by their short names."""

    name: str
    title: str
    runs: Named
    swept: bool


def build(
    inputs: Inputs, options: ReportOptions | None = None, progress: Callable[[str], None] = lambda text: None
) -> Document:
    """Make a report from inputs that are read already."""
    options = options or ReportOptions()
    device, draw = str(usable_device(options.device)), options.figures and find_spec("matplotlib") is not None
    views = read_views(_by_condition(options.scenes), options.scenes_limit)
    groups = _groups(inputs, options.labels)
    everyone: Named = {name: run for group in groups for name, run in group.runs.items()}
    missing: list[Missing] = []
    seen: dict[str, Seen] = {}
    for name, run in everyone.items():
        progress(f"looking at {name}")
        found = look(run, views, device, options.flip)
        if isinstance(found, Seen):
            seen[name] = found
        elif run.checkpoint is not None or run.error is None:
            missing.append(Missing(f"Size and pictures of {name}", found))
    progress("drawing")
    sizes = {name: one.parameters for name, one in seen.items()}
    evaluated = {name for name, run in everyone.items() if not all(score.validation for score in run.scores)}
    shown = {name: run for name, run in everyone.items() if run.job is None or name in evaluated}
    table1, no_rows = tables.table1(shown)
    table2, no_sizes = tables.table2(_by_networks(everyone, sizes))
    table3, no_ablation = tables.table3({name: run for group in groups for name, run in _varied(group).items()})
    explained = tables.explained_table(everyone)
    intro = "As measured by this installation; published rows, if any, are the paper’s, as printed."
    accuracy = [table for table in (table1, explained, *tables.detail_tables(everyone)) if table]
    networks = [table for table in (table2, table3) if table]
    sections = [Section("Accuracy", accuracy, intro)] if accuracy else []
    sections.append(Section("Runs", [*_runs(groups, draw, missing), *tables.health_tables(everyone)]))
    if draw:
        curves = [figure for group in groups for figure in _curves(group, missing)]
        sections += [Section("Training", curves, "Each point is a mean over neighboring steps.")] if curves else []
    else:
        why = "they need matplotlib: run `pip install 'saunet[plot]'`" if options.figures else "figures=false"
        missing.append(Missing("Curves, and accuracy against time", why))
    galleries = [gallery for group in groups for gallery in _galleries(group, views, seen, options.zooms)]
    if galleries:
        sections.append(Section("Depth side by side", galleries, _READING))
    if networks:
        sections.append(Section("Networks", networks))
    points, table10, no_speed = figures.speed(inputs.benchmarks, shown, seen)
    if table10:
        sections.append(Section("Accuracy and time", [*(_speed(points) if points and draw else ()), table10]))
    missing += [*_no_pictures(views, galleries), *no_rows, *no_sizes, *no_ablation, *no_speed]
    missing.append(Missing("Published curves and pictures", "the paper prints them as images only"))
    if any(name not in shown and not run.explained for name, run in everyone.items()):
        why = "they are in the tables of their sweeps; evaluate their checkpoints to include them here"
        missing.append(Missing("Errors and accuracy of the jobs of sweeps", why))
    return Document(options.title, _facts(everyone), tuple(sections), tuple(missing))


_READING = (
    "Disparity; bright is near. Each picture has its own range of colors, because the scale of a model is "
    "arbitrary. Boxes mark parts where the models see depth jump at edges of the image; they are the same for all "
    "models."
)


def _groups(inputs: Inputs, wanted: Sequence[str]) -> list[_Group]:
    members = [*([inputs.runs] if inputs.runs else []), *(sweep.runs for sweep in inputs.sweeps)]
    if wanted and len(wanted) != len(inputs.runs):
        raise ConfigError(f"labels holds {len(wanted)} names for {len(inputs.runs)} single runs; give one for each")
    names = labels(members)
    if wanted:
        names[0] = list(wanted)
    if len({name for row in names for name in row}) < sum(map(len, names)):
        raise ConfigError(f"labels {list(wanted)} have the same name twice; give each run its own")
    named = [dict(zip(row, runs, strict=True)) for row, runs in zip(names, members, strict=True)]
    groups = [_Group("runs", "runs", named.pop(0), swept=False)] if inputs.runs else []
    counts = Counter(sweep.name for sweep in inputs.sweeps)
    for number, (sweep, jobs) in enumerate(zip(inputs.sweeps, named, strict=True)):
        slug = _slug(f"sweep_{sweep.name}") + (f"_{number}" if counts[sweep.name] > 1 else "")
        groups.append(_Group(slug, f"sweep {sweep.name}", jobs, swept=True))
    return groups


def _varied(group: _Group) -> Named:
    """Return the runs of a group with different networks; nothing for a group that varies something else."""
    kinds = {tables.networks(run) for run in group.runs.values() if run.component("model/encoder")}
    return group.runs if len(kinds) > 1 or not group.swept else {}


def _runs(groups: Sequence[_Group], draw: bool, missing: list[Missing]) -> list[Table | Figure]:
    blocks: list[Table | Figure] = []
    for group in groups:
        jobs = f"{group.title[0].upper()}{group.title[1:]}: {len(group.runs)} jobs"
        heading = jobs if group.swept else "Their differing settings and scores"
        blocks.append(tables.runs_table(group.name, heading, group.runs, swept=group.swept))
        if not draw or not sweeps_ratio(list(group.runs.values())):
            continue
        drawing = figures.draw_ratio(group.runs)
        if drawing is None:
            why = "fewer than two jobs have comparable scores"
            missing.append(Missing(f"Errors against α/β of {group.title}", why))
            continue
        shared = list(comparable(group.runs).values())
        caption = f"Errors against the ratio of eq. (14). {Groups(shared)(shared[0])}."
        picture = Picture(f"{group.name}_ratio.svg", drawing, "errors against the ratio alpha/beta")
        blocks.append(Figure("Choice of α and β", picture, caption))
    return blocks


def _curves(group: _Group, missing: list[Missing]) -> list[Figure]:
    if not any(run.record or run.config for run in group.runs.values()):  # evaluations and checkpoints alone
        return []
    ordered = sweeps_ratio(list(group.runs.values()))
    wanted = (
        ("Fig. 4", "loss", (("train/loss", "training loss, total"), ("train/photometric", "photometric term")),
         "Totals with different weights cannot be compared; the photometric term, eqs. (8) to (12), can."),
        ("Fig. 5", "accuracy", (("val/a1", "accuracy, δ < 1.25"), ("val/abs_rel", "Abs Rel")),
         "On validation frames."),
    )  # fmt: skip
    found = []
    for figure, what, panels, caption in wanted:
        drawing = figures.draw_curves(group.runs, panels, ordered=ordered)
        if drawing is None:
            missing.append(Missing(f"{what.capitalize()} during training of {group.title}", "no run has logged it"))
            continue
        picture = Picture(f"{group.name}_{what}.svg", drawing, f"{what} during training")
        place = f": {group.title}" if group.swept else ""
        found.append(Figure(f"{what.capitalize()} during training{place} (the paper’s {figure})", picture, caption))
    return found


def _galleries(group: _Group, views: Sequence[View], seen: Mapping[str, Seen], zooms: int) -> list[Gallery]:
    """Return the group's pictures by condition: Fig. 7 where losses differ, else Fig. 8 (11: networks differ) and 9."""
    runs = {name: run for name, run in group.runs.items() if name in seen}
    if not runs:
        return []
    keys = {key.replace("/", ".") for key in differing(list(runs.values()), by_overrides=group.swept)}
    several = len(set(map(tables.networks, runs.values()))) > 1
    losses = keys and all(key.split(".")[0] in ("objective", "loss") or key == "data.target_depth" for key in keys)
    what = "loss functions" if losses else "models" if several or not group.swept else "settings"
    caption = f"{len(runs)} {'models' if what == 'models' else 'settings'}"
    caption += f" of {group.title}." if group.swept else "."
    found = []
    for condition in dict.fromkeys(view.condition for view in views):
        campus = condition.lower().startswith("campus")
        numbers: tuple[str, ...] = ("7",) if losses else ("9",) if campus else ("8", "11") if several else ("8",)
        title = f"{what.capitalize()} side by side: {condition.replace('_', ' ')}"
        if what == "settings":  # not a figure of the paper
            numbers = ()
        else:
            title = f"{title} (the paper’s Fig{'s' * (len(numbers) > 1)}. {' and '.join(numbers)})"
        scenes: list[Scene] = []
        for place, view in enumerate(views):
            if view.condition == condition:
                maps = {name: seen[name].disparities[place] for name in runs}
                scenes.append(scene(view, maps, f"{group.name}_{_slug(condition)}_{len(scenes)}", zooms))
        found.append(Gallery(title, tuple(scenes), caption, numbers))
    return found


def _no_pictures(views: Sequence[View], galleries: Sequence[Gallery]) -> list[Missing]:
    what = "Depth side by side"
    if not views:
        why = "no scenes given; set scenes, such as 'scenes={kitti: FOLDER, campus_sunny: FOLDER}'"
        return [Missing(what, why)]
    if not galleries:
        return [Missing(what, "no run has a checkpoint that can be used")]
    found = {number for gallery in galleries for number in gallery.numbers}
    reasons = {
        "7": ("Loss functions", "no group of runs differs only in its loss"),
        "8": ("Models", "no scenes other than those of the campus, or no runs that differ only in their loss"),
        "9": ("Models on the campus", "no scenes named campus_CONDITION"),
        "11": ("Different networks", "no runs of different networks"),
    }
    return [
        Missing(f"{what} side by side (the paper’s Fig. {number})", reason)
        for number, (what, reason) in reasons.items()
        if number not in found
    ]


def _speed(points: Sequence[Point]) -> list[Figure]:
    printed = [
        Point(f"{one.method}, published ({one.device})", one.a1, one.seconds, published=True)
        for one in published().figure10
    ]
    drawing = svg(draw_speed([*points, *printed], "accuracy, δ < 1.25"))
    caption = (
        "Times of single images, for runs whose network has the benchmark's parameters and size. Hollow: the only "
        "time that the paper gives in numbers, from another device and data set."
    )
    picture = Picture("figure10.svg", drawing, "seconds per image against accuracy")
    return [Figure("Accuracy against time (the paper’s Fig. 10)", picture, caption)]


def _by_networks(runs: Named, sizes: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
    """Return sizes by networks in words, so that a sweep's jobs share a row; by run if the words are ambiguous."""
    words = {name: _words(runs[name]) for name in sizes}
    counts = Counter(word for word, _ in {(words[name], size) for name, size in sizes.items()})
    return {(words[name] if counts[words[name]] == 1 else name): size for name, size in sizes.items()}


def _words(run: Run) -> str:
    return tables.with_pose(run) if run.component("model/encoder") else run.name


def _facts(runs: Named) -> tuple[str, ...]:
    counts = Counter(map(tables.status, runs.values()))
    counts["without run.json"] = counts.pop("unknown", 0)
    told = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    made = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    return (f"{len(runs)} run{'' if len(runs) == 1 else 's'}: {told}", f"made {made}", f"saunet {__version__}")


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9-]+", "_", text).strip("_").lower() or "scene"
