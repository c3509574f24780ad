from __future__ import annotations

import hashlib
import json

import pytest
from published_splits import PUBLISHED

from saunet.data.kitti import splits
from saunet.data.loading import selecting
from saunet.data.loading.selecting import Frame
from saunet.errors import ConfigError, DataError
from saunet.fingerprint import fingerprint

# counts and SHA-256 of the published lists


@pytest.mark.parametrize("name", PUBLISHED)
def test_lists_are_the_published_ones(name):
    frames = getattr(splits, name)()
    assert len(frames) == PUBLISHED[name][0]
    assert fingerprint([str(frame) for frame in frames]) == PUBLISHED[name][1]


def test_fingerprints_agree_with_the_facts(test_data):
    facts = json.loads((test_data / "facts" / "split_fingerprints.json").read_text())
    for name, (count, digest) in PUBLISHED.items():
        fact = facts.get(name) or facts[f"{name}_train_plus_val"]
        assert (fact["count"], fact["sha256"]) == (count, digest)


@pytest.mark.parametrize("name", splits.TRAINING)
def test_training_splits_are_disjoint_and_complete(name):
    train, val = splits.training_split(name)
    assert not set(train) & set(val)
    assert len(train) + len(val) == (46976 if name == "eigen_full" else 44234)
    assert 0.09 < len(val) / (len(train) + len(val)) < 0.11
    assert splits.training_split(name) == (train, val)
    if name != "eigen_zhou_random":
        assert not {frame.drive for frame in train} & {frame.drive for frame in val}


def test_random_split_has_the_published_counts_and_follows_its_seed():
    train, val = splits.training_split("eigen_zhou_random", 0)
    assert (len(train), len(val)) == (39810, 4424)
    assert splits.training_split("eigen_zhou_random", 1)[1] != val


def test_no_test_drive_is_trained_on():
    assert not {frame.drive for frame in splits.eigen_full()} & {frame.drive for frame in splits.eigen_test()}


def test_ranges():
    assert splits.parse_ranges("0-6/3,9,20-21/1") == [0, 3, 6, 9, 20, 21]
    assert splits.parse_ranges("") == []


def frames(drives, count, sides="l"):
    return [Frame(f"d/{drive}", number, side) for drive in range(drives) for number in range(count) for side in sides]


def test_few_drives_hold_out_their_tails_with_a_gap():
    train, val = selecting.hold_out(frames(2, 20, "lr"), 0.1, gap=2, seed=0)
    assert {frame.number for frame in val} == {18, 19}
    assert {frame.number for frame in train} == set(range(16))
    assert {frame.side for frame in val} == {"l", "r"}


def test_frames_between_the_parts_are_counted_for_each_recording():
    recordings = {"a": range(20), "short": range(3), "b": range(40)}
    parts = selecting.divide(recordings, {"val_clips": (), "test_clips": ()}, 0.1, gap=3, seed=0)
    assert parts.unused == {"a": 3, "short": 2, "b": 3}
    train, val = parts.of("train"), parts.of("val")
    assert {name: len(train[name]) + len(val[name]) + parts.unused[name] for name in recordings} == {
        name: len(numbers) for name, numbers in recordings.items()
    }
    assert list(train) == ["a", "b", "short"]  # the last without a frame: it is counted all the same
    named = selecting.divide(recordings, {"val_clips": ["b"], "test_clips": ()}, 0.1, gap=3, seed=0)
    assert not named.unused


def test_no_share_holds_nothing_out():
    everything = frames(2, 5)
    assert selecting.hold_out(everything, 0.0, gap=2, seed=0) == (everything, [])


def test_many_drives_hold_out_whole_drives():
    train, val = selecting.hold_out(frames(20, 10), 0.1, gap=2, seed=0)
    assert len(val) == 20
    assert not {frame.drive for frame in train} & {frame.drive for frame in val}
    assert selecting.hold_out(frames(20, 10), 0.1, gap=2, seed=1)[1] != val


def test_named_drives_are_held_out_and_unknown_ones_refused():
    train, val = selecting.hold_out_drives(frames(3, 4), ["1"])
    assert {frame.drive for frame in val} == {"d/1"}
    assert len(train) == 8
    with pytest.raises(ConfigError, match="no drive '7' to hold out; drives: d/0, d/1, d/2"):
        selecting.hold_out_drives(frames(3, 4), ["7"])


def test_unknown_names_are_refused():
    with pytest.raises(ConfigError, match=r"split is 'eigen_zohu_random'; did you mean 'eigen_zhou_random'"):
        splits.training_split("eigen_zohu_random")
    with pytest.raises(ConfigError, match="test_split is 'x'"):
        splits.test_split("x")


def test_files_in_monodepth2_format(tmp_path):
    path = tmp_path / "train_files.txt"
    path.write_text(
        "2011_09_26/2011_09_26_drive_0022_sync 473 r\n\n2011_09_26/2011_09_26_drive_0022_sync 0000000007 l\n"
    )
    assert splits.read_split(path) == [
        Frame("2011_09_26/2011_09_26_drive_0022_sync", 473, "r"),
        Frame("2011_09_26/2011_09_26_drive_0022_sync", 7, "l"),
    ]


@pytest.mark.parametrize("line", ["d/a 1", "d/a one l", "d/a 1 x", "a 1 l", "d/a -1 l"])
def test_malformed_lines_are_named(tmp_path, line):
    path = tmp_path / "list.txt"
    path.write_text(f"d/a 1 l\n{line}\n")
    with pytest.raises(DataError, match=r"list.txt, line 2: expected '<date>/<drive> <frame number> <l or r>', got"):
        splits.read_split(path)


def test_missing_and_empty_files_are_named(tmp_path):
    with pytest.raises(DataError, match=r"cannot read split file .*gone.txt"):
        splits.read_split(tmp_path / "gone.txt")
    (tmp_path / "empty.txt").write_text("\n")
    with pytest.raises(DataError, match=r"empty.txt lists no frames"):
        splits.read_split(tmp_path / "empty.txt")


def test_test_frames_come_in_the_published_order():
    """Other systems' arrays of predictions follow it; inside a drive it is not ascending."""
    frames = splits.eigen_test()
    assert [frame.number for frame in frames[:5]] == [69, 54, 42, 57, 30]
    assert (frames[-1].drive, frames[-1].number) == ("2011_10_03/2011_10_03_drive_0047_sync", 768)
    lines = "\n".join(map(str, frames)) + "\n"
    assert hashlib.sha256(lines.encode()).hexdigest().startswith("e226d4ca16e0e6e9")
    kept = set(splits.eigen_benchmark_test())
    assert [frame for frame in frames if frame in kept] == splits.eigen_benchmark_test()
