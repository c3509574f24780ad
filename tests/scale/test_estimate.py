"""From frames to one factor: what is reported, what is refused, and folders, videos and tables as input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from saunet.errors import ConfigError, DataError
from saunet.geometry.pose import pose_matrix
from saunet.io.speeds import read_speeds
from saunet.runs.record import Scale
from saunet.scale import MetricDepth, MetricMotion, ScaleEstimate, estimate_scale
from saunet.scale.recorded import clip_batches
from saunet.types import DepthPyramid


def speed_batches(*distances: float) -> list[Any]:
    empty = torch.zeros(1, 1, 3, 4, 4)
    return [
        {"name": [f"frame {i}"], "target": empty[:, 0], "sources": empty, "distance": torch.tensor([[distance]])}
        for i, distance in enumerate(distances)
    ]


def one_meter(target: torch.Tensor, sources: torch.Tensor) -> torch.Tensor:
    return pose_matrix(torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0.0, 1.0]]]))


def no_depth(image: torch.Tensor) -> torch.Tensor:
    raise AssertionError("speed needs no depth")


def test_one_factor_is_the_median_with_its_spread() -> None:
    estimate = estimate_scale("speed", speed_batches(2.0, 3.0, 10.0, float("nan"), 4.0, 3.5), no_depth, one_meter)
    assert estimate.factor == 3.5
    assert estimate.quartiles == (3.0, 4.0)
    assert estimate.left_out == 1
    assert estimate.names == ("frame 0", "frame 1", "frame 2", "frame 4", "frame 5")
    assert estimate.spread == pytest.approx(np.std([2, 3, 10, 4, 3.5]) / 3.5)
    assert estimate.scale() == Scale(3.5, "speed")
    assert str(estimate).startswith("scale 3.5 from speed: median of 5 frames (1 more could not be measured)")
    assert "middle half 3 to 4, std/median 80.8 %" in str(estimate)
    plain = json.loads(json.dumps(estimate.as_json()))
    assert plain["per_frame"]["frame 2"] == 10.0
    assert plain["iqr"] == 1.0
    assert plain["frames"] == 5


def test_metric_depth_divides_disparity() -> None:
    class Two(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> DepthPyramid:
            disparity = torch.full((1, 1, 4, 4), 2.0)
            return DepthPyramid(sigmoid=(disparity,), disparity=(disparity,), depth=(1 / disparity,))

    torch.testing.assert_close(
        MetricDepth(Two(), Scale(4.0, "speed"))(torch.zeros(1, 3, 4, 4)), torch.full((1, 1, 4, 4), 0.5)
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "sped"}, r"scale.method is 'sped'; did you mean 'speed'"),
        ({"method": "camera_height"}, r"needs scale.camera_height, the meters from the road up to the camera"),
        ({"method": "camera_height", "camera_height": -1.0}, r"scale.camera_height is -1.0; it must be greater than 0"),
        ({"method": "speed"}, r"scale.method=speed needs a pose network, .*does not have"),
    ],
)
def test_what_a_method_needs(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        estimate_scale(batches=[], depth=no_depth, **options)
    assert "\n" not in str(raised.value)


def test_nothing_measured_is_one_sentence() -> None:
    with pytest.raises(DataError, match="cannot be measured by speed: none of the 2 frames has a known speed"):
        estimate_scale("speed", speed_batches(0.0, float("nan")), no_depth, one_meter)


def test_an_estimate_is_plain() -> None:
    estimate = ScaleEstimate("speed", "speed", ("a",), (2.0,))
    assert estimate.quartiles == (2.0, 2.0)
    assert estimate.spread == 0


# --- clips -----------------------------------------------------------------------------------------------------------


def frames(count: int) -> list[Any]:
    return [np.full((6, 8, 3), number, np.uint8) for number in range(count)]


def test_windows_of_a_clip() -> None:
    batches = list(clip_batches(frames(5), 3, 4, offsets=(1, -1), distance=lambda a, b: 10.0 * a + b))
    assert [batch["name"] for batch in batches] == [["frame 1"], ["frame 2"], ["frame 3"]]
    values = [[round(255 * float(image.mean())) for image in (b["target"], *b["sources"][0])] for b in batches]
    assert values == [[1, 2, 0], [2, 3, 1], [3, 4, 2]]
    assert batches[0]["distance"].tolist() == [[12.0, 10.0]]
    assert batches[0]["target"].shape == (1, 3, 3, 4)


def test_few_frames_of_a_long_clip_are_evenly_spread() -> None:
    batches = list(clip_batches(frames(40), 3, 4, count=40, most=4))
    assert [batch["name"][0] for batch in batches] == ["frame 0", "frame 10", "frame 20", "frame 30"]


def test_pairs_of_a_stereo_clip() -> None:
    batches = list(clip_batches(frames(2), 3, 4, stereo=[f + 100 for f in frames(2)], baseline=0.5))
    assert round(255 * float(batches[1]["sources"].mean())) == 101
    assert batches[1]["T_stereo_tgt"][0, 0, 3] == -0.5
    with pytest.raises(DataError, match="different numbers of images \\(one ends after 2\\)"):
        list(clip_batches(frames(2), 3, 4, stereo=frames(3)))
    with pytest.raises(DataError, match="different numbers of images"):
        list(clip_batches(frames(3), 3, 4, stereo=frames(2)))


# --- speeds ----------------------------------------------------------------------------------------------------------


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_speeds_by_frame_and_by_time(tmp_path: Path) -> None:
    by_frame = read_speeds(write(tmp_path / "a.csv", "frame,speed\n0,10\n1,10\n2,20\n"))
    assert by_frame.distance("any", 0, 1, fps=10) == pytest.approx(1.0)
    assert by_frame.distance("any", 0, 1, fps=20) == pytest.approx(0.5)
    assert by_frame.distance("any", 2, 1, fps=10) == pytest.approx(1.5)
    assert np.isnan(by_frame.distance("any", 2, 3, fps=10))
    by_time = read_speeds(write(tmp_path / "b.csv", "time, speed\n1.0, 5\n0.0, 5\n"))
    between = read_speeds(write(tmp_path / "c.csv", "frame,speed\n0,0\n40,40\n"))  # speed is linear, the way is not
    assert between.distance("any", 0, 10, fps=10) == pytest.approx(5.0)
    assert between.distance("any", 30, 40, fps=10) == pytest.approx(35.0)
    assert by_time.distance("any", 1, 3, fps=4) == pytest.approx(2.5)


def test_speeds_of_several_drives(tmp_path: Path) -> None:
    table = read_speeds(write(tmp_path / "a.csv", "drive,frame,speed\na l,0,1\na l,9,1\nb,0,2\nb,9,2\n"))
    assert table.distance("b", 0, 5, fps=10) == pytest.approx(1.0)
    assert table.distance("a l", 0, 5, fps=10) == pytest.approx(0.5)
    assert np.isnan(table.distance("c", 0, 5, fps=10))
    table.check_drives(["c", "b"])
    with pytest.raises(DataError, match=r"of the drives a l, b, which are not needed; call them c, d, or leave the"):
        table.check_drives(["c", "d"])
    with pytest.raises(DataError, match=r"a single recording has no name, so leave the column 'drive' out"):
        table.check_drives([])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,velocity\n0,1\n", "has the columns frame, velocity; expected columns"),
        ("", "has the columns none; expected"),
        ("frame,speed\n", "has no line of numbers"),
        ("frame,speed\n0,fast\n", r"line 2 is not a time and a speed of at least 0 \(frame=0, speed=fast\)"),
        ("frame,speed\n0,1\n1,-3\n", r"line 3 is not a time"),
        ("frame,speed\n0\n", r"line 2 is not a time"),
        ("frame,speed\n0,1\n1,1\n1.0,2\n", r"line 4 has a second speed for frame 1; keep one line of each"),
        ("drive,time,speed\na,0,1\nb,0,1\na,0,2\n", r"line 4 has a second speed for time 0 of a;"),
    ],
)
def test_bad_tables_are_one_sentence(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message) as raised:
        read_speeds(write(tmp_path / "bad.csv", text))
    assert "\n" not in str(raised.value)


def test_missing_table_and_bad_rate(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot read .*nowhere\.csv"):
        read_speeds(tmp_path / "nowhere.csv")
    table = read_speeds(write(tmp_path / "a.csv", "frame,speed\n0,10\n1,10\n"))
    with pytest.raises(ConfigError, match=r"fps is 0"):
        table.distance("", 0, 1, fps=0)


def test_metric_motion_scales_the_way_and_not_the_turn() -> None:
    class Turning(torch.nn.Module):
        def forward(self, target: torch.Tensor, sources: torch.Tensor) -> torch.Tensor:
            return pose_matrix(torch.tensor([[[0.1, 0.2, 0.3]]]), torch.tensor([[[1.0, 2.0, 3.0]]]))

    images = torch.zeros(1, 3, 4, 4)
    T = MetricMotion(Turning(), Scale(2.0, "speed"))(images, images[None])
    torch.testing.assert_close(T, pose_matrix(torch.tensor([[[0.1, 0.2, 0.3]]]), torch.tensor([[[2.0, 4.0, 6.0]]])))
