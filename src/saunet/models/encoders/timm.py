"""Any network of timm that returns feature maps (extra ``timm``)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import CheckpointError, ConfigError, divisible, suggest
from saunet.models.pretrained import read_state
from saunet.registry import encoders
from saunet.types import FeatureSpec


@encoders.register("timm")
class TimmEncoder(nn.Module):
    """A network of timm with ``features_only``: its deepest map at each stride.

    Images come in [0, 1] and are normalized with the mean and deviation of the network's public weights. Needs the
    extra ``timm``: ``pip install 'saunet[timm]'``.

    Args:
        model: Name of the network in timm, such as ``convnext_tiny`` or ``efficientnet_b0``.
        weights: ``imagenet`` for the public weights, which timm downloads, or a file with the network's weights.
        image_size: Height and width of the images, for networks built for one size, such as Swin and ViT.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, model: str = "convnext_tiny", weights: str | None = None, image_size: Sequence[int] | None = None
    ) -> None:
        super().__init__()
        timm = _timm()
        if not timm.is_model(model):
            hint = suggest(model, timm.list_models()) or ";"
            raise ConfigError(
                f"model is '{model}', which timm {timm.__version__} does not have{hint} see timm.list_models()"
            )
        more: dict[str, Any] = {} if image_size is None else {"img_size": tuple(image_size)}
        if weights is not None:
            more["pretrained"] = True
        if weights not in (None, "imagenet"):
            more["pretrained_cfg_overlay"] = {"file": str(_existing(str(weights)))}
        try:
            self.network = timm.create_model(model, features_only=True, **more)
        except Exception as reason:  # timm's networks refuse in different ways
            text = " ".join(str(reason).split())[:300]
            if weights is not None:
                raise CheckpointError(
                    f"timm cannot load the weights '{weights}' into '{model}' ({text}); give a file for this network"
                ) from reason
            raise ConfigError(f"timm's '{model}' returns no feature maps ({type(reason).__name__}: {text})") from reason
        if weights not in (None, "imagenet"):
            self._check_complete(model, str(weights))
        info = self.network.feature_info
        strides = info.reduction()
        self.taken = tuple(sorted({stride: index for index, stride in enumerate(strides)}.values()))
        self.features = tuple(FeatureSpec(info.channels()[index], strides[index]) for index in self.taken)
        self.size_divisor = self.features[-1].stride
        self.image_size = None if image_size is None else tuple(image_size)
        self.channels_last = "NHWC" in str(getattr(self.network, "output_fmt", ""))
        config = timm.models.get_pretrained_cfg(model)
        for name, default in (("mean", (0.485, 0.456, 0.406)), ("std", (0.229, 0.224, 0.225))):
            values = getattr(config, name, None) or default
            self.register_buffer(name, torch.tensor(values).view(3, 1, 1), persistent=False)

    def _check_complete(self, model: str, weights: str) -> None:
        """Check that a file has every weight, because timm keeps initial values for missing ones."""

        def plain(name: str) -> str:  # timm uses _ instead of . in the names of feature networks
            return re.sub(r"[._]", "", name.removeprefix("model."))

        given = {plain(name) for name in read_state(_existing(weights))}
        missing = [name for name in self.network.state_dict() if plain(name) not in given]
        missing = [name for name in missing if not name.endswith("num_batches_tracked")]
        if missing:
            more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
            raise CheckpointError(f"{weights} is not a file of timm's '{model}': it lacks '{missing[0]}'{more}")

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        divisible(image.shape[-2], image.shape[-1], self.size_divisor)
        if self.image_size is not None and tuple(image.shape[-2:]) != self.image_size:
            size, wanted = ("x".join(map(str, each)) for each in (image.shape[-2:], self.image_size))
            raise ConfigError(
                f"the image is {size} but the encoder was built for {wanted}; set image_size to the size of the images"
            )
        maps = self.network((image - self.mean) / self.std)
        chosen = [maps[index] for index in self.taken]
        return tuple(each.permute(0, 3, 1, 2) if self.channels_last else each for each in chosen)


def _timm() -> Any:
    try:
        import timm
    except Exception as missing:  # importing a torchvision for another torch fails in many ways
        why = "is not installed" if isinstance(missing, ModuleNotFoundError) else f"cannot be imported ({missing})"
        raise ConfigError(
            f"model/encoder=timm needs the package timm, which {why}; run: pip install 'saunet[timm]'"
        ) from missing
    return timm


def _existing(weights: str) -> Path:
    path = Path(weights).expanduser()
    if not path.is_file():
        raise CheckpointError(f"weights is '{weights}', but there is no such file; give a file, or weights=imagenet")
    return path
