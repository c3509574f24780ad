"""The uncertainty of a mean over images, and whether two predictors really differ on the same images."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy import stats

from saunet.data.loading.windows import recording_of
from saunet.errors import ConfigError, DataError
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.rows import COMPARED, Comparison, Difference, ImageRow, Spread, ViewRow

FEWEST_DRIVES = 5
"""With fewer drives than this, resampling them is meaningless: images are resampled, and the result says so."""
RESAMPLES = 2000


def groups_of(names: Sequence[str]) -> tuple[str, int, list[str]]:
    """Choose what to resample: drives if there are at least `FEWEST_DRIVES`, else images."""
    drives = [recording_of(name, with_side=False) for name in names]
    count = len(set(drives))
    return ("drive", count, drives) if count >= FEWEST_DRIVES else ("image", len(names), list(names))


def spreads(result: EvaluationResult, level: float = 0.95) -> tuple[Spread, ...]:
    """Compute intervals of all means of a result over at least two images."""
    found = []
    for protocol, predictor in itertools.product(result.protocols, result.predictors):
        values = result.errors(predictor, protocol.name)
        if len(values) > 1:
            rows = result.select(predictor, protocol.name)
            by, count, groups = groups_of([row.name for row in rows if row.pixels])
            low, high = (tuple(each.tolist()) for each in bootstrap_mean(values, groups, level=level))
            found.append(Spread(predictor, protocol.name, level, by, count, low, high))
    return tuple(found)


def bootstrap_mean(
    values: Float64[ndarray, "n k"],
    groups: Sequence[str],
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> tuple[Float64[ndarray, " k"], Float64[ndarray, " k"]]:
    """Compute the bounds of a bootstrap interval of the mean of each column; NaN for fewer than two groups of rows.

    Whole groups are resampled: neighboring frames of a drive are similar, so resampling images makes intervals too
    narrow. With few groups, percentiles of the resampled mean are too narrow as well: they reflect the spread over n,
    not over n - 1 degrees of freedom, and the tails of a normal distribution, not of Student's t (Hesterberg, What
    Teachers Should Know about the Bootstrap, The American Statistician 69, 2015). So both bounds are moved away from
    the mean by the factor sqrt(n / (n - 1)) * t / z. BCa intervals correct for neither.
    """
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


def with_statistics(
    result: EvaluationResult,
    level: float | None,
    earlier: Sequence[ImageRow | ViewRow] | None = None,
    source: str | None = None,
) -> EvaluationResult:
    """Add bootstrap intervals of the means, and the changes since another evaluation of the same images.

    The first predictors of both are compared under each protocol that both have. If the level is None, the means have
    no intervals, and comparisons use 0.95.
    """
    comparisons = []
    if earlier is not None:
        who = earlier[0].predictor if earlier else ""
        names = (f"{who} of {source}", result.predictors[0])
        everything: Sequence[ImageRow | ViewRow] = (*result.rows, *result.views)
        for rules in result.protocols:
            rows = [row for row in earlier if (row.predictor, row.protocol) == (who, rules.name)]
            mine = (result.predictors[0], rules.name)
            now = [row for row in everything if (row.predictor, row.protocol) == mine]
            if rows and now:
                comparisons.append(compare(rows, now, names=names, level=level or 0.95))
        if not comparisons:
            there = ", ".join(dict.fromkeys(row.protocol for row in earlier)) or "none"
            raise ConfigError(
                f"'{source}' has no protocol in common with this evaluation (its protocols: {there}); "
                "evaluate both under the same one"
            )
    return replace(result, spreads=spreads(result, level) if level else (), comparisons=tuple(comparisons))


def compare(
    first: Sequence[ImageRow | ViewRow],
    second: Sequence[ImageRow | ViewRow],
    *,
    names: tuple[str, str] = ("first", "second"),
    level: float = 0.95,
) -> Comparison:
    """Compare two predictors image by image, paired by name.

    Whole drives are resampled and flipped, because frames of a drive are similar. With fewer than `FEWEST_DRIVES`
    drives, images are resampled, intervals are too narrow, and there is no p value: similar frames would make chance
    look like proof.
    """
    one, other = ({row.name: row for row in rows} for rows in (first, second))
    if one.keys() != other.keys() or len(one) != len(first) or len(other) != len(second):
        alone = sorted(one.keys() ^ other.keys())
        hint = f"'{alone[0]}' is only in one of them" if alone else "a name occurs twice"
        raise DataError(
            f"{len(first)} and {len(second)} rows cannot be paired: {hint}; compare results on the same images"
        )
    protocols = sorted({row.protocol for row in (*first, *second)})
    if len(protocols) != 1:
        raise DataError(
            f"the rows come from protocols {', '.join(protocols) or 'without a row'}; compare under one protocol"
        )
    pairs = {name: (row.compared, other[name].compared) for name, row in one.items()}
    pairs = {name: pair for name, pair in pairs.items() if all(pair)}
    if not pairs:
        raise DataError("0 rows were measured in both; compare results with ground truth on the same images")
    values = np.array([[[*found.values()] for found in pair] for pair in pairs.values()], dtype=np.float64)
    ours, theirs = values[:, 0], values[:, 1]
    delta = theirs - ours
    by, count, groups = groups_of(list(pairs))
    low, high = (bound.tolist() for bound in bootstrap_mean(delta, groups, level=level))
    what = list(next(iter(pairs.values()))[0])
    p_values = _sign_flip(_by_group(delta, groups)[0]) if by == "drive" else [None] * len(what)
    better = ((np.sign(delta) * [COMPARED[name].better for name in what] + 1) / 2).mean(0).tolist()
    means = (array.mean(0).tolist() for array in (ours, theirs, delta))
    differences = itertools.starmap(Difference, zip(what, *means, low, high, better, p_values, strict=True))
    return Comparison(protocols[0], *names, len(pairs), level, by, count, tuple(differences))


def _sign_flip(sums: Float64[ndarray, "g k"]) -> list[float]:
    """Return two-sided p values of a permutation test that swaps the predictors' labels within each group."""
    found = stats.permutation_test(
        (sums,),
        lambda x, axis: x.sum(axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=max(1, 4_000_000 // sums.size),
        axis=0,
        random_state=np.random.default_rng(0),
    )
    p_values: list[float] = found.pvalue.tolist()
    return p_values


def _by_group(
    values: Float64[ndarray, "n k"], groups: Sequence[str]
) -> tuple[Float64[ndarray, "g k"], Float64[ndarray, " g"]]:
    if len(values) == 0 or len(groups) != len(values):
        raise DataError(f"{len(values)} rows with {len(groups)} groups; give at least one row, and a group for each")
    labels, index = np.unique(np.array(groups), return_inverse=True)
    sums = np.zeros((len(labels), values.shape[1]))
    np.add.at(sums, index, values)
    return sums, np.bincount(index).astype(np.float64)
