"""`evaluate`: protocols sorted by the truth they need; results without ground truth; comparisons with earlier files."""

from __future__ import annotations

import dataclasses
import inspect
import types
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
import torch

from saunet.errors import ConfigError, DataError
from saunet.evaluation import EvaluateOptions, evaluate, write_results
from saunet.evaluation.files import read_rows
from saunet.evaluation.scoring import score_views
from saunet.evaluation.statistics import with_statistics
from saunet.evaluation.tool import _tracked, evaluate_network, passes
from saunet.metrics.baselines import ConstantDepth
from saunet.metrics.protocols import protocol
from saunet.registry import Spec
from saunet.synthetic import SyntheticDrive


class Data:
    """Six images of three conditions with constant depth; remembers what was asked of it."""

    protocols = ("eigen_camera_z",)
    protocol = "eigen_camera_z"
    neighbors = ("train",)

    def __init__(self, kind="camera_z"):
        self.ground_truth, self.datasets, self.stages = kind, {}, []

    def setup(self, stage=None):
        self.stages.append(stage)
        drives = [types.SimpleNamespace(name=f"drive{i} l", condition=word) for i, word in enumerate("ab")]
        windows = [(i % 2, i) for i in range(6)]
        name = lambda place: f"drive{place % 2} {place:010d} l"
        self.datasets["test"] = Windows(drives, windows, name)

    def listed(self, split):
        return [self.datasets[split].name(place) for place in range(6)]

    def ground_truths(self, split):
        raise DataError("the training drives have no depth")

    def batches(self, split, device, place=None):
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


def standing(batch, depth):
    return torch.eye(4).expand(1, 1, 4, 4)


@dataclasses.dataclass(frozen=True)
class Made(Spec):
    """Describes `Data`, and remembers what was made."""

    made: ClassVar[list[Data]] = []

    def build(self, **changes):
        self.made.append(Data(changes.get("depth", "camera_z")))
        return self.made[-1]

    def changed(self, **changes):
        return self

    @property
    def parameters(self):
        truth = inspect.Parameter("depth", inspect.Parameter.KEYWORD_ONLY, annotation=TRUTHS)
        return {"depth": truth}


TRUTHS = Literal["camera_z", "lidar_x"]


@pytest.fixture
def options(tmp_path):
    np.save(tmp_path / "disps.npy", np.full((6, 8, 16), 0.05, np.float32))
    Made.made.clear()
    return lambda **changes: EvaluateOptions(
        **{"data": Made({}), "predictions": str(tmp_path / "disps.npy"), "baselines": False, **changes}
    )


def test_passes_use_the_own_truth_wherever_it_serves():
    names = ("metric", "eigen_lidar_x", "eigen_camera_z", "campus")
    found = passes([protocol(name) for name in names], "camera_z")
    assert {kind: [rules.name for rules in each] for kind, each in found.items()} == {
        "camera_z": ["metric", "eigen_camera_z"],
        "lidar_x": ["eigen_lidar_x"],
        "none": ["campus"],
    }
    assert list(passes([protocol("metric")], "exact")) == ["exact"]


def test_one_pass_for_each_truth_and_protocols_in_the_order_asked_for(options):
    result = evaluate(options(protocols=("eigen_lidar_x", "metric", "eigen_camera_z")))
    assert [rules.name for rules in result.protocols] == ["eigen_lidar_x", "metric", "eigen_camera_z"]
    assert [data.ground_truth for data in Made.made] == ["camera_z", "lidar_x"]
    assert [data.stages for data in Made.made] == [["test"], ["test"]]
    assert len(result.rows) == 18
    assert {s.protocol: round(s.errors[0], 6) for s in result.summaries()}["metric"] == 1.0


def test_no_name_is_the_own_protocol_and_nothing_is_written_without_a_folder(options, tmp_path):
    result = evaluate(options())
    assert [rules.name for rules in result.protocols] == ["eigen_camera_z"]
    assert [path.name for path in tmp_path.iterdir()] == ["disps.npy"]


def test_baselines_stand_beside_and_say_what_they_lack(options, capsys):
    result = evaluate(options(baselines=True))
    assert result.predictors == ("predictions", "constant depth")
    assert "no mean-depth baseline: the training drives have no depth" in capsys.readouterr().err
    assert evaluate_network(ConstantDepthNetwork(), Data()).predictors == ("model", "constant depth")


class ConstantDepthNetwork(ConstantDepth):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))


def test_without_truth_by_condition(tmp_path):
    data = Data()
    data.neighbors = ("test",)
    data.setup("test")
    group_of = {name: name[5] for name in data.listed("test")}
    batches = data.batches("test", "cpu")
    letters = {"0": "a", "1": "b"}
    result = score_views(
        {"m": (constant, standing)},
        batches,
        protocol("campus"),
        group_of=lambda name: letters[group_of[name]],
        progress=False,
    )
    assert len(result.views) == 6
    for row in result.views:  # the neighbor is the image itself and the camera stands
        assert row.warped == pytest.approx(0, abs=1e-4)
        assert row.visible == 1.0
    assert [(view.condition, view.images) for view in result.view_summaries()] == [("a", 3), ("b", 3), ("all", 6)]
    files = write_results(result, tmp_path)
    assert files["views.csv"].read_text().count("\n") == 7
    assert "| m | b |" in files["metrics.md"].read_text()
    assert "nothing was learned" in result.warnings[0]  # the neighbors are the image itself: unwarped is 0 too


def test_without_truth_and_without_motion(options):
    with pytest.raises(ConfigError, match="protocol 'campus' needs the motion of the camera"):
        evaluate(options(protocols=("campus",)))


def test_the_motion_of_tracked_points_is_the_true_one_and_where_there_are_none_an_image_is_left_out(tmp_path):
    drive = SyntheticDrive(seed=5, frames=4, height=160, width=512)

    def sample(frame, near, image=drive.image):
        pictures = torch.from_numpy(np.stack([image(each) for each in (frame, *near)])).permute(0, 3, 1, 2) / 255
        K = torch.from_numpy(drive.intrinsics(frame)).float()[None]
        return {"target": pictures[:1], "sources": pictures[None, 1:], "K": K, "name": [f"clip {frame:010d}"]}

    truth = {each: torch.from_numpy(drive.depth(each))[None, None] for each in (1, 2)}
    frame_of = lambda batch: int(batch["name"][0].split()[1])
    depth = lambda batch: 1 / truth[frame_of(batch)].where(truth[frame_of(batch)] > 0, 1000.0)

    def true(batch, _):
        center = frame_of(batch)
        poses = [np.linalg.inv(drive.pose(near)) @ drive.pose(center) for near in (center - 1, center + 1)]
        return torch.from_numpy(np.stack(poses)).float()[None]

    batches = [sample(1, (0, 2)), sample(2, (1, 3)), sample(2, (1, 3), lambda _: np.full((160, 512, 3), 99, np.uint8))]
    batches[2]["name"] = ["fog 0000000002"]
    pairs = {"tracked": (depth, _tracked), "true": (depth, true)}
    rules = {"protocol": protocol("campus"), "group_of": lambda name: name.split()[0], "progress": False}
    result = score_views(pairs, batches, **rules)
    found = {(row.predictor, row.name): row for row in result.views}
    for name in ("clip 0000000001", "clip 0000000002"):
        ours, theirs = found["tracked", name], found["true", name]
        assert ours.unwarped > 2 * theirs.warped
        assert ours.warped == pytest.approx(theirs.warped, rel=0.05)
        assert ours.explained == pytest.approx(theirs.explained, abs=0.02)
    assert np.isnan(found["tracked", "fog 0000000002"].warped)
    views = {(view.predictor, view.condition): view.images for view in result.view_summaries()}
    assert views["tracked", "all"] == 2
    assert ("tracked", "fog") not in views
    assert views["true", "all"] == 3
    (kept,) = [row for row in read_rows(write_results(result, tmp_path)["views.csv"].parent) if np.isnan(row.warped)]
    assert kept.compared == {}  # it does not take part in a comparison
    with pytest.raises(DataError, match="motion is unknown for all 1 images: too few points"):
        score_views({"m": (depth, _tracked)}, batches[2:], **rules)


def test_views_refuse_protocols_that_compare_depth():
    with pytest.raises(ConfigError, match=r"'metric' compares with 'camera_z'.*such as campus"):
        score_views({}, [], protocol("metric"), group_of=str, progress=False)
    data = Data()
    data.setup("test")
    with pytest.raises(DataError, match="comes without neighboring frames"):
        score_views(
            {"m": (constant, standing)}, data.batches("test", "cpu"), protocol("campus"), group_of=str, progress=False
        )


def test_statistics_and_the_earlier_run(options, tmp_path):
    folder = tmp_path / "first"
    result = evaluate(options(protocols=("metric",), output_dir=folder))
    assert result.folder == folder
    for earlier in (folder, folder / "per_image.csv"):
        found = evaluate(options(protocols=("metric",), compare=str(earlier), intervals=0.9))
        (comparison,) = found.comparisons
        names = (f"predictions of {earlier}", "predictions", 0.9)
        assert (comparison.first, comparison.second, comparison.level) == names
        assert all(row.difference == 0 for row in comparison.differences)
    assert found.spreads[0].low[0] == pytest.approx(1.0)
    assert with_statistics(found, None).spreads == ()
    with pytest.raises(ConfigError, match=r"no protocol in common with this evaluation \(its protocols: metric\)"):
        evaluate(options(compare=str(folder), output_dir=str(tmp_path / "second")))
    assert (tmp_path / "second" / "metrics.json").is_file()  # what was computed is not lost


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"checkpoint": "x.ckpt"}, "both are set"),
        ({"predictions": None}, "neither is set"),
        ({"flip": True}, "leave it out with predictions"),
        ({"protocols": ("eigen_lidar",)}, "did you mean 'eigen_lidar_x'"),
        ({"protocols": ("synthetic",)}, "'exact' ground truth, but these data give camera_z or lidar_x"),
        ({"intervals": 95.0}, "intervals is 95"),
        ({"split": "train"}, "split is 'train'"),
        ({"match": "nam"}, "match is 'nam'"),
        ({"motion": "points"}, "motion is 'points'.*auto, tracked"),
        ({"predicted": "depths"}, "predicted is 'depths'"),
        ({"distances": (5.0,)}, "at least two limits"),
    ],
)
def test_what_cannot_be_evaluated(options, changes, words):
    with pytest.raises(ConfigError, match=words):
        evaluate(options(**changes))


def test_missing_predictions_are_found_before_anything_is_read(options):
    with pytest.raises(DataError, match="no predictions at"):
        evaluate(options(predictions="nowhere"))
    assert Path("nowhere").exists() is False
    assert Made.made == [] or Made.made[-1].stages == []
