"""How sure a mean over images is, and whether two predictors really differ on the same images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from saunet.errors import DataError, in_range, positive
from saunet.evaluation.result import Comparison, Difference, EvaluationResult, ImageRow, Spread
from saunet.metrics.functional import ERROR_NAMES, HIGHER_IS_BETTER


@dataclass(frozen=True, slots=True)
class Interval:
    """Bounds of means, one for each column."""

    low: Float64[ndarray, " k"]
    high: Float64[ndarray, " k"]


FEWEST_DRIVES = 5
"""With fewer drives than this, resampling them says nothing: images are resampled, and the result says so."""


def drive_of(name: str) -> str:
    """Return the drive in an image's name: all before the frame's number, such as ``2011_09_26/..._sync``."""
    return re.sub(r" \d+( [lr])?$", "", name)


def groups_of(names: Sequence[str]) -> tuple[str, int, list[str] | None]:
    """Choose what to resample for these images: drives where there are `FEWEST_DRIVES`, else images.

    Returns:
        ``drive`` or ``image``, how many there are, and the group of each image (None for images).
    """
    drives = [drive_of(name) for name in names]
    count = len(set(drives))
    return ("drive", count, drives) if count >= FEWEST_DRIVES else ("image", len(names), None)


def spreads(result: EvaluationResult, level: float = 0.95, resamples: int = 2000, seed: int = 0) -> tuple[Spread, ...]:
    """Compute bootstrap intervals of all means of a result that rest on at least one image.

    Args:
        result: The evaluation.
        level: Share of resampled means inside each interval.
        resamples: How often to resample.
        seed: Of the resampling.

    Raises:
        ConfigError: as `bootstrap_mean`.
    """
    found = []
    for protocol in result.protocols:
        for predictor in result.predictors:
            rows = [row for row in result.select(predictor, protocol.name) if row.pixels]
            if not rows:
                continue
            by, count, groups = groups_of([row.name for row in rows])
            values = np.array([row.errors for row in rows], dtype=np.float64)
            interval = bootstrap_mean(values, groups, level=level, resamples=resamples, seed=seed)
            low, high = tuple(interval.low.tolist()), tuple(interval.high.tolist())
            found.append(Spread(predictor, protocol.name, level, by, count, low, high))
    return tuple(found)


def bootstrap_mean(
    values: Float64[ndarray, "n k"],
    groups: Sequence[str] | None = None,
    *,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Compute a percentile-bootstrap interval of the mean of each column.

    Neighboring frames of a drive are alike, so resampling images makes intervals too narrow: give the drives as
    ``groups`` and whole drives are resampled.

    Args:
        values: One row an image.
        groups: The group of each row; each row by itself by default.
        level: Share of resampled means inside the interval.
        resamples: How often to resample.
        seed: Of the resampling.

    Raises:
        ConfigError: if the level is not in (0, 1) or there are no resamples.
        DataError: if there is no row, or not one group for each.
    """
    in_range("level", level, 1e-6, 1 - 1e-6)
    positive("resamples", resamples)
    sums, counts = _by_group(values, groups)
    draws = np.random.default_rng(seed).multinomial(len(sums), np.full(len(sums), 1 / len(sums)), size=resamples)
    means = (draws @ sums) / (draws @ counts)[:, None]
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return Interval(low, high)


def compare(
    first: Sequence[ImageRow],
    second: Sequence[ImageRow],
    *,
    names: tuple[str, str] = ("first", "second"),
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Compare two predictors image by image, paired by name.

    Whole drives are resampled and flipped, since frames of a drive are alike; single images where there are fewer than
    `FEWEST_DRIVES` drives, and then intervals are too narrow.

    Args:
        first: Rows of one predictor under one protocol.
        second: Rows of the other under the same one, for the same images.
        names: What to call them.
        level: Of the intervals.
        resamples: How often to resample and to flip.
        seed: Of both.

    Raises:
        ConfigError: as `bootstrap_mean`.
        DataError: if the images or protocols are not the same, a name occurs twice, or none has ground truth.
    """
    one, other = ({row.name: row for row in rows} for rows in (first, second))
    if one.keys() != other.keys() or len(one) != len(first) or len(other) != len(second):
        alone = sorted(one.keys() ^ other.keys())
        hint = f"'{alone[0]}' is only in one of them" if alone else "a name occurs twice"
        raise DataError(
            f"{len(first)} and {len(second)} rows do not pair up: {hint}; compare results on the same images"
        )
    protocols = sorted({row.protocol for row in (*first, *second)})
    if len(protocols) != 1:
        raise DataError(f"the rows come from protocols {', '.join(protocols) or 'without a row'}; compare under one")
    images = [name for name, row in one.items() if row.pixels and other[name].pixels]
    ours, theirs = (
        np.array([rows[name].errors for name in images], dtype=np.float64).reshape(-1, 7) for rows in (one, other)
    )
    delta = theirs - ours
    by, count, groups = groups_of(images)
    interval = bootstrap_mean(delta, groups, level=level, resamples=resamples, seed=seed)
    p_values = _sign_flip(delta, groups, resamples, seed)
    upwards = np.where(HIGHER_IS_BETTER, 1.0, -1.0)
    better = ((np.sign(delta) * upwards + 1) / 2).mean(0)
    differences = tuple(
        Difference(
            name,
            float(ours[:, k].mean()),
            float(theirs[:, k].mean()),
            float(delta[:, k].mean()),
            float(interval.low[k]),
            float(interval.high[k]),
            float(better[k]),
            float(p_values[k]),
        )
        for k, name in enumerate(ERROR_NAMES)
    )
    return Comparison(protocols[0], *names, len(images), level, by, count, differences)


def _sign_flip(
    delta: Float64[ndarray, "n k"], groups: Sequence[str] | None, resamples: int, seed: int
) -> Float64[ndarray, " k"]:
    sums, _ = _by_group(delta, groups)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(resamples, len(sums)))
    observed = np.abs(sums.sum(0))
    extreme = (np.abs(signs @ sums) >= observed * (1 - 1e-12)).sum(0)
    p_values: ndarray = (extreme + 1) / (resamples + 1)
    return p_values


def _by_group(
    values: Float64[ndarray, "n k"], groups: Sequence[str] | None
) -> tuple[Float64[ndarray, "g k"], Float64[ndarray, " g"]]:
    """Sums and counts of each group."""
    if len(values) == 0 or (groups is not None and len(groups) != len(values)):
        count = "no" if groups is None else str(len(groups))
        raise DataError(f"{len(values)} rows with {count} groups; give at least one row, and a group for each")
    if groups is None:
        return values, np.ones(len(values))
    labels, index = np.unique(np.array(groups), return_inverse=True)
    sums = np.zeros((len(labels), values.shape[1]))
    np.add.at(sums, index, values)
    return sums, np.bincount(index).astype(np.float64)
