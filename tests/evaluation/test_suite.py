"""Protocols sorted by the truth they need; results without ground truth; comparisons with earlier files."""

from __future__ import annotations

import types

import pytest
import torch

from saunet.errors import ConfigError, DataError
from saunet.evaluation import evaluate_protocols, read_earlier, with_statistics, write_results
from saunet.evaluation.suite import passes
from saunet.evaluation.views import evaluate_views, summarize_views
from saunet.metrics.protocols import protocol


class Data:
    """Six images of three conditions with constant depth; remembers what was asked of it."""

    protocols = ("eigen_camera_z",)
    neighbors = ("train",)

    def __init__(self, kind="camera_z"):
        self.ground_truth, self.datasets, self.stages = kind, {}, []

    def setup(self, stage=None):
        self.stages.append(stage)
        drives = [types.SimpleNamespace(name=f"drive{i} l", condition=word) for i, word in enumerate("ab")]
        windows = [(i % 2, i) for i in range(6)]
        name = lambda place: f"drive{place % 2} {place:010d} l"
        self.datasets["test"] = Windows(drives, windows, name)

    def batches(self, split, device):
        for place in range(6):
            sources = 1 if split in self.neighbors else 0
            target = torch.rand(1, 3, 8, 16, generator=torch.Generator().manual_seed(place))
            yield {
                "target": target,
                "sources": target[:, None].expand(1, sources, 3, 8, 16),
                "K": torch.tensor([[[10.0, 0, 7.5], [0, 10, 3.5], [0, 0, 1]]]),
                "name": [self.datasets[split].name(place)],
                "depth": torch.full((1, 1, 40, 60), 10.0),
                "depth_size": torch.tensor([[40, 60]]),
            }


class Windows:
    def __init__(self, drives, windows, name):
        self.drives, self.windows, self.name = drives, windows, name

    def __len__(self):
        return len(self.windows)


def constant(batch):
    return torch.full((1, 1, 8, 16), 0.05)


def standing(batch):
    return torch.eye(4).expand(1, 1, 4, 4)


def run(names, made=None, **kwargs):
    made = [] if made is None else made

    def data_with(kind):
        made.append(Data(kind or "camera_z"))
        return made[-1]

    return evaluate_protocols(names, data_with, lambda data: {"m": constant}, progress=False, **kwargs)


def test_passes_use_the_own_truth_wherever_it_serves():
    names = ("metric", "eigen_lidar_x", "eigen_camera_z", "campus")
    found = passes([protocol(name) for name in names], "camera_z")
    assert {kind: [rules.name for rules in each] for kind, each in found.items()} == {
        "camera_z": ["metric", "eigen_camera_z"],
        "lidar_x": ["eigen_lidar_x"],
        "none": ["campus"],
    }
    assert list(passes([protocol("metric")], "exact")) == ["exact"]


def test_one_pass_for_each_truth_and_protocols_in_the_order_asked_for():
    made = []
    result = run(["eigen_lidar_x", "metric", "eigen_camera_z"], made)
    assert [rules.name for rules in result.protocols] == ["eigen_lidar_x", "metric", "eigen_camera_z"]
    assert [data.ground_truth for data in made] == ["camera_z", "lidar_x"]
    assert [data.stages for data in made] == [["test"], ["test"]]
    assert len(result.rows) == 18
    assert {s.protocol: round(s.errors[0], 6) for s in result.summaries()}["metric"] == 1.0


def test_no_name_is_the_own_protocol():
    assert [rules.name for rules in run([]).protocols] == ["eigen_camera_z"]


def test_without_truth_by_condition(tmp_path):
    result = run(["campus"], motion=standing)
    assert len(result.views) == 6
    for row in result.views:  # the neighbor is the image itself and the camera stands
        assert row.warped == pytest.approx(0, abs=1e-4)
        assert row.visible == 1.0
    assert [(group, images) for _, _, group, images, _ in summarize_views(result.views)] == [
        ("a", 3),
        ("b", 3),
        ("all", 6),
    ]
    files = write_results(result, tmp_path)
    assert files["views.csv"].read_text().count("\n") == 7
    assert "| m | b |" in files["metrics.md"].read_text()


def test_without_truth_and_without_motion():
    with pytest.raises(ConfigError, match="protocol 'campus' needs the motion of the camera"):
        run(["campus"])


def test_views_refuse_protocols_that_compare_depth():
    with pytest.raises(ConfigError, match=r"'metric' compares with 'camera_z'.*such as campus"):
        evaluate_views({}, [], protocol("metric"), group_of=str, progress=False)
    data = Data()
    data.setup("test")
    with pytest.raises(DataError, match="comes without neighboring frames"):
        evaluate_views(
            {"m": (constant, standing)}, data.batches("test", "cpu"), protocol("campus"), group_of=str, progress=False
        )


def test_statistics_and_the_earlier_run(tmp_path):
    result = run(["metric"])
    write_results(result, tmp_path)
    for earlier in (tmp_path, tmp_path / "per_image.csv"):
        found = with_statistics(result, 0.9, read_earlier(earlier))
        (comparison,) = found.comparisons
        assert (comparison.first, comparison.second, comparison.level) == (f"m of {earlier}", "m", 0.9)
        assert all(row.difference == 0 for row in comparison.differences)
    assert with_statistics(result, None).spreads == ()
    assert found.spreads[0].low[0] == pytest.approx(1.0)
    with pytest.raises(ConfigError, match=r"no protocol in common with this evaluation \(its protocols: metric\)"):
        with_statistics(run(["eigen_camera_z"]), 0.95, read_earlier(tmp_path))
