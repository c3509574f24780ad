"""saunet: self-supervised monocular depth, assembled from registered components.

Each command-line tool is an options class and a function here, such as `TrainOptions` and `train`. Names are imported
on first use, so ``import saunet`` stays fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from saunet.errors import CheckpointError, ConfigError, DataError, SaunetError, can_name, checked
from saunet.lazy import lazily
from saunet.registry import Spec, attentions, datamodules, decoders, encoders, objectives, poses, registry, terms
from saunet.weights.locate import DEFAULT, shipped

if TYPE_CHECKING:
    from saunet.data.drive import Drive
    from saunet.data.loading.module import DepthDataModule
    from saunet.evaluation import EvaluateOptions, OdometryOptions, evaluate, odometry
    from saunet.exporting.tool import ExportOptions, export
    from saunet.geometry.camera import crop_intrinsics, flip_intrinsics, scale_intrinsics
    from saunet.geometry.depth import disparity_to_depth, sigmoid_to_disparity
    from saunet.geometry.pose import invert_pose, pose_matrix
    from saunet.geometry.warp import backproject, project, synthesize
    from saunet.losses.functional import (
        automask,
        combine_sources,
        gradient_loss,
        photometric_error,
        smoothness_loss,
        ssim_loss,
    )
    from saunet.metrics.depth import DepthMetrics
    from saunet.models.depth import DepthNet
    from saunet.models.systems import ModelOptions
    from saunet.prediction.foreign import ForeignOptions
    from saunet.prediction.prediction import Prediction
    from saunet.prediction.predictor import Predictor
    from saunet.prediction.tool import PredictOptions, predict
    from saunet.reporting.run import Run
    from saunet.reporting.tool import ReportOptions, report
    from saunet.reporting.watch import WatchOptions, watch
    from saunet.tools.app.tool import AppOptions, app
    from saunet.tools.benchmark.tool import BenchmarkOptions, benchmark
    from saunet.tools.calibrate.tool import CalibrateOptions, calibrate
    from saunet.tools.doctor.tool import DoctorOptions, doctor, inspect
    from saunet.tools.prepare.tool import PrepareOptions, prepare
    from saunet.training.tool import TrainOptions, train

__version__ = "0.1.0"
__all__ = [
    "AppOptions", "BenchmarkOptions", "CalibrateOptions", "CheckpointError", "ConfigError", "DataError",
    "DepthDataModule", "DepthMetrics", "DepthNet", "DoctorOptions", "Drive", "EvaluateOptions", "ExportOptions",
    "ForeignOptions", "ModelOptions", "OdometryOptions", "PredictOptions", "Prediction", "Predictor", "PrepareOptions",
    "ReportOptions", "Run", "SaunetError", "Spec", "TrainOptions", "WatchOptions", "__version__", "app", "attentions",
    "automask",
    "available", "backproject", "benchmark", "build", "calibrate", "combine_sources", "crop_intrinsics", "datamodules",
    "decoders", "disparity_to_depth", "doctor", "encoders", "evaluate", "export", "flip_intrinsics", "gradient_loss",
    "inspect", "invert_pose", "load", "objectives", "odometry", "photometric_error", "pose_matrix", "poses", "predict",
    "prepare", "project", "report", "scale_intrinsics", "sigmoid_to_disparity", "smoothness_loss", "ssim_loss",
    "synthesize", "terms", "train", "watch",
]  # fmt: skip
__getattr__ = lazily(
    __name__,
    {
        "data.drive": "Drive",
        "data.loading.module": "DepthDataModule",
        "evaluation": "EvaluateOptions OdometryOptions evaluate odometry",
        "exporting.tool": "ExportOptions export",
        "geometry.camera": "crop_intrinsics flip_intrinsics scale_intrinsics",
        "geometry.depth": "disparity_to_depth sigmoid_to_disparity",
        "geometry.pose": "invert_pose pose_matrix",
        "geometry.warp": "backproject project synthesize",
        "losses.functional": "automask combine_sources gradient_loss photometric_error smoothness_loss ssim_loss",
        "metrics.depth": "DepthMetrics",
        "models.depth": "DepthNet",
        "models.systems": "ModelOptions",
        "prediction.foreign": "ForeignOptions",
        "prediction.prediction": "Prediction",
        "prediction.predictor": "Predictor",
        "prediction.tool": "PredictOptions predict",
        "reporting.run": "Run",
        "reporting.tool": "ReportOptions report",
        "reporting.watch": "WatchOptions watch",
        "tools.app.tool": "AppOptions app",
        "tools.benchmark.tool": "BenchmarkOptions benchmark",
        "tools.calibrate.tool": "CalibrateOptions calibrate",
        "tools.doctor.tool": "DoctorOptions doctor inspect",
        "tools.prepare.tool": "PrepareOptions prepare",
        "training.tool": "TrainOptions train",
    },
    functions=checked,
)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


@checked
def build(kind: str, name: str, /, **kwargs: Any) -> Any:
    """Build a registered component.

    Args:
        kind: ``"model"`` (depth and pose network together), ``"encoder"``, ``"decoder"``, ``"attention"``, ``"pose"``,
            ``"objective"``, ``"term"`` or ``"data"``.
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


@checked
def available(kind: str) -> list[str]:
    """Return the registered names of a kind, sorted.

    Args:
        kind: A kind that `build` accepts, or ``"weights"`` for the trained models that come with saunet.

    Returns:
        The names.

    Raises:
        ConfigError: for an unknown kind.

    Examples:
        >>> saunet.available("attention")
        ['cbam', 'eca', 'gct', 'none', 'se']
    """
    return shipped() if kind == "weights" else registry(kind).names()


@checked
def load(
    source: Any = DEFAULT,
    *,
    device: str = "cpu",
    flip: bool = False,
    keep_aspect: bool = False,
    foreign: ForeignOptions | None = None,
) -> Any:
    """Load a trained model for prediction: ``saunet.load("last.ckpt").predict(image)``.

    Args:
        source: A checkpoint, a folder or ``model.onnx`` written by ``saunet export``, the name of a model that comes
            with saunet (one of ``available("weights")``), a model on the Hugging Face hub
            (``hf://organization/name``), or a file or folder of Monodepth2, ManyDepth, Lite-Mono, SC-Depth, slowtv or
            packnet-sfm.
        device: Where to run, such as ``"cpu"`` or ``"cuda"``.
        flip: Average with the prediction of the mirrored image.
        keep_aspect: Keep each image's aspect ratio instead of the training's.
        foreign: Input and output of another system's ONNX or TorchScript model.

    Returns:
        A `saunet.prediction.Predictor`, or for ONNX a `saunet.exporting.onnx.OnnxPredictor`, which needs no torch.

    Raises:
        CheckpointError: if it is missing, broken, or not a model that saunet has.
        ConfigError: if a package is missing or the device does not exist.

    Examples:
        >>> model = saunet.load("last.ckpt")
        >>> image = np.zeros((96, 160, 3), np.uint8)  # height x width x RGB
        >>> model.predict(image).depth.shape
        (96, 160)
    """
    if not isinstance(source, str | Path) or not str(source) or not can_name(source, 255):
        got = f"a name of {len(str(source))} characters" if isinstance(source, str | Path) else type(source).__name__
        raise CheckpointError(f"saunet.load got {got}; give the path of a checkpoint or an exported folder")
    from saunet.prediction.prediction import load as load_any

    return load_any(source, device=device, flip=flip, keep_aspect=keep_aspect, foreign=foreign)
