"""From a trained network to ONNX, torch.export and safetensors, each checked against the original."""

from __future__ import annotations

from typing import TYPE_CHECKING

from saunet.lazy import lazily

if TYPE_CHECKING:
    from saunet.exporting.tool import ExportOptions, ExportResult, export

__all__ = ["ExportOptions", "ExportResult", "export"]
__getattr__ = lazily(__name__, {"tool": "ExportOptions ExportResult export"})
