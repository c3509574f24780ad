"""Loss terms, and objectives as their weighted sums."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, positive
from saunet.registry import terms as registered_terms
from saunet.types import DepthPyramid, LossTerms, TrainBatch, View


@dataclass(frozen=True, slots=True)
class TermResult:
    """One term's contribution, before its weight."""

    value: Float[Tensor, ""]
    maps: Mapping[str, Tensor] = field(default_factory=dict)
    """Detached full-resolution pictures for the log (b 1 h w)."""


class Term(nn.Module):
    """A part of the objective: register a subclass with ``@terms.register("name")`` and name it in the config.

    The parameters of ``__init__`` are its config keys. `forward` averages over scales itself, never waits for the
    device, and returns 0 with a graph if nothing can be compared.
    """

    needs_source_depth: bool = False
    """Whether the batch must have ``source_depth``, the depth network's prediction for the sources."""
    can_be_empty: bool = True
    """Whether there may be nothing to compare (all masked, nothing measured), with a value of 0; False for a prior on
    the prediction alone."""

    def __init__(self) -> None:
        super().__init__()

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> TermResult:
        """Return the term's value for one batch.

        Args:
            batch: Images and intrinsics; ``loss_target`` and ``loss_sources`` are compared.
            pyramid: The predicted depth of the target, one map per scale.
            poses: The predicted motion T_src_tgt.
            views: The sources resampled into the target camera, one view per scale, all at full resolution.
        """
        raise NotImplementedError(f"{type(self).__name__} has no forward")


class Objective(nn.Module):
    """A weighted sum of terms: sum(weight * value).

    Args:
        terms: Name -> term; the names appear in the log.
        weights: Name -> weight, at least 0. A term of weight 0 is left out and costs nothing.
        extra: Name -> mapping of ``weight``, optionally ``term`` (a registered name, by default the name itself, or a
            `Term`), and the parameters of that term: ``{"smoothness": {"weight": 0.001}}``. On the command line:
            ``+objective.extra.smoothness.weight=0.001``.
    """

    def __init__(self, terms: Mapping[str, Term], weights: Mapping[str, float], extra: Mapping[str, Any]) -> None:
        super().__init__()
        terms, weights = dict(terms), dict(weights)
        for name, settings in extra.items():
            if name in terms:
                raise ConfigError(
                    f"extra term '{name}' has the name of one of the objective's own terms ({', '.join(terms)}); "
                    f"give it another name and set term: {name}"
                )
            terms[name], weights[name] = _extra_term(name, settings)
        for name, weight in weights.items():
            positive(f"the weight of loss term '{name}'", float(weight), allow_zero=True)
        self.weights = {name: float(weight) for name, weight in weights.items() if weight > 0}
        if not self.weights:
            raise ConfigError(f"all loss weights are 0 ({', '.join(weights)}); set at least one above 0")
        self.terms = nn.ModuleDict({name: terms[name] for name in self.weights})
        self.needs_source_depth = any(terms[name].needs_source_depth for name in self.weights)
        """Whether a term compares depth between frames, so that the training step adds ``batch["source_depth"]``."""

    def forward(
        self, batch: TrainBatch, pyramid: DepthPyramid, poses: Float[Tensor, "b s 4 4"], views: Sequence[View]
    ) -> LossTerms:
        """Return the weighted sum, each term before its weight, and the terms' maps; arguments as for `Term`."""
        results: dict[str, TermResult] = {name: term(batch, pyramid, poses, views) for name, term in self.terms.items()}
        weighted = [self.weights[name] * result.value for name, result in results.items()]
        return LossTerms(
            total=sum(weighted[1:], start=weighted[0]),
            values={name: result.value for name, result in results.items()},
            maps={key: value for result in results.values() for key, value in result.maps.items()},
        )


def require(batch: TrainBatch, key: str, term: str, fix: str) -> Float[Tensor, "..."]:
    """Return ``batch[key]``, or raise an error with the term that needs it and what to do."""
    if key not in batch:
        raise ConfigError(f"{term} needs '{key}' in the batch, which the data do not provide; {fix}")
    value: Tensor = batch[key]  # type: ignore[literal-required]
    return value


def _extra_term(name: str, settings: Any) -> tuple[Term, float]:
    example = f"for instance {name}: {{weight: 0.1}}"
    if not isinstance(settings, Mapping):
        raise ConfigError(f"extra term '{name}' is {settings!r}; it must be a mapping with a weight, {example}")
    options = dict(settings)
    if "weight" not in options:
        raise ConfigError(f"extra term '{name}' has no weight; give it one, {example}")
    weight, term = options.pop("weight"), options.pop("term", name)
    if isinstance(weight, bool) or not isinstance(weight, int | float):
        raise ConfigError(f"extra term '{name}' has the weight {weight!r}; it must be a number, {example}")
    if not isinstance(term, nn.Module):
        return registered_terms.build(str(term), **options), float(weight)
    if options:
        raise ConfigError(
            f"extra term '{name}' is already built, so {', '.join(options)} cannot be set; allowed: weight"
        )
    return term, float(weight)  # type: ignore[return-value]
