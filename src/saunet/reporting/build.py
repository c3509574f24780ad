"""From runs to a report: what each table and figure needs, and a list of what has no data."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone

from saunet import __version__
from saunet.errors import ConfigError, positive, require_matplotlib
from saunet.published import published
from saunet.reporting import figures, tables
from saunet.reporting.document import Document, Figure, Gallery, Missing, Picture, Scene, Section, Table
from saunet.reporting.groups import Groups, comparable
from saunet.reporting.inputs import Inputs
from saunet.reporting.models import Seen, look
from saunet.reporting.scenes import View, read_views, scene
from saunet.reporting.speed import speed
from saunet.runs.folder import Run
from saunet.runs.sweep import differing, labels, sweeps_ratio

Named = dict[str, Run]


@dataclass(frozen=True)
class Options:
    """How a report is made.

    Args:
        title: Heading of the page.
        labels: Names of the single runs, in order; made from what sets them apart if empty.
        scenes: Images to show, by condition; see `saunet.reporting.scenes.read_views`.
        scenes_limit: Images of each condition at most.
        zooms: Enlarged parts of each scene.
        figures: Draw curves; needs matplotlib.
        device: Where scenes are predicted.
        flip: Average with the prediction of the mirrored image.
    """

    title: str = "saunet report"
    labels: Sequence[str] = ()
    scenes: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    scenes_limit: int = 3
    zooms: int = 2
    figures: bool = True
    device: str = "cpu"
    flip: bool = False


@dataclass(frozen=True)
class _Group:
    """Single runs, or the jobs of a sweep, by their short names."""

    name: str
    title: str
    runs: Named
    swept: bool


def build(
    inputs: Inputs, options: Options | None = None, progress: Callable[[str], None] = lambda text: None
) -> Document:
    """Make a report.

    Args:
        inputs: What it is made from.
        options: How.
        progress: Called with what is done next.

    Raises:
        ConfigError: if an option cannot work, or matplotlib is missing.
        DataError: if a scene or a benchmark cannot be read.
    """
    options = options or Options()
    positive("zooms", options.zooms, allow_zero=True)
    if options.figures:
        require_matplotlib("the figures of a report need", "figures=false")
    views = read_views(options.scenes, options.scenes_limit)
    groups = _groups(inputs, options.labels)
    everyone: Named = {name: run for group in groups for name, run in group.runs.items()}
    missing: list[Missing] = []
    seen: dict[str, Seen] = {}
    for name, run in everyone.items():
        progress(f"looking at {name}")
        found = look(run, views, options.device, options.flip)
        if isinstance(found, Seen):
            seen[name] = found
        elif run.checkpoint is not None or run.error is None:
            missing.append(Missing(f"Size and pictures of {name}", found))
    progress("drawing")
    sizes = {name: one.parameters for name, one in seen.items()}
    shown = {name: run for name, run in everyone.items() if run.job is None or _evaluated(run)}
    table1, no_rows = tables.table1(shown)
    table2, no_sizes = tables.table2(_by_networks(everyone, sizes))
    table3, no_ablation = tables.table3({name: run for group in groups for name, run in _varied(group).items()})
    explained = tables.explained_table(everyone)
    sections = [
        Section(
            "Accuracy",
            (table1, explained) if explained else (table1,),
            "The paper’s numbers as published, and ours as measured by this installation.",
        ),
        Section("Networks", (table2, table3)),
        Section("Runs", _runs(groups, options.figures, missing)),
    ]
    if options.figures:
        curves = [figure for group in groups for figure in _curves(group, missing)]
        sections += [Section("Training", curves, "Each point is a mean over neighboring steps.")] if curves else []
    else:
        missing.append(Missing("Figs. 4, 5 and 10", "figures=false"))
    galleries = [gallery for group in groups for gallery in _galleries(group, views, seen, options.zooms)]
    if galleries:
        sections.append(Section("Depth side by side", galleries, _READING))
    missing += _no_pictures(views, galleries)
    points, table10, no_speed = speed(inputs.benchmarks, shown, seen)
    if table10:
        sections.append(Section("Accuracy and time", [*_speed(points, options.figures), table10]))
    missing += [*no_rows, *no_sizes, *no_ablation, *no_speed]
    missing.append(Missing("Published curves and pictures", "the paper prints them as images only"))
    if len(shown) < len(everyone):
        why = "they are in the tables of their sweeps; saunet evaluate puts their checkpoints here too"
        missing.append(Missing("Table 1, jobs of sweeps", why))
    return Document(options.title, _facts(everyone), tuple(sections), tuple(missing))


_READING = (
    "Disparity, bright where it is near; each picture has its own range of colors, for the scale of a model means "
    "nothing. Boxes lie where the models see depth jump on edges of the image, the same ones for all models."
)


def _groups(inputs: Inputs, wanted: Sequence[str]) -> list[_Group]:
    members = [*([inputs.runs] if inputs.runs else []), *(sweep.runs for sweep in inputs.sweeps)]
    if wanted and len(wanted) != len(inputs.runs):
        raise ConfigError(f"labels holds {len(wanted)} names for {len(inputs.runs)} single runs; give one for each")
    names = labels(members)
    if wanted:
        names[0] = list(wanted)
    if len({name for row in names for name in row}) < sum(map(len, names)):
        raise ConfigError(f"labels {list(wanted)} name two runs alike; give each its own name")
    groups = []
    if inputs.runs:
        groups.append(_Group("runs", "runs", dict(zip(names[0], inputs.runs, strict=True)), swept=False))
    counts = Counter(sweep.name for sweep in inputs.sweeps)
    for number, (sweep, row) in enumerate(zip(inputs.sweeps, names[len(groups) :], strict=True)):
        slug = _slug(f"sweep_{sweep.name}") + (f"_{number}" if counts[sweep.name] > 1 else "")
        jobs = dict(zip(row, sweep.runs, strict=True))
        groups.append(_Group(slug, f"sweep {sweep.name}", jobs, swept=True))
    return groups


def _heading(group: _Group) -> str:
    return f"{group.title[0].upper()}{group.title[1:]}" + (f": {len(group.runs)} jobs" if group.swept else "")


def _evaluated(run: Run) -> bool:
    return any(not score.validation for score in run.scores)


def _varied(group: _Group) -> Named:
    """Return the runs of a group whose runs have different networks; nothing of one that varies something else."""
    kinds = {tables.networks(run) for run in group.runs.values() if run.component("model/encoder")}
    return group.runs if len(kinds) > 1 or not group.swept else {}


def _runs(groups: Sequence[_Group], draw: bool, missing: list[Missing]) -> list[Table | Figure]:
    blocks: list[Table | Figure] = []
    for group in groups:
        blocks.append(tables.runs_table(group.name, _heading(group), group.runs, swept=group.swept))
        if sweeps_ratio(list(group.runs.values())) and draw:
            drawing = figures.draw_ratio(group.runs)
            if drawing is None:
                why = "fewer than two jobs have scores that compare"
                missing.append(Missing(f"Errors against α/β of {group.title}", why))
                continue
            shared = list(comparable(group.runs).values())
            caption = f"Errors against the ratio of eq. (14). {Groups(shared)(shared[0])}."
            picture = Picture(f"{group.name}_ratio.svg", drawing, "errors against the ratio alpha/beta")
            blocks.append(Figure("Choice of α and β", picture, caption))
    return blocks


def _curves(group: _Group, missing: list[Missing]) -> list[Figure]:
    ordered = sweeps_ratio(list(group.runs.values()))
    wanted = (
        ("Fig. 4", "loss", (("train/loss", "training loss, total"), ("train/photometric", "photometric term")),
         "Totals of different weights do not compare; the photometric term, eqs. (8) to (12), does."),
        ("Fig. 5", "accuracy", (("val/a1", "accuracy, δ < 1.25"), ("val/abs_rel", "Abs Rel")),
         "On validation frames, after each epoch."),
    )  # fmt: skip
    found = []
    for number, what, panels, caption in wanted:
        drawing = figures.draw_curves(group.runs, panels, ordered=ordered)
        if drawing is None:
            missing.append(
                Missing(
                    f"{number}, {what} of {group.title}",
                    "no run has logged it",
                )
            )
            continue
        picture = Picture(f"{group.name}_{what}.svg", drawing, f"{what} against epoch")
        place = f": {group.title}" if group.swept else ""
        found.append(Figure(f"{number}. {what.capitalize()} against epoch{place}", picture, caption))
    return found


def _galleries(group: _Group, views: Sequence[View], seen: Mapping[str, Seen], zooms: int) -> list[Gallery]:
    """Return the group's pictures by condition: Fig. 7 where losses differ, else Fig. 8 (11: networks differ) and 9."""
    names = [name for name in group.runs if name in seen]
    if not names:
        return []
    keys = {key.replace("/", ".") for key in differing([group.runs[name] for name in names], by_overrides=group.swept)}
    networks = {tables.networks(group.runs[name]) for name in names}
    losses = bool(keys) and all(
        key.split(".")[0] in ("objective", "loss") or key == "data.target_depth" for key in keys
    )
    found = []
    for condition in dict.fromkeys(view.condition for view in views):
        members = [(place, view) for place, view in enumerate(views) if view.condition == condition]
        campus = condition.lower().startswith("campus")
        number = "Fig. 7" if losses else "Fig. 9" if campus else "Figs. 8 and 11" if len(networks) > 1 else "Fig. 8"
        scenes: list[Scene] = []
        for count, (place, view) in enumerate(members):
            maps = {name: seen[name].disparities[place] for name in names}
            scenes.append(scene(view, maps, f"{group.name}_{_slug(condition)}_{count}", zooms))
        what = "loss functions" if losses else "models" if len(networks) > 1 or not group.swept else "settings"
        heading = f"{what.capitalize()} side by side: {condition.replace('_', ' ')}"
        title = heading if what == "settings" else f"{number}. {heading}"
        count_words = f"{len(names)} {'models' if what == 'models' else 'settings'}"
        count_words += f" of {group.title}." if group.swept else "."
        found.append(Gallery(title, tuple(scenes), count_words))
    return found


def _no_pictures(views: Sequence[View], galleries: Sequence[Gallery]) -> list[Missing]:
    if not views:
        why = "no scenes given; name images, such as 'scenes={kitti: FOLDER, campus_sunny: FOLDER}'"
        return [Missing("Figs. 7, 8, 9 and 11", why)]
    if not galleries:
        return [Missing("Figs. 7, 8, 9 and 11", "no run has a checkpoint that can be used")]
    numbered = [re.match(r"Figs?\. ([\d and]+)\.", gallery.title) for gallery in galleries]
    found = {number for match in numbered if match for number in re.findall(r"\d+", match[1])}
    reasons = {
        "7": "no group of runs differs in its loss alone",
        "8": "no scenes but those of the campus, or runs that differ in their loss alone",
        "9": "no scenes named campus_CONDITION",
        "11": "no runs of different networks",
    }
    return [Missing(f"Fig. {number}", reason) for number, reason in reasons.items() if number not in found]


def _speed(points: Sequence[tuple[str, float, float]], draw: bool) -> list[Figure]:
    if not points or not draw:
        return []
    printed = [(f"{one.method}, published ({one.device})", one.a1, one.seconds) for one in published().figure10]
    picture = Picture("figure10.svg", figures.draw_speed(points, printed), "seconds an image against accuracy")
    caption = (
        "Times of single images. One belongs to the runs whose network has the benchmark's parameters and size. "
        "Hollow: the only time that the paper gives in numbers, from another device and data set."
    )
    return [Figure("Fig. 10. Accuracy against time", picture, caption)]


def _by_networks(runs: Named, sizes: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
    """Return sizes by networks in words, so that a sweep's jobs are one row; by run where the words do not tell."""
    words: dict[str, set[tuple[int, int]]] = {}
    for name, size in sizes.items():
        words.setdefault(_words(runs[name]), set()).add(size)
    return {(_words(runs[name]) if len(words[_words(runs[name])]) == 1 else name): size for name, size in sizes.items()}


def _words(run: Run) -> str:
    pose = run.component("model/pose")
    return tables.networks(run) + (f", pose {pose}" if pose else "") if run.component("model/encoder") else run.name


def _facts(runs: Named) -> tuple[str, ...]:
    counts = Counter(run.status for run in runs.values())
    told = ", ".join(
        f"{count} {status if status != 'unknown' else 'without run.json'}" for status, count in counts.items()
    )
    made = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    return (f"{len(runs)} run{'' if len(runs) == 1 else 's'}: {told}", f"made {made}", f"saunet {__version__}")


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9-]+", "_", text).strip("_").lower() or "scene"
