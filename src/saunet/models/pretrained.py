"""Public ImageNet weights for encoders, with an account of what was loaded, resampled and left as it was."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from saunet.errors import CheckpointError
from saunet.models.pretrained_files import PUBLIC_WEIGHTS, locate, read_state
from saunet.models.pretrained_keys import resample_bias_table, tile_frames, to_our_names

log = logging.getLogger(__name__)

_FIRST_LAYERS = ("conv1.weight", "conv_stem.weight")
"""Weights that see the image itself, and several frames of it in a pose network: ResNet's and EfficientNet-Lite's."""


@dataclass(frozen=True, slots=True)
class LoadReport:
    """What became of a module's parameters and of a file's weights."""

    source: str
    """The file."""
    loaded: tuple[str, ...]
    """The module's entries that were taken over as they are."""
    resampled: tuple[str, ...]
    """Entries that were taken over after resampling, such as bias tables of another window."""
    random: tuple[str, ...]
    """Entries that the file has nothing for; they keep their initial values."""
    unused: tuple[str, ...]
    """What the file has and the module has no place for."""

    def __str__(self) -> str:
        lines = [f"{self.source}: {len(self.loaded)} entries loaded"]
        for word, names in (("resampled", self.resampled), ("left random", self.random), ("unused", self.unused)):
            if names:
                lines.append(f"  {len(names)} {word}: {_summary(names)}")
        return "\n".join(lines)


def load_pretrained(module: nn.Module, weights: str, *, allow_partial: bool = False) -> LoadReport:
    """Give an encoder public weights.

    Names may be those of torchvision, timm, the original Swin repository, its dense backbone, OpenMMLab, Monodepth2 or
    EfficientNet-PyTorch, or our own: of a saunet checkpoint the depth encoder is taken.
    Bias tables are resampled when the window differs, and a first layer for several frames gets the weights of one,
    repeated and divided. An encoder names in ``not_pretrained`` the parts that no public file has; they may stay.

    Args:
        module: The encoder.
        weights: ``"imagenet"`` (the usual file for this encoder), a name of `PUBLIC_WEIGHTS`, a URL, or a local file.
        allow_partial: Accept a file that fits only in part; the report says in which.

    Returns:
        What was loaded, resampled and left random; also logged.

    Raises:
        CheckpointError: for a file that cannot be found, fetched, read or verified, or that fits only in part. The
            module is then unchanged.
    """
    path = locate(_usual_name(module) if weights == "imagenet" else weights)
    own = module.state_dict()
    optional: tuple[str, ...] = getattr(module, "not_pretrained", ())
    found = to_our_names(read_state(path))
    fitting: dict[str, Tensor] = {}
    resampled: list[str] = []
    misfits: dict[str, str] = {}
    for name, value in found.items():
        if name not in own:
            continue
        fitted = _fit(name, value, own[name])
        if fitted is None:
            misfits[name] = f"{name} is {_shape(value)}, the network's {_shape(own[name])}"
            continue
        fitting[name] = fitted
        if fitted.shape != value.shape:
            resampled.append(name)
    random = [name for name in own if name not in fitting]
    unused = [name for name in found if name not in own]
    excused = {name for name in random if name.startswith(optional) or name.endswith("num_batches_tracked")}
    missing = [name for name in random if name not in excused and name not in misfits]
    surplus = [name for name in unused if not (optional and name.startswith("patch_embed."))]
    if not fitting:
        raise CheckpointError(f"{path} holds no weights of this {type(module).__name__}; its first are {_first(found)}")
    if (missing or misfits or surplus) and not allow_partial:
        raise CheckpointError(
            f"{path} fits this {type(module).__name__} only in part: {_why(list(misfits.values()), missing, surplus)}"
        )
    module.load_state_dict(fitting, strict=False)
    report = LoadReport(
        source=str(path),
        loaded=tuple(name for name in fitting if name not in resampled),
        resampled=tuple(resampled),
        random=tuple(random),
        unused=tuple(unused),
    )
    log.info("%s", report)
    return report


def _usual_name(module: nn.Module) -> str:
    variant: str | None = getattr(module, "variant", None)
    if variant not in PUBLIC_WEIGHTS:
        raise CheckpointError(
            f"there are no public ImageNet weights for this {type(module).__name__}; "
            f"public names: {', '.join(PUBLIC_WEIGHTS)}"
        )
    return variant


def _fit(name: str, value: Tensor, own: Tensor) -> Tensor | None:
    """Return ``value`` in the shape of ``own``, or None where that has no meaning."""
    if value.shape == own.shape:
        return value
    if name.endswith("relative_position_bias_table") and value.shape[1:] == own.shape[1:]:
        square = len(value) > 0 and math.isqrt(len(value)) ** 2 == len(value)
        return resample_bias_table(value, len(own)) if square else None
    frames_fit = value.ndim == own.ndim == 4 and value.shape[1] > 0 and own.shape[1] % value.shape[1] == 0
    if name in _FIRST_LAYERS and frames_fit:
        stacked = tile_frames(value, own.shape[1] // value.shape[1])
        return stacked if stacked.shape == own.shape else None
    return None


def _why(misfits: list[str], missing: list[str], surplus: list[str]) -> str:
    reasons = []
    if misfits:
        reasons.append(f"{misfits[0]}" + (f" (and {len(misfits) - 1} more)" if len(misfits) > 1 else ""))
    if missing:
        reasons.append(f"nothing for {_summary(missing)}")
    if surplus:
        reasons.append(f"no place for {_summary(surplus)}")
    return "; ".join(reasons) + "; give weights of the same architecture, or load_pretrained(..., allow_partial=True)"


def _summary(names: list[str] | tuple[str, ...]) -> str:
    """Shorten names to their module: ``layers.2.blocks.7 (12), stem.conv (2)``."""
    groups = Counter(".".join(name.split(".")[: 4 if ".blocks." in name else 2]) for name in names)
    shown = [f"{group} ({count})" if count > 1 else group for group, count in list(groups.items())[:6]]
    return ", ".join(shown) + (", ..." if len(groups) > 6 else "")


def _first(found: Mapping[str, Tensor]) -> str:
    return ", ".join(list(found)[:3])


def _shape(value: Tensor) -> str:
    return "x".join(str(side) for side in value.shape) or "scalar"
