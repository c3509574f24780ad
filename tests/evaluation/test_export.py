"""Exported PNGs are meters x 256 at the original size, and score like what they were made from."""

from __future__ import annotations

import numpy as np
import torch

from saunet.evaluation import evaluate
from saunet.evaluation.export import ExportingPredictor
from saunet.evaluation.foreign import ForeignFolder
from saunet.io.images import read_depth
from saunet.metrics.protocols import protocol


def batch():
    generator = torch.Generator().manual_seed(0)
    depth = torch.rand(3, 1, 24, 40, generator=generator) * 60 + 2
    depth[2] = 0
    return {
        "target": torch.zeros(3, 3, 8, 16),
        "name": ["day/a 0 l", "day/b 1 l", "day/c 2 l"],
        "depth": depth,
        "depth_size": torch.tensor([[24, 40], [20, 36], [24, 40]]),
    }


def disparity(batch):
    return torch.rand(3, 1, 8, 16, generator=torch.Generator().manual_seed(1)) * 0.2 + 0.02


def test_scaled_by_the_median_at_native_size_and_only_where_there_is_truth(tmp_path):
    rules = protocol("eigen_improved")
    exporting = ExportingPredictor(disparity, tmp_path, rules)
    first = evaluate({"m": exporting}, [batch()], [rules], ground_truth="improved", progress=False)
    assert exporting.written == 2
    assert str(exporting).startswith("export: 2 images as 'eigen_improved' scales them, 1 left out that have no ground")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["day_a_0_l.png", "day_b_1_l.png"]
    assert read_depth(tmp_path / "day_b_1_l.png").shape == (20, 36)
    for place in range(2):
        one = {key: value[place : place + 1] for key, value in batch().items()}
        again = evaluate({"m": ForeignFolder(tmp_path)}, [one], [rules], ground_truth="improved", progress=False)
        np.testing.assert_allclose(again.rows[0].errors, first.rows[place].errors, rtol=5e-3, atol=2e-3)
        assert abs(again.rows[0].scale - 1) < 1e-3


def test_meters_as_predicted_also_without_truth(tmp_path):
    without = {key: value for key, value in batch().items() if not key.startswith("depth")}
    ExportingPredictor(lambda _: torch.full((3, 1, 8, 16), 0.1), tmp_path, protocol("metric"))(without)
    stored = read_depth(tmp_path / "day_c_2_l.png")
    assert stored.shape == (8, 16)
    assert np.unique(stored).tolist() == [10.0]
