"""Scoring without ground truth: how well depth and motion explain the neighboring frames, by condition."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, DataError
from saunet.evaluation.result import EvaluationResult, ViewRow
from saunet.evaluation.runner import Predictor
from saunet.geometry.depth import disparity_to_depth
from saunet.geometry.warp import synthesize
from saunet.io.progress import bar
from saunet.losses.functional import automask, combine_sources, photometric_error
from saunet.metrics.protocols import Protocol
from saunet.types import EvalBatch

Motion: TypeAlias = Callable[[EvalBatch], Tensor]
"""Gives ``T_src_tgt`` of a batch's sources, b x s x 4 x 4, at the scale of the predicted depth."""


class PoseNetwork:
    """A pose network as something that `evaluate_views` can call; put into evaluation mode.

    Args:
        network: Called with target and sources, as in `saunet.models.poses`.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network = network.eval()

    @torch.inference_mode()
    def __call__(self, batch: EvalBatch) -> Tensor:
        """Return ``T_src_tgt`` of the batch's sources, b s 4 4."""
        motion: Tensor = self.network(batch["target"], batch["sources"])
        return motion


@torch.inference_mode()
def evaluate_views(
    predictors: Mapping[str, tuple[Predictor, Motion]],
    batches: Iterable[EvalBatch],
    protocol: Protocol,
    *,
    group_of: Callable[[str], str],
    total: int | None = None,
    progress: bool = True,
) -> EvaluationResult:
    """Warp the neighbors of each image into it by predicted depth and motion, and compare.

    A small error does not prove good depth (a flat wall is explained by any), but a model that does not beat the
    neighbors as they are has learnt nothing, and conditions that are worse than others show.

    Args:
        predictors: Depth and motion by the name that tables show; both at one scale.
        batches: Images with neighbors.
        protocol: One that needs no ground truth.
        group_of: The condition or the recording of an image, by its name.
        total: Number of images, for the progress bar.
        progress: Show a progress bar on a terminal or in a notebook.

    Raises:
        ConfigError: if the protocol needs ground truth.
        DataError: if there is no image, or a batch comes without neighbors.
    """
    if protocol.ground_truth != "none":
        raise ConfigError(
            f"protocol '{protocol.name}' compares with '{protocol.ground_truth}' ground truth; "
            "score it with `evaluate`, or choose one that needs none, such as campus"
        )
    rows: list[ViewRow] = []
    with bar(progress, "images", taken=True) as shown:
        task = shown.add_task(protocol.name, total=total)
        for batch in batches:
            if batch["sources"].shape[1] == 0:
                raise DataError(f"image '{batch['name'][0]}' comes without neighboring frames to compare with")
            for name, (depth, motion) in predictors.items():
                rows += _score(name, depth(batch), motion(batch), batch, protocol, group_of)
            shown.advance(task, len(batch["name"]))
    if not rows:
        raise DataError("there is no image to evaluate; check the split and the data root")
    return EvaluationResult((protocol,), tuple(predictors), (), views=tuple(rows))


def _score(
    name: str,
    disparity: Float[Tensor, "b 1 h w"],
    T_src_tgt: Float[Tensor, "b s 4 4"],
    batch: EvalBatch,
    protocol: Protocol,
    group_of: Callable[[str], str],
) -> list[ViewRow]:
    depth = disparity_to_depth(disparity.float().clamp(min=1e-6))
    view = synthesize(batch["sources"], depth, batch["K"], T_src_tgt)
    target = batch["target"][:, None]
    warped, seen = combine_sources(photometric_error(view.image, target), view.valid)
    # Compared over the same pixels, or leaving out the hard ones would look like progress.
    unwarped, _ = combine_sources(photometric_error(batch["sources"], target))
    explained = automask(warped, unwarped) & seen
    pixels = seen.flatten(1).sum(1).clamp(min=1)
    columns = [
        (torch.where(seen, warped, 0.0).flatten(1).sum(1) / pixels).tolist(),
        (torch.where(seen, unwarped, 0.0).flatten(1).sum(1) / pixels).tolist(),
        (explained.flatten(1).sum(1) / pixels).tolist(),
        seen.flatten(1).float().mean(1).tolist(),
    ]
    return [
        ViewRow(name, protocol.name, image, group_of(image), *values)
        for image, *values in zip(batch["name"], *columns, strict=True)
    ]


def summarize_views(rows: Sequence[ViewRow]) -> list[tuple[str, str, str, int, tuple[float, float, float, float]]]:
    """Return (protocol, predictor, group, images, means of the four numbers), groups first and then ``all``."""
    found = []
    for protocol, predictor in dict.fromkeys((row.protocol, row.predictor) for row in rows):
        mine = [row for row in rows if (row.protocol, row.predictor) == (protocol, predictor)]
        groups = list(dict.fromkeys(row.group for row in mine))
        for group in [*(groups if len(groups) > 1 else []), "all"]:
            numbers = [(r.warped, r.unwarped, r.explained, r.visible) for r in mine if group in ("all", r.group)]
            a, b, c, d = np.mean(numbers, axis=0).tolist()
            found.append((protocol, predictor, group, len(numbers), (a, b, c, d)))
    return found
