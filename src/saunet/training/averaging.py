"""A moving average of the weights: smoother than any single step's, so it is what is validated and saved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn


class WeightAverage:
    """Exponential moving average of a model's parameters and buffers.

    The first steps weigh more than ``decay`` says, so that the fresh weights are soon forgotten: after n steps the
    decay is at most (1 + n) / (10 + n). What is no floating-point number (a counter) is copied.

    Args:
        model: Whose weights.
        decay: Weight of the average so far, 0 to 1.
        start: Where the average stands, by name; at the model's weights if None.
    """

    def __init__(self, model: nn.Module, decay: float, start: Mapping[str, Tensor] | None = None) -> None:
        self.model, self.decay = model, decay
        self.values = {name: live.detach().clone() for name, live in self._live()}
        for name, value in (start or {}).items():
            if name in self.values:
                self.values[name].copy_(value)
        self._aside: dict[str, Tensor] | None = None

    @torch.no_grad()
    def update(self, steps: int) -> None:
        """Move the average towards the weights, after so many steps."""
        decay = min(self.decay, (1 + steps) / (10 + steps))
        pairs = [(self.values[name], live) for name, live in self._live()]
        moving = [(average, live) for average, live in pairs if average.is_floating_point()]
        torch._foreach_lerp_([average for average, _ in moving], [live.detach() for _, live in moving], 1 - decay)
        for average, live in pairs:
            if not average.is_floating_point():
                average.copy_(live)

    def training_weights(self) -> dict[str, Tensor]:
        """Return the weights that are trained, also while the average stands in for them."""
        return dict(self._aside) if self._aside is not None else {name: live.detach() for name, live in self._live()}

    @torch.no_grad()
    def put_in(self) -> None:
        """Give the model the average, until `put_back`."""
        self._aside = {name: live.detach().clone() for name, live in self._live()}
        for name, live in self._live():
            live.copy_(self.values[name])

    @torch.no_grad()
    def put_back(self) -> None:
        """Give the model its own weights again."""
        aside, self._aside = self._aside, None
        for name, live in self._live() if aside else ():
            live.copy_(aside[name])  # type: ignore[index]

    def _live(self) -> Iterator[tuple[str, Tensor]]:
        yield from self.model.named_parameters()
        wanted = self.model.state_dict().keys()  # buffers that are constants are in no checkpoint
        yield from ((name, buffer) for name, buffer in self.model.named_buffers() if name in wanted)
