from __future__ import annotations

from tiny_depth import folder, network, picture, predictor  # noqa: F401 (fixtures)
