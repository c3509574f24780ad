"""saunet: self-supervised monocular depth, assembled from registered components."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from saunet.errors import CheckpointError
from saunet.registry import registry
from saunet.weights.locate import DEFAULT, shipped

__version__ = "0.1.0"
__all__ = ["__version__", "available", "build", "load"]


def build(kind: str, name: str, /, **kwargs: Any) -> Any:
    """Build a registered component.

    Args:
        kind: ``"encoder"``, ``"decoder"``, ``"attention"``, ``"pose"``, ``"objective"``, ``"term"`` or ``"data"``.
        name: A name from ``available(kind)``.
        **kwargs: Parameters that differ from the component's defaults.

    Returns:
        The component, ready to use.

    Raises:
        ConfigError: for an unknown kind, name or parameter.

    Example:
        >>> encoder = saunet.build("encoder", "resnet18")
        >>> [feature.channels for feature in encoder.features]
        [64, 64, 128, 256, 512]
    """
    return registry(kind).build(name, **kwargs)


def available(kind: str) -> list[str]:
    """Return the registered names of a kind, sorted.

    Args:
        kind: What `build` takes, or ``"weights"`` for the trained models that come with saunet.

    Returns:
        The names.

    Raises:
        ConfigError: for an unknown kind.

    Example:
        >>> saunet.available("attention")
        ['cbam', 'eca', 'gct', 'none', 'se']
    """
    return shipped() if kind == "weights" else registry(kind).names()


def load(source: Any = DEFAULT, *, device: str = "cpu", flip: bool = False, keep_aspect: bool = False) -> Any:
    """Load a trained model for prediction: ``saunet.load("last.ckpt").predict(image)``.

    Args:
        source: A checkpoint, a folder or ``model.onnx`` written by ``saunet export``, the name of a model that comes
            with saunet (one of ``available("weights")``), or a model on the Hugging Face hub
            (``hf://organization/name``).
        device: Where to run, such as ``"cpu"`` or ``"cuda"``.
        flip: Average with the prediction of the mirrored image.
        keep_aspect: Feed each image at its own aspect ratio.

    Returns:
        A `saunet.prediction.Predictor`, or for ONNX a `saunet.exporting.onnx.OnnxPredictor`, which does without torch.

    Raises:
        CheckpointError: if it is missing, broken, or not a saunet model.
        ConfigError: if a package is missing or the device does not exist.

    Example:
        >>> model = saunet.load("last.ckpt")
        >>> image = np.zeros((96, 160, 3), np.uint8)  # height x width x RGB
        >>> model.predict(image).depth.shape
        (96, 160)
    """
    if not isinstance(source, str | Path) or not str(source):
        raise CheckpointError(f"saunet.load got {source!r}; give the path of a checkpoint or an exported folder")
    from saunet.prediction.load import load as load_any

    return load_any(source, device=device, flip=flip, keep_aspect=keep_aspect)
