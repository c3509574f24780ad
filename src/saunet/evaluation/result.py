"""What an evaluation found: one row for each image, predictor and protocol, and their means."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from saunet.errors import ConfigError, DataError, one_of
from saunet.evaluation.breakdown import BucketRow
from saunet.fingerprint import fingerprint
from saunet.metrics.protocols import Protocol


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
    """In the order of `saunet.metrics.functional.ERROR_NAMES`."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Means of one predictor under one protocol over the images that have ground truth; NaN if none has."""

    predictor: str
    protocol: str
    errors: tuple[float, ...]
    """In the order of `saunet.metrics.functional.ERROR_NAMES`."""
    scale: float
    """Mean of median(truth)/median(prediction)."""
    scale_std: float
    """Its standard deviation over images."""
    images: int
    images_without_truth: int


@dataclass(frozen=True, slots=True)
class Spread:
    """How sure the means of one predictor under one protocol are: bootstrap intervals."""

    predictor: str
    protocol: str
    level: float
    """Share of resampled means inside."""
    by: str
    """What was resampled: whole ``drive``s, or single ``image``s where there are too few drives."""
    groups: int
    """How many of them there are."""
    low: tuple[float, ...]
    high: tuple[float, ...]
    """In the order of `saunet.metrics.functional.ERROR_NAMES`."""


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
    """Share of images on which the second is better, ties counted half."""
    p_value: float
    """Chance of a difference at least this large if the labels were exchanged at random (sign-flip test, two-sided)."""


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
    """The same without warping: what a network that has learnt nothing reaches."""
    explained: float
    """Share of pixels that warping brings closer, SAU-Net eq. (11)."""
    visible: float
    """Share of pixels that any neighbor sees."""


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
    """Differences to another run, where they were asked for."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """What else the numbers depend on, such as post-processing; plain data."""

    def select(self, predictor: str, protocol: str) -> tuple[ImageRow, ...]:
        """Return the rows of one predictor under one protocol, in the order they were computed.

        Raises:
            ConfigError: if the result holds no such predictor or protocol.
        """
        one_of("predictor", predictor, self.predictors)
        one_of("protocol", protocol, [rules.name for rules in self.protocols])
        return tuple(row for row in self.rows if row.predictor == predictor and row.protocol == protocol)

    def errors(self, predictor: str, protocol: str) -> NDArray[np.float64]:
        """Return the errors of the images that have ground truth, images x 7.

        Raises:
            ConfigError: if the result holds no such predictor or protocol.
        """
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

    def joined(self, other: EvaluationResult) -> EvaluationResult:
        """Return both results as one: other protocols (another ground truth) or other predictors of the same images.

        Raises:
            ConfigError: if both give rows for the same predictor and protocol, protocols of one name differ, or the
                images do.
        """
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
        predictors = tuple(dict.fromkeys((*self.predictors, *other.predictors)))
        return EvaluationResult(
            tuple(rules.values()),
            predictors,
            (*self.rows, *other.rows),
            (*self.buckets, *other.buckets),
            (*self.views, *other.views),
            (*self.spreads, *other.spreads),
            (*self.comparisons, *other.comparisons),
            {**self.settings, **other.settings},
        )


def summarize(rows: Iterable[ImageRow]) -> Summary:
    """Return the means of rows that share predictor and protocol.

    Raises:
        DataError: if there are no rows or they do not share both.
    """
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
    return Summary(
        predictor,
        protocol,
        tuple(errors.tolist()),
        float(scales.mean()),
        float(scales.std()),
        len(scored),
        len(rows) - len(scored),
    )
