"""Which numbers compare: those of the same images, protocol and settings; and one score a run to set side by side."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from saunet.runs.folder import Explained, Run, Score

SHOWN = 8
"""Digits of a fingerprint that a heading shows."""


class Groups:
    """Headings, alike for numbers that compare and unlike for all others.

    The fingerprint of the images is part of a heading only where it alone tells two groups apart.
    """

    def __init__(self, measured: Iterable[Score | Explained]) -> None:
        counts = Counter(words for words, _ in {(_words(one), one.fingerprint) for one in measured})
        self._ambiguous = {words for words, count in counts.items() if count > 1}

    def __call__(self, one: Score | Explained) -> str:
        words = _words(one)
        if words not in self._ambiguous:
            return words
        return f"{words} (sha256 {one.fingerprint[:SHOWN]})" if one.fingerprint else f"{words} (which, it does not say)"


def chosen(runs: Mapping[str, Run]) -> dict[str, Score]:
    """Return one score of each run that has any, so that as many as possible compare.

    Runs whose scores compare stand together, most of them first; at a draw, evaluations go before validations.
    """
    left = {name: [score for score in run.scores if not score.trivial] for name, run in runs.items()}
    found: dict[str, Score] = {}
    while any(left.values()):
        counts = Counter(key for scores in left.values() for key in dict.fromkeys(map(_key, scores)))
        best = max(counts, key=lambda key: (counts[key], not key[0]))
        for name, scores in left.items():
            if mine := [score for score in scores if _key(score) == best]:
                found[name], left[name] = mine[0], []
    return found


def comparable(runs: Mapping[str, Run]) -> dict[str, Score]:
    """Return the scores of the largest group of runs that compare: what one drawing may hold."""
    scores = chosen(runs)
    first = next((_key(score) for score in scores.values()), None)
    return {name: score for name, score in scores.items() if _key(score) == first}


def _key(score: Score) -> tuple[bool, str, str, int, str, str]:
    return score.validation, score.data, score.protocol, score.images, score.fingerprint, score.how


def _words(one: Score | Explained) -> str:
    where = ", ".join(filter(None, (one.data, one.how, f"protocol {one.protocol}")))
    if isinstance(one, Explained):
        return f"Measured: {where}"
    kind = "Measured while training, best epoch" if one.validation else "Measured"
    return f"{kind}: {where}, {one.images} image{'' if one.images == 1 else 's'}"
