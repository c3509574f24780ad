"""How sure a mean over images is, and whether two predictors really differ on the same images."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy import stats

from saunet.errors import DataError, in_range
from saunet.evaluation.result import Comparison, Difference, EvaluationResult, ImageRow, Spread
from saunet.metrics.functional import ERROR_NAMES, HIGHER_IS_BETTER

FEWEST_DRIVES = 5
"""With fewer drives than this, resampling them says nothing: images are resampled, and the result says so."""
RESAMPLES = 2000


def drive_of(name: str) -> str:
    """Return the drive in an image's name: all before the frame's number, such as ``2011_09_26/..._sync``."""
    return re.sub(r" \d+( [lr])?$", "", name)


def groups_of(names: Sequence[str]) -> tuple[str, int, list[str]]:
    """Choose what to resample: drives where there are `FEWEST_DRIVES`, else images."""
    drives = [drive_of(name) for name in names]
    count = len(set(drives))
    return ("drive", count, drives) if count >= FEWEST_DRIVES else ("image", len(names), list(names))


def spreads(result: EvaluationResult, level: float = 0.95, seed: int = 0) -> tuple[Spread, ...]:
    """Compute intervals of all means of a result that rest on at least two images."""
    found = []
    for protocol in result.protocols:
        for predictor in result.predictors:
            rows = [row for row in result.select(predictor, protocol.name) if row.pixels]
            if len(rows) < 2:
                continue
            by, count, groups = groups_of([row.name for row in rows])
            values = np.array([row.errors for row in rows], dtype=np.float64)
            low, high = bootstrap_mean(values, groups, level=level, seed=seed)
            spread = Spread(predictor, protocol.name, level, by, count, tuple(low.tolist()), tuple(high.tolist()))
            found.append(spread)
    return tuple(found)


def bootstrap_mean(
    values: Float64[ndarray, "n k"],
    groups: Sequence[str],
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> tuple[Float64[ndarray, " k"], Float64[ndarray, " k"]]:
    """Compute the bounds of a bootstrap interval of the mean of each column; NaN for fewer than two groups.

    Whole groups are resampled: neighboring frames of a drive are alike, so resampling images makes intervals too
    narrow. Percentiles of the resampled mean of few groups are too narrow as well: they see the spread over n, not over
    n - 1 degrees of freedom, and the tails of a normal distribution, not of Student's t (Hesterberg, What Teachers
    Should Know about the Bootstrap, The American Statistician 69, 2015). So both bounds are moved away from the mean by
    sqrt(n / (n - 1)) * t / z. BCa intervals correct for neither.

    Args:
        values: One row per image.
        groups: The group of each row.
        level: Fraction of intervals that should contain the true mean.
        resamples: How often to resample.
        seed: Of the resampling.

    Raises:
        ConfigError: if the level is not in (0, 1).
        DataError: if there is no row, or not one group for each.
    """
    in_range("level", level, 1e-6, 1 - 1e-6)
    sums, counts = _by_group(values, groups)
    number = len(sums)
    if number < 2:
        return np.full(values.shape[1], math.nan), np.full(values.shape[1], math.nan)

    def mean(of: ndarray, over: ndarray, axis: int) -> ndarray:
        ratio: ndarray = of.sum(axis) / over.sum(axis)
        return ratio

    found = stats.bootstrap(
        (sums.T, np.broadcast_to(counts, sums.T.shape)),
        mean,
        n_resamples=resamples,
        batch=max(1, 4_000_000 // sums.size),
        axis=-1,
        confidence_level=level,
        paired=True,
        method="percentile",
        random_state=np.random.default_rng(seed),
    ).confidence_interval
    tail = (1 + level) / 2
    wider = math.sqrt(number / (number - 1)) * stats.t.ppf(tail, number - 1) / stats.norm.ppf(tail)
    center = values.mean(0)
    return center + wider * (found.low - center), center + wider * (found.high - center)


def compare(
    first: Sequence[ImageRow],
    second: Sequence[ImageRow],
    *,
    names: tuple[str, str] = ("first", "second"),
    level: float = 0.95,
    seed: int = 0,
) -> Comparison:
    """Compare two predictors image by image, paired by name.

    Whole drives are resampled and flipped, since frames of a drive are alike. With fewer than `FEWEST_DRIVES` drives,
    images are resampled, intervals are too narrow, and there is no p value: frames that are alike would make chance
    look like proof.

    Args:
        first: Rows of one predictor under one protocol.
        second: Rows of the other under the same one, for the same images.
        names: What to call them.
        level: Of the intervals.
        seed: Of the resampling.

    Raises:
        ConfigError: if the level is not in (0, 1).
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
    low, high = (bound.tolist() for bound in bootstrap_mean(delta, groups, level=level, seed=seed))
    p_values = _sign_flip(_by_group(delta, groups)[0], seed) if by == "drive" else [None] * 7
    better = ((np.sign(delta) * np.where(HIGHER_IS_BETTER, 1.0, -1.0) + 1) / 2).mean(0).tolist()
    one_mean, other_mean, change = (array.mean(0).tolist() for array in (ours, theirs, delta))
    differences = tuple(
        Difference(name, one_mean[k], other_mean[k], change[k], low[k], high[k], better[k], p_values[k])
        for k, name in enumerate(ERROR_NAMES)
    )
    return Comparison(protocols[0], *names, len(images), level, by, count, differences)


def _sign_flip(sums: Float64[ndarray, "g k"], seed: int) -> list[float]:
    """Return two-sided p values of a permutation test that exchanges the predictors' labels within each group."""
    found = stats.permutation_test(
        (sums,),
        lambda x, axis: x.sum(axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=max(1, 4_000_000 // sums.size),
        axis=0,
        random_state=np.random.default_rng(seed),
    )
    p_values: list[float] = found.pvalue.tolist()
    return p_values


def _by_group(
    values: Float64[ndarray, "n k"], groups: Sequence[str]
) -> tuple[Float64[ndarray, "g k"], Float64[ndarray, " g"]]:
    """Sums and counts of each group."""
    if len(values) == 0 or len(groups) != len(values):
        raise DataError(f"{len(values)} rows with {len(groups)} groups; give at least one row, and a group for each")
    labels, index = np.unique(np.array(groups), return_inverse=True)
    sums = np.zeros((len(labels), values.shape[1]))
    np.add.at(sums, index, values)
    return sums, np.bincount(index).astype(np.float64)
