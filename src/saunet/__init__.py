"""saunet: self-supervised monocular depth, assembled from registered components.

Each tool of the command line is an options class and a function here: `TrainOptions` and `train`. Names are
imported when they are first used, so ``import saunet`` stays cheap.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saunet.errors import CheckpointError, ConfigError, DataError, SaunetError
from saunet.registry import Spec, attentions, datamodules, decoders, encoders, objectives, poses, registry, terms
from saunet.weights.locate import DEFAULT, shipped

if TYPE_CHECKING:
    from saunet.data.drive import Drive as Drive
    from saunet.data.loading.module import DepthDataModule as DepthDataModule
    from saunet.evaluation import EvaluateOptions as EvaluateOptions
    from saunet.evaluation import OdometryOptions as OdometryOptions
    from saunet.evaluation import evaluate as evaluate
    from saunet.evaluation import odometry as odometry
    from saunet.exporting.tool import ExportOptions as ExportOptions
    from saunet.exporting.tool import export as export
    from saunet.geometry.camera import crop_intrinsics as crop_intrinsics
    from saunet.geometry.camera import flip_intrinsics as flip_intrinsics
    from saunet.geometry.camera import scale_intrinsics as scale_intrinsics
    from saunet.geometry.depth import disparity_to_depth as disparity_to_depth
    from saunet.geometry.depth import sigmoid_to_disparity as sigmoid_to_disparity
    from saunet.geometry.pose import invert_pose as invert_pose
    from saunet.geometry.pose import pose_matrix as pose_matrix
    from saunet.geometry.warp import backproject as backproject
    from saunet.geometry.warp import project as project
    from saunet.geometry.warp import synthesize as synthesize
    from saunet.losses.functional import automask as automask
    from saunet.losses.functional import combine_sources as combine_sources
    from saunet.losses.functional import gradient_loss as gradient_loss
    from saunet.losses.functional import photometric_error as photometric_error
    from saunet.losses.functional import smoothness_loss as smoothness_loss
    from saunet.losses.functional import ssim_loss as ssim_loss
    from saunet.metrics.depth import DepthMetrics as DepthMetrics
    from saunet.models.depth import DepthNet as DepthNet
    from saunet.prediction.prediction import Prediction as Prediction
    from saunet.prediction.predictor import Predictor as Predictor
    from saunet.prediction.tool import PredictOptions as PredictOptions
    from saunet.prediction.tool import predict as predict
    from saunet.reporting.tool import ReportOptions as ReportOptions
    from saunet.reporting.tool import report as report
    from saunet.tools.benchmark.tool import BenchmarkOptions as BenchmarkOptions
    from saunet.tools.benchmark.tool import benchmark as benchmark
    from saunet.tools.calibrate.tool import CalibrateOptions as CalibrateOptions
    from saunet.tools.calibrate.tool import calibrate as calibrate
    from saunet.tools.doctor.tool import DoctorOptions as DoctorOptions
    from saunet.tools.doctor.tool import doctor as doctor
    from saunet.tools.prepare.tool import PrepareOptions as PrepareOptions
    from saunet.tools.prepare.tool import prepare as prepare
    from saunet.training.tool import ModelOptions as ModelOptions
    from saunet.training.tool import TrainOptions as TrainOptions
    from saunet.training.tool import train as train

__version__ = "0.1.0"

_LAZY = {
    "BenchmarkOptions": "tools.benchmark.tool",
    "CalibrateOptions": "tools.calibrate.tool",
    "DepthDataModule": "data.loading.module",
    "DepthMetrics": "metrics.depth",
    "DepthNet": "models.depth",
    "DoctorOptions": "tools.doctor.tool",
    "Drive": "data.drive",
    "EvaluateOptions": "evaluation.tool",
    "ExportOptions": "exporting.tool",
    "ModelOptions": "training.tool",
    "OdometryOptions": "evaluation.tool_odometry",
    "PredictOptions": "prediction.tool",
    "Prediction": "prediction.prediction",
    "Predictor": "prediction.predictor",
    "PrepareOptions": "tools.prepare.tool",
    "ReportOptions": "reporting.tool",
    "TrainOptions": "training.tool",
    "automask": "losses.functional",
    "backproject": "geometry.warp",
    "benchmark": "tools.benchmark.tool",
    "calibrate": "tools.calibrate.tool",
    "combine_sources": "losses.functional",
    "crop_intrinsics": "geometry.camera",
    "disparity_to_depth": "geometry.depth",
    "doctor": "tools.doctor.tool",
    "evaluate": "evaluation.tool",
    "export": "exporting.tool",
    "flip_intrinsics": "geometry.camera",
    "gradient_loss": "losses.functional",
    "invert_pose": "geometry.pose",
    "odometry": "evaluation.tool_odometry",
    "photometric_error": "losses.functional",
    "pose_matrix": "geometry.pose",
    "predict": "prediction.tool",
    "prepare": "tools.prepare.tool",
    "project": "geometry.warp",
    "report": "reporting.tool",
    "scale_intrinsics": "geometry.camera",
    "sigmoid_to_disparity": "geometry.depth",
    "smoothness_loss": "losses.functional",
    "ssim_loss": "losses.functional",
    "synthesize": "geometry.warp",
    "train": "training.tool",
}
"""Name -> the module that it is imported from when it is first used."""
__all__ = [
    "CheckpointError",
    "ConfigError",
    "DataError",
    "SaunetError",
    "Spec",
    "__version__",
    "attentions",
    "available",
    "build",
    "datamodules",
    "decoders",
    "encoders",
    "load",
    "objectives",
    "poses",
    "terms",
    *_LAZY,
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'saunet' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"saunet.{_LAZY[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


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

    Examples:
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

    Examples:
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

    Examples:
        >>> model = saunet.load("last.ckpt")
        >>> image = np.zeros((96, 160, 3), np.uint8)  # height x width x RGB
        >>> model.predict(image).depth.shape
        (96, 160)
    """
    if not isinstance(source, str | Path) or not str(source):
        raise CheckpointError(f"saunet.load got {source!r}; give the path of a checkpoint or an exported folder")
    from saunet.prediction.load import load as load_any

    return load_any(source, device=device, flip=flip, keep_aspect=keep_aspect)
