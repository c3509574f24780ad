"""saunet: self-supervised monocular depth, assembled from registered components."""

from __future__ import annotations

from typing import Any

from saunet.registry import registry

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
    """
    return registry(kind).build(name, **kwargs)


def available(kind: str) -> list[str]:
    """Return the registered names of a kind, sorted.

    Raises:
        ConfigError: for an unknown kind.
    """
    return registry(kind).names()


def load(path: Any, *, device: str = "cpu") -> Any:
    """Load a trained model for prediction: ``saunet.load("last.ckpt").predict(image)``.

    Args:
        path: A checkpoint written by ``saunet-train``.
        device: Where to run, such as ``"cpu"`` or ``"cuda"``.

    Returns:
        A `saunet.infer.Predictor`.

    Raises:
        CheckpointError: if the file is missing, broken, or not a saunet checkpoint.
    """
    from saunet.infer.predictor import Predictor

    return Predictor.from_checkpoint(path, device=device)
