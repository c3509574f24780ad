"""What an evaluation found: one row for each image, predictor and protocol, their means, and the tables of both."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from saunet.errors import ConfigError, DataError, one_of
from saunet.fingerprint import fingerprint
from saunet.metrics.functional import ERROR_HEADINGS, HIGHER_IS_BETTER
from saunet.metrics.protocols import Protocol
from saunet.tables import Column, Row, Table, show

ERROR_COLUMNS: tuple[Column, ...] = tuple(
    Column(heading.rpartition(" ")[0], ".3f", 1 if up else -1)
    for heading, up in zip(ERROR_HEADINGS, HIGHER_IS_BETTER, strict=True)
)
"""Columns of the seven errors."""


@dataclass(frozen=True, slots=True)
class ImageRow:
    """The errors of one predictor on one image under one protocol."""

    predictor: str
    protocol: str
    name: str
    """The image's name."""
    pixels: int
    """Pixels compared; 0 where the image has no ground truth, and then the numbers are NaN."""
    scale: float
    """median(truth)/median(prediction), whether or not it was applied."""
    errors: tuple[float, ...]
    """In the order of `saunet.metrics.functional.ERROR_NAMES`, as everywhere below."""


@dataclass(frozen=True, slots=True)
class BucketRow:
    """Errors over all pixels of all images that fall into one bucket (not a mean over images: some have few there)."""

    predictor: str
    protocol: str
    group: str
    """What the buckets of one group divide, such as ``distance``."""
    bucket: str
    """Such as ``10-20 m``, ``bottom third`` or ``near an edge``."""
    pixels: int
    errors: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ViewRow:
    """How well a prediction explains the neighboring frames of one image, where no depth is known."""

    predictor: str
    protocol: str
    name: str
    group: str
    """The condition or the recording that the image belongs to."""
    warped: float
    """Photometric error after warping the neighbors by depth and motion, SAU-Net eqs. (8) to (10)."""
    unwarped: float
    """The same without warping: what a network that has learned nothing reaches."""
    explained: float
    """Fraction of pixels that warping brings closer, SAU-Net eq. (11)."""
    visible: float
    """Fraction of pixels that any neighbor sees."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Means of one predictor under one protocol over the images that have ground truth; NaN if none has."""

    predictor: str
    protocol: str
    errors: tuple[float, ...]
    scale: float
    """Mean of median(truth)/median(prediction)."""
    scale_std: float
    """Its standard deviation over images."""
    images: int
    images_without_truth: int


@dataclass(frozen=True, slots=True)
class ViewSummary:
    """Means of one predictor without ground truth over the images of one condition, or of ``all``."""

    protocol: str
    predictor: str
    condition: str
    images: int
    warped: float
    unwarped: float
    explained: float
    visible: float


@dataclass(frozen=True, slots=True)
class Spread:
    """How sure the means of one predictor under one protocol are: bootstrap intervals."""

    predictor: str
    protocol: str
    level: float
    by: str
    """What was resampled: whole ``drive``s, or single ``image``s where there are too few drives."""
    groups: int
    """How many of them there are."""
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Difference:
    """One error of two predictors on the same images."""

    name: str
    """One of `saunet.metrics.functional.ERROR_NAMES`."""
    first: float
    second: float
    """Means over the images."""
    difference: float
    """``second - first``."""
    low: float
    high: float
    """Bootstrap interval of the difference; with zero outside it, the predictors differ."""
    better: float
    """Fraction of images on which the second is better, ties counted half."""
    p_value: float | None
    """Chance of a difference at least this large if the labels were exchanged at random drive by drive (two-sided);
    None with too few drives."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two predictors on the same images under one protocol."""

    protocol: str
    first: str
    second: str
    """What the tables call them."""
    images: int
    level: float
    """Of the intervals."""
    by: str
    """What was resampled, ``drive`` or ``image``."""
    groups: int
    """How many of them there are."""
    differences: tuple[Difference, ...]
    """One for each of the seven errors."""

    def table(self, *notes: str) -> Table:
        """Return the differences as a table; bold where the interval leaves out zero."""
        columns = (
            Column("error"),
            *(Column(heading, ".4f") for heading in ("first", "second")),
            Column("difference", "+.4f"),
            *(Column(f"{self.level:.0%} {end}".replace("%", " %"), "+.4f") for end in ("low", "high")),
            Column("second better", ".0%"),
            Column("p", ".2g"),
        )
        rows = []
        for column, one in zip(ERROR_COLUMNS, self.differences, strict=True):
            values = (one.first, one.second, one.difference, one.low, one.high, one.better, one.p_value)
            sure = one.low > 0 or one.high < 0
            good = (one.difference > 0) == (column.better > 0)
            rows.append(Row((column.label, *values), marks={3: "good" if good else "bad"} if sure else {}))
        title = f"{self.protocol}: second '{self.second}' against first '{self.first}'"
        told = f"{self.images} images, paired; {interval_note(self)}"
        return Table("comparison", title, columns, tuple(rows), (*notes, told))


@dataclass(frozen=True)
class EvaluationResult:
    """All rows of an evaluation, with the protocols that they were computed under."""

    protocols: tuple[Protocol, ...]
    predictors: tuple[str, ...]
    rows: tuple[ImageRow, ...]
    buckets: tuple[BucketRow, ...] = ()
    """Errors by distance, region and edges, where they were asked for."""
    views: tuple[ViewRow, ...] = ()
    """Rows under protocols that need no ground truth."""
    spreads: tuple[Spread, ...] = ()
    """Intervals of the means, where they were asked for."""
    comparisons: tuple[Comparison, ...] = ()
    """Differences to another evaluation, where they were asked for."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """What else the numbers depend on, such as post-processing; plain data."""
    sources: tuple[str, ...] = ()
    """Names of the sources of a mixture of data sets, whose images begin with them."""
    folder: Path | None = None
    """Where the files were written."""
    notes: tuple[str, ...] = ()
    """Sentences about what else was done."""

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

        Without the protocols under which none of them has ground truth, and without intervals and comparisons, which
        are of all images.
        """
        mine = [row for row in self.rows if row.name.startswith(start)]
        scored = {row.protocol for row in mine if row.pixels}
        views = tuple(row for row in self.views if row.name.startswith(start))
        known = scored | {row.protocol for row in views}
        return EvaluationResult(
            tuple(rules for rules in self.protocols if rules.name in known),
            self.predictors,
            tuple(row for row in mine if row.protocol in scored),
            views=views,
            settings=self.settings,
        )

    def fingerprint(self, protocol: str) -> str:
        """Return the SHA-256 of the names of the images under one protocol, those without ground truth included.

        It is that of the data module's split, which ``run.json`` holds for trainings.
        """
        rows: tuple[ImageRow | ViewRow, ...] = (*self.rows, *self.views)
        return fingerprint({row.name for row in rows if row.protocol == protocol})

    def summaries(self) -> tuple[Summary, ...]:
        """Return one summary for each protocol and predictor that has rows, in the order they were asked for."""
        groups: dict[tuple[str, str], list[ImageRow]] = {
            (rules.name, predictor): [] for rules in self.protocols for predictor in self.predictors
        }
        for row in self.rows:
            groups[row.protocol, row.predictor].append(row)
        return tuple(summarize(rows) for rows in groups.values() if rows)

    def view_summaries(self) -> tuple[ViewSummary, ...]:
        """Return the means without ground truth by protocol, predictor and condition, ``all`` of each last."""
        found = []
        for protocol, predictor in dict.fromkeys((row.protocol, row.predictor) for row in self.views):
            mine = [row for row in self.views if (row.protocol, row.predictor) == (protocol, predictor)]
            groups = list(dict.fromkeys(row.group for row in mine))
            for group in [*(groups if len(groups) > 1 else []), "all"]:
                numbers = [(r.warped, r.unwarped, r.explained, r.visible) for r in mine if group in ("all", r.group)]
                found.append(ViewSummary(protocol, predictor, group, len(numbers), *np.mean(numbers, axis=0).tolist()))
        return tuple(found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each predictor whose depth and motion explain the neighbors no better than doing nothing."""
        return tuple(
            f"'{view.predictor}' under {view.protocol}: warped ({view.warped:.4f}) is not below unwarped "
            f"({view.unwarped:.4f}), so nothing was learned"
            for view in self.view_summaries()
            if view.condition == "all" and not view.warped < view.unwarped
        )

    def joined(self, other: EvaluationResult) -> EvaluationResult:
        """Return both results as one: other protocols (another ground truth) or other predictors of the same images."""
        mine, theirs = ({(row.predictor, row.protocol) for row in result.rows} for result in (self, other))
        if both := sorted(mine & theirs):
            raise ConfigError(
                f"both results hold predictor '{both[0][0]}' under protocol '{both[0][1]}'; "
                "give one of them another name"
            )
        rules = {protocol.name: protocol for protocol in self.protocols}
        for protocol in other.protocols:
            if rules.setdefault(protocol.name, protocol) != protocol:
                raise ConfigError(f"the results mean different rules by protocol '{protocol.name}'; rename one of them")
            names = [{row.name for row in result.rows if row.protocol == protocol.name} for result in (self, other)]
            if all(names) and names[0] != names[1]:
                raise ConfigError(
                    f"the results under '{protocol.name}' come from {len(names[0])} and {len(names[1])} images that "
                    "are not the same; evaluate both on one split"
                )
        return EvaluationResult(
            tuple(rules.values()),
            tuple(dict.fromkeys((*self.predictors, *other.predictors))),
            (*self.rows, *other.rows),
            (*self.buckets, *other.buckets),
            (*self.views, *other.views),
            (*self.spreads, *other.spreads),
            (*self.comparisons, *other.comparisons),
            {**self.settings, **other.settings},
        )

    def tables(self, ranges: bool = False) -> list[Table]:
        """Return one table per protocol, then where the errors of the first predictor are, then comparisons."""
        found = []
        summaries, views = self.summaries(), self.view_summaries()
        for protocol in self.protocols:
            mine = [summary for summary in summaries if summary.protocol == protocol.name]
            found += [self._means(protocol, mine, ranges)] if mine else []
            seen = [view for view in views if view.protocol == protocol.name]
            found += [self._views(protocol, seen)] if seen else []
        for protocol in self.protocols:  # of the other predictors, the places of their errors are in the files
            rows = [row for row in self.buckets if (row.protocol, row.predictor) == (protocol.name, self.predictors[0])]
            found += [_bucket_table(rows)] if rows else []
        return found + [comparison.table() for comparison in self.comparisons]

    @property
    def table(self) -> Table:
        """The means under the first protocol."""
        return self.tables()[0]

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
        known = {(spread.predictor, spread.protocol): spread for spread in self.spreads}
        rows, notes = [], [_images_note(summaries[0])]
        for summary in summaries:
            rows.append(Row((summary.predictor, *summary.errors, f"{summary.scale:.3g} ± {summary.scale_std:.2g}")))
            spread = known.get((summary.predictor, summary.protocol))
            if spread is not None:
                ends = zip(spread.low, spread.high, strict=True)
                cells = [f"{low:.3f} to {high:.3f}" if ranges else f"±{(high - low) / 2:.3f}" for low, high in ends]
                rows.append(Row(("", *cells, ""), "dim"))
                notes[1:] = [f"{'range' if ranges else '±'}: {interval_note(spread)}"]
        columns = (Column("predictor"), *ERROR_COLUMNS, Column("scale"))
        return Table("metrics", f"{protocol.name}: {protocol.summary}", columns, tuple(rows), tuple(notes))

    def _views(self, protocol: Protocol, views: Sequence[ViewSummary]) -> Table:
        numbers = (("warped", -1), ("unwarped", 0), ("explained", 1), ("visible", 0))
        columns = (
            *(Column(heading) for heading in ("predictor", "condition")),
            *(Column(heading, ".4f", better) for heading, better in numbers),  # type: ignore[arg-type]
            Column("images"),
        )
        rows = [Row((v.predictor, v.condition, v.warped, v.unwarped, v.explained, v.visible, v.images)) for v in views]
        note = "photometric errors of neighbors, warped and as they are; fractions of pixels"
        title = f"{protocol.name}: {protocol.summary}"
        return Table("views", title, columns, tuple(rows), (note,), bold_best=False)


def summarize(rows: Iterable[ImageRow]) -> Summary:
    """Return the means of rows that share predictor and protocol."""
    rows = list(rows)
    keys = {(row.predictor, row.protocol) for row in rows}
    if len(keys) != 1:
        raise DataError(
            f"{len(rows)} rows of {len(keys)} predictors and protocols; a summary needs rows of exactly one"
        )
    ((predictor, protocol),) = keys
    scored = [row for row in rows if row.pixels]
    if not scored:
        return Summary(predictor, protocol, (math.nan,) * 7, math.nan, math.nan, 0, len(rows))
    errors = np.array([row.errors for row in scored]).mean(0)
    scales = np.array([row.scale for row in scored])
    moments = float(scales.mean()), float(scales.std())
    return Summary(predictor, protocol, tuple(errors.tolist()), *moments, len(scored), len(rows) - len(scored))


def interval_note(of: Spread | Comparison) -> str:
    """Return what intervals mean, such as ``95 % bootstrap over 28 drives``."""
    note = f"{of.level:.0%} bootstrap over {of.groups} {of.by}s".replace("%", " %")
    return note if of.by == "drive" else f"{note}, which are alike: too narrow"


def _images_note(summary: Summary) -> str:
    """Return how many images a summary stands for, such as ``697 images``, and how many had no ground truth."""
    note = f"{summary.images} image{'' if summary.images == 1 else 's'}"
    if summary.images_without_truth:
        note += f"; {summary.images_without_truth} more without a ground-truth pixel to compare, left out"
    return note


def _bucket_table(rows: Sequence[BucketRow]) -> Table:
    """Return one predictor's errors by distance, region and edges under one protocol."""
    columns = (Column("where"), *ERROR_COLUMNS, Column("pixels"))
    cells = tuple(Row((row.bucket, *row.errors, row.pixels), group=f"by {row.group}") for row in rows)
    title = f"{rows[0].protocol}: where the errors of '{rows[0].predictor}' are"
    return Table("buckets", title, columns, cells, ("over pixels, not images",), bold_best=False)
