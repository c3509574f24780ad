"""The result of an evaluation as an object: rows, their means as tables and pictures, parts and joins."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.errors import ConfigError, one_of, positive, require_matplotlib
from saunet.evaluation.rows import (
    ERROR_COLUMNS,
    BucketRow,
    Comparison,
    ImageRow,
    ShapeRow,
    ShapeSummary,
    Spread,
    Summary,
    ViewRow,
    ViewSummary,
    interval,
)
from saunet.fingerprint import fingerprint
from saunet.metrics.functional import ERROR_NAMES
from saunet.metrics.protocols import Protocol
from saunet.tables import Row, Table, columns, notebook_html, show
from saunet.tables.drawing import Drawing, colors, new_figure, svg


@dataclass(frozen=True)
class EvaluationResult:
    """All rows of an evaluation, with the protocols that they were computed with; a notebook shows the tables."""

    protocols: tuple[Protocol, ...]
    predictors: tuple[str, ...]
    rows: tuple[ImageRow, ...]
    buckets: tuple[BucketRow, ...] = ()
    """Errors by distance, region and edges, if requested."""
    shapes: tuple[ShapeRow, ...] = ()
    """Scores of edges and point clouds, if requested."""
    views: tuple[ViewRow, ...] = ()
    """Rows of protocols that need no ground truth."""
    spreads: tuple[Spread, ...] = ()
    """Intervals of the means, if requested."""
    comparisons: tuple[Comparison, ...] = ()
    """Differences from another evaluation, if requested."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """Other settings that the numbers depend on, such as post-processing; plain data."""
    sources: tuple[str, ...] = ()
    """Names of the sources of a mixture of data sets; image names begin with them."""
    folder: Path | None = None
    """Where the files were written."""
    notes: tuple[str, ...] = ()
    """Further notes, one sentence each."""

    def select(self, predictor: str, protocol: str) -> tuple[ImageRow, ...]:
        """Return the rows of one predictor under one protocol, in the order they were computed."""
        one_of("predictor", predictor, self.predictors)
        one_of("protocol", protocol, [rules.name for rules in self.protocols])
        return tuple(row for row in self.rows if row.predictor == predictor and row.protocol == protocol)

    def errors(self, predictor: str, protocol: str) -> NDArray[np.float64]:
        """Return the errors of the images that have ground truth, images x 7; raises as `select`."""
        rows = [row.errors for row in self.select(predictor, protocol) if row.pixels]
        return np.array(rows, dtype=np.float64).reshape(-1, 7)

    def part(self, start: str) -> EvaluationResult:
        """Return the rows of the images whose names begin with ``start``, such as those of one source of a mixture.

        Protocols without ground truth for these images are dropped, and so are intervals and comparisons, which are
        about all images.
        """
        mine = [row for row in self.rows if row.name.startswith(start)]
        scored = {row.protocol for row in mine if row.pixels}
        views = tuple(row for row in self.views if row.name.startswith(start))
        known = scored | {row.protocol for row in views}
        protocols = tuple(rules for rules in self.protocols if rules.name in known)
        rows = tuple(row for row in mine if row.protocol in scored)
        shapes = tuple(row for row in self.shapes if row.name.startswith(start) and row.protocol in scored)
        return EvaluationResult(protocols, self.predictors, rows, shapes=shapes, views=views, settings=self.settings)

    def fingerprint(self, protocol: str) -> str:
        """Return the SHA-256 of the names of the images under one protocol, those without ground truth included.

        It is the hash of the data module's split, which a training's ``run.json`` records.
        """
        rows: tuple[ImageRow | ViewRow, ...] = (*self.rows, *self.views)
        return fingerprint({row.name for row in rows if row.protocol == protocol})

    def summaries(self) -> tuple[Summary, ...]:
        """Return one summary for each protocol and predictor with rows, in the requested order."""
        found = []
        for rules, predictor in itertools.product(self.protocols, self.predictors):
            rows = self.select(predictor, rules.name)
            scored = [row for row in rows if row.pixels]
            errors: list[float] = np.array([row.errors for row in scored] or [(math.nan,) * 7]).mean(0).tolist()
            scales = np.array([row.scale for row in scored] or [math.nan])
            means = (tuple(errors), float(scales.mean()), float(scales.std()))
            if rows:
                found.append(Summary(predictor, rules.name, *means, len(scored), len(rows) - len(scored)))
        return tuple(found)

    def view_summaries(self) -> tuple[ViewSummary, ...]:
        """Return the means without ground truth by protocol, predictor and condition, ``all`` of each last."""
        found = []
        for protocol, predictor in dict.fromkeys((row.protocol, row.predictor) for row in self.views):
            mine = [row for row in self.views if (row.protocol, row.predictor) == (protocol, predictor)]
            mine = [row for row in mine if not math.isnan(row.warped)]
            conditions = list(dict.fromkeys(row.condition for row in mine))
            for condition in [*(conditions if len(conditions) > 1 else []), "all"]:
                rows = [row for row in mine if condition in ("all", row.condition)]
                numbers = np.mean([(row.warped, row.unwarped, row.explained, row.visible) for row in rows], axis=0)
                found.append(ViewSummary(protocol, predictor, condition, len(rows), *numbers.tolist()))
        return tuple(found)

    def shape_summaries(self) -> tuple[ShapeSummary, ...]:
        """Return the means over the images that have each number, one summary for each protocol and predictor."""
        found = []
        for protocol, predictor in dict.fromkeys((row.protocol, row.predictor) for row in self.shapes):
            mine = [row for row in self.shapes if (row.protocol, row.predictor) == (protocol, predictor)]
            values = np.array([astuple(row)[3:] for row in mine])
            known = ~np.isnan(values)
            means = (values[known[:, place], place] for place in range(values.shape[1]))
            numbers = (float(each.mean()) if each.size else math.nan for each in means)
            edges, clouds = int(known[:, 0].sum()), int(known[:, 2].sum())
            accuracy, completeness, precision, recall, f_score = numbers
            found.append(
                ShapeSummary(protocol, predictor, accuracy, completeness, precision, recall, f_score, edges, clouds)
            )
        return tuple(found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each predictor whose depth and motion explain the neighbors no better than no warping."""
        tracked = self.settings.get("motion") == "tracked"
        young = "" if tracked else ", or only the motion is not learned yet: check with motion=tracked"
        return tuple(
            f"'{view.predictor}' under {view.protocol}: warped ({view.warped:.4f}) is not below unwarped "
            f"({view.unwarped:.4f}), so nothing was learned{young}"
            for view in self.view_summaries()
            if view.condition == "all" and not view.warped < view.unwarped
        )

    def joined(self, other: EvaluationResult) -> EvaluationResult:
        """Join both results: other protocols (another ground truth) or other predictors on the same images."""
        mine, theirs = ({(row.predictor, row.protocol) for row in result.rows} for result in (self, other))
        if both := sorted(mine & theirs):
            raise ConfigError(
                f"both results hold predictor '{both[0][0]}' under protocol '{both[0][1]}'; "
                "give one of them another name"
            )
        rules = {protocol.name: protocol for protocol in self.protocols}
        for protocol in other.protocols:
            if rules.setdefault(protocol.name, protocol) != protocol:
                raise ConfigError(
                    f"the results have different rules for protocol '{protocol.name}'; rename one of them"
                )
            names = [{row.name for row in result.rows if row.protocol == protocol.name} for result in (self, other)]
            if all(names) and names[0] != names[1]:
                raise ConfigError(
                    f"the results under '{protocol.name}' come from different images ({len(names[0])} and "
                    f"{len(names[1])}); evaluate both on the same split"
                )
        return replace(
            self,
            protocols=tuple(rules.values()),
            predictors=tuple(dict.fromkeys((*self.predictors, *other.predictors))),
            rows=(*self.rows, *other.rows),
            buckets=(*self.buckets, *other.buckets),
            shapes=(*self.shapes, *other.shapes),
            views=(*self.views, *other.views),
            spreads=(*self.spreads, *other.spreads),
            comparisons=(*self.comparisons, *other.comparisons),
            settings={**self.settings, **other.settings},
        )

    def tables(self, ranges: bool = False) -> list[Table]:
        """Return one table per protocol, then the first predictor's errors by place, then comparisons."""
        found = []
        summaries, views = self.summaries(), self.view_summaries()
        for protocol in self.protocols:
            if mine := [summary for summary in summaries if summary.protocol == protocol.name]:
                found.append(self._means(protocol, mine, ranges))
            if seen := [view for view in views if view.protocol == protocol.name]:
                found.append(_view_table(protocol, seen))
        for protocol in self.protocols:  # the other predictors' errors by place are only in the files
            place = (protocol.name, self.predictors[0])
            if rows := [row for row in self.buckets if (row.protocol, row.predictor) == place]:
                found.append(_bucket_table(rows))
        found += _shape_tables(self.protocols, self.shape_summaries(), self.settings.get("cloud"))
        return found + [comparison.table() for comparison in self.comparisons]

    @property
    def table(self) -> Table:
        """The means under the first protocol."""
        return self.tables()[0]

    def worst(self, count: int = 8, error: str = "abs_rel", predictor: str | None = None) -> Table:
        """Return the images with the largest errors under the first protocol, the worst first.

        Args:
            count: Number of images.
            error: The error to sort by, one of `saunet.metrics.functional.ERROR_NAMES`.
            predictor: The predictor; the first one by default.

        Returns:
            A table with a row per image.

        Raises:
            ConfigError: for an unknown error or predictor, or if no protocol compares with ground truth.
        """
        column = ERROR_NAMES.index(one_of("error", error, ERROR_NAMES))
        protocol, who = self._compared(), predictor or self.predictors[0]
        rows = [row for row in self.select(who, protocol.name) if row.pixels]
        rows.sort(key=lambda row: row.errors[column], reverse=ERROR_COLUMNS[column].better < 0)
        cells = tuple(Row((row.name, *row.errors, row.pixels)) for row in rows[: int(positive("count", count))])
        title = f"{protocol.name}: the images with the worst {ERROR_COLUMNS[column].heading} of '{who}'"
        return Table("worst", title, (*columns("image"), *ERROR_COLUMNS, *columns("pixels")), cells, bold_best=False)

    def plot(self, error: str = "abs_rel") -> Drawing:
        """Draw the errors of all images from the smallest to the largest, one line per predictor.

        Args:
            error: The error, one of `saunet.metrics.functional.ERROR_NAMES`.

        Returns:
            The drawing; a notebook shows it, and `Drawing.save` writes it.

        Raises:
            ConfigError: for an unknown error, if matplotlib is missing, or if no protocol compares with ground truth.
        """
        column = ERROR_NAMES.index(one_of("error", error, ERROR_NAMES))
        require_matplotlib("a plot needs", "nothing, and use .table")
        protocol = self._compared()
        figure, (axis,) = new_figure(1, 7.6, 3.3)
        for predictor, tint in zip(self.predictors, colors(len(self.predictors)), strict=True):
            values = np.sort(self.errors(predictor, protocol.name)[:, column])
            axis.plot(np.arange(1, len(values) + 1), values, color=tint, label=predictor, drawstyle="steps-mid")
        axis.set_title(f"{ERROR_COLUMNS[column].heading} of each image", loc="left", fontsize=10)
        axis.set_xlabel(f"images, sorted; protocol {protocol.name}")
        axis.legend(frameon=False)
        return Drawing(svg(figure))

    def _compared(self) -> Protocol:
        """Return the first protocol that compares with ground truth."""
        if not self.rows:
            raise ConfigError("nothing was compared with ground truth, so there are no errors per image; see .table")
        return next(rules for rules in self.protocols if any(row.protocol == rules.name for row in self.rows))

    def _repr_html_(self) -> str:
        return notebook_html(self.tables())

    def show(self) -> None:
        """Print the tables, those of each source of a mixture, the warnings, and where the files are."""
        show(self.tables())
        for source in self.sources:
            alone = self.part(f"{source}/")
            if alone.protocols:
                print(f"{source} alone:")
                show(alone.tables())
        for sentence in (*self.warnings, *self.notes, *([f"results: {self.folder}"] if self.folder else [])):
            print(sentence)

    def _means(self, protocol: Protocol, summaries: Sequence[Summary], ranges: bool) -> Table:
        spreads = {(spread.predictor, spread.protocol): spread for spread in self.spreads}
        first = summaries[0]
        note = f"{first.images} image{'' if first.images == 1 else 's'}"
        if first.images_without_truth:
            note += f"; {first.images_without_truth} more without ground-truth pixels, left out"
        rows, notes = [], [note]
        for summary in summaries:
            rows.append(Row((summary.predictor, *summary.errors, f"{summary.scale:.3g} ± {summary.scale_std:.2g}")))
            if spread := spreads.get((summary.predictor, summary.protocol)):
                ends = zip(spread.low, spread.high, strict=True)
                cells = [f"{low:.3f} to {high:.3f}" if ranges else f"±{(high - low) / 2:.3f}" for low, high in ends]
                rows.append(Row(("", *cells, ""), "dim"))
                notes[1:] = [f"{'range' if ranges else '±'}: {interval(spread)}"]
        headings = (*columns("predictor"), *ERROR_COLUMNS, *columns("scale"))
        return Table("metrics", f"{protocol.name}: {protocol.summary}", headings, tuple(rows), tuple(notes))


def _view_table(protocol: Protocol, views: Sequence[ViewSummary]) -> Table:
    headings = columns(
        "predictor", "condition", "warped ↓|.4f", "unwarped|.4f", "explained ↑|.4f", "visible|.4f", "images"
    )
    rows = [Row((v.predictor, v.condition, v.warped, v.unwarped, v.explained, v.visible, v.images)) for v in views]
    note = "photometric errors of neighbors, warped and unwarped; fractions of pixels"
    title = f"{protocol.name}: {protocol.summary}"
    return Table("views", title, headings, tuple(rows), (note,), bold_best=False)


def _bucket_table(rows: Sequence[BucketRow]) -> Table:
    headings = (*columns("where"), *ERROR_COLUMNS, *columns("pixels"))
    cells = tuple(Row((row.bucket, *row.errors, row.pixels), group=f"by {row.group}") for row in rows)
    title = f"{rows[0].protocol}: where the errors of '{rows[0].predictor}' are"
    return Table("buckets", title, headings, cells, ("over pixels, not images",), bold_best=False)


def _shape_tables(protocols: Sequence[Protocol], shapes: Sequence[ShapeSummary], cloud: object) -> list[Table]:
    """Return the scores of edges and of point clouds under each protocol, as far as measured."""
    found = []
    for protocol in protocols:
        mine = [shape for shape in shapes if shape.protocol == protocol.name]
        if edges := [shape for shape in mine if shape.edge_images]:
            rows = [Row((s.predictor, s.edge_accuracy, s.edge_completeness, s.edge_images)) for s in edges]
            headings = columns("predictor", "accuracy px ↓|.2f", "completeness px ↓|.2f", "images")
            note = "pixels from predicted depth edges to true ones, and back"
            found.append(Table("edges", f"{protocol.name}: depth edges", headings, tuple(rows), (note,)))
        if clouds := [shape for shape in mine if shape.cloud_images]:
            rows = [Row((s.predictor, s.f_score, s.precision, s.recall, s.cloud_images)) for s in clouds]
            headings = columns("predictor", "F-score ↑|.3f", "precision ↑|.3f", "recall ↑|.3f", "images")
            note = f"fractions of points with one of the other cloud within {cloud} m"
            found.append(Table("cloud", f"{protocol.name}: point clouds", headings, tuple(rows), (note,)))
    return found
