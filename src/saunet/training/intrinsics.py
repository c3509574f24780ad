"""Focal lengths learned together with the networks, one per recording (``model.intrinsics``)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.windows import recording_of
from saunet.errors import ConfigError
from saunet.geometry.camera import GUESS, zoom_intrinsics
from saunet.runs.record import Intrinsics

RATE = 10.0
"""A focal length's logarithm learns this much faster than a weight: with Adam up to 0.1 % per step at rate 1e-4."""
_TOLD = 8


class FocalLengths(nn.Module):
    """One factor on the focal lengths of K per recording, as Gordon et al. (2019) and slowtv learn intrinsics.

    The center and the ratio of fx to fy stay as given. A recording that was not trained on gets the mean of the others:
    their mean change if ``refined``, their mean focal length if ``learned``.

    Args:
        mode: ``refined`` starts from the given focal lengths, ``learned`` from `GUESS`.
        given: Recording -> fx and width of its pictures, in pixels.
    """

    start: Tensor
    given: Tensor

    def __init__(self, mode: str, given: Mapping[str, tuple[float, int]]) -> None:
        super().__init__()
        self.mode, self.widths = mode, {name: width for name, (_, width) in given.items()}
        self._places = {name: place for place, name in enumerate(given)}
        self._focals = {name: fx / width for name, (fx, width) in given.items()}
        logs = torch.tensor(list(self._focals.values()), dtype=torch.float64).log().float()
        self.register_buffer("given", logs, persistent=False)
        start = logs if mode == "refined" else torch.full_like(logs, math.log(GUESS))
        self.register_buffer("start", start, persistent=False)
        self.change = nn.Parameter(torch.zeros(len(given)))

    def forward(self, K: Float[Tensor, "b 3 3"], names: Sequence[str], width: int) -> Float[Tensor, "b 3 3"]:
        """Return the intrinsics of samples by their names, given those of the data; ``width`` is the images' width."""
        found = self.start + RATE * self.change
        factors = found - self.given
        places = [self._places.get(recording_of(name), -1) for name in names]
        if -1 in places:
            own = (K[:, 0, 0] / width).log()
            others = factors.mean().expand_as(own) if self.mode == "refined" else found.mean() - own
            factors = torch.cat((factors, others))
            places = [len(self._places) + at if place < 0 else place for at, place in enumerate(places)]
        return zoom_intrinsics(K, factors[torch.tensor(places, device=K.device)].exp())

    def found(self, change: Tensor) -> Intrinsics:
        """Return the focal lengths found, given the state of ``change``."""
        now = (self.start.to(change) + RATE * change.detach()).double().exp().tolist()
        return Intrinsics(
            self.mode, {name: (given, each) for (name, given), each in zip(self._focals.items(), now, strict=True)}
        )

    def told(self, found: Intrinsics) -> str:
        """Describe the focal lengths found, in pixels of the recordings."""
        lines = []
        for name, (given, now) in list(found.focals.items())[:_TOLD]:
            pixels, change = self.widths[name], now / given - 1
            lines.append(f"  '{name}': {given * pixels:.1f} -> {now * pixels:.1f} px ({change:+.1%})")
        if len(found.focals) > _TOLD:
            lines.append(f"  ... and {len(found.focals) - _TOLD} more in run.json")
        cameras: dict[float, list[float]] = {}
        for given, now in found.focals.values():
            cameras.setdefault(round(given, 4), []).append(math.log(now))
        spread = max(float(np.std(each)) for each in cameras.values())
        if spread:
            lines.append(f"  recordings with one given focal length differ by {spread:.1%} (standard deviation)")
        return "\n".join([f"focal lengths, given -> {found.mode}:", *lines])


def focal_lengths(mode: str, data: DepthDataModule) -> FocalLengths | None:
    """Return the module that learns the focal lengths of a data module that is set up; None if they are fixed.

    Raises:
        ConfigError: if there is no motion to learn them from.
    """
    if mode == "fixed":
        return None
    if not data.offsets:
        raise ConfigError(
            f"model.intrinsics={mode} needs neighbors in time, and data.offsets is empty: a stereo pair alone fits "
            "any focal length; set data.offsets=[-1,1], or model.intrinsics=fixed"
        )
    if data.track_motion:
        raise ConfigError(
            f"model.intrinsics={mode} and data.track_motion=true cannot be combined: tracking relies on the given K; "
            "leave one of them out"
        )
    given: dict[str, tuple[float, int]] = {}
    dataset = data.datasets["train"]
    for position in sorted({position for position, _ in dataset.windows}):
        drive = dataset.drives[position]
        first = drive.indices[0]
        width = drive.frame_size[1] if drive.frame_size else drive.image(first).shape[1]
        given[drive.name] = float(drive.intrinsics(first)[0, 0]), width
    return FocalLengths(mode, given)
