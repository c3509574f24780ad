from __future__ import annotations

import json
import warnings

import pytest
from drives import NumberDrive
from kitti_tree import make_drive, name

from saunet.data.loading.selecting import Manifest, read_manifest, write_manifest
from saunet.data.loading.windows import Selection
from saunet.errors import DataError
from saunet.registry import datamodules


def module(root, **options):
    small = {"height": 10, "width": 30, "batch_size": 2, "workers": 0, "split": "all", "cameras": ["left"]}
    return datamodules.build("kitti", root=str(root), **{**small, **options})


def names(data, split):
    return [data.datasets[split].name(index) for index in range(len(data.datasets[split]))]


class Numbered(NumberDrive):
    numbering = "fps=10"


def test_what_is_written_is_read_and_applied(tmp_path, monkeypatch):
    leave_out = {"a": {"static": [3, 1], "unreadable": [6]}, "b": {"dark": [2]}}
    write_manifest(tmp_path / "m.json", Manifest(leave_out, {"a": "fps=10"}, {"findings": ["ü"]}))
    manifest = read_manifest(tmp_path / "m.json")
    assert manifest.leave_out == {"a": {"static": [1, 3], "unreadable": [6]}, "b": {"dark": [2]}}
    drive = Numbered("a", range(10))
    applied = manifest.apply(Selection(drive, range(10), {"x": 1}), (-1, 1))
    assert list(applied.frames) == [0, 2, 4, 8, 9]  # 5, 6 and 7 would read the broken frame 6
    assert applied.left_out == {"x": 1, "static (manifest)": 2, "unreadable (manifest)": 3}
    other = NumberDrive("c", range(3))
    assert list(manifest.apply(Selection(other, range(3)), (-1, 1)).frames) == [0, 1, 2]
    monkeypatch.setattr(Numbered, "numbering", "fps=5")
    with pytest.raises(DataError, match=r"m.json was made for 'a' with fps=10 and is now read with fps=5"):
        manifest.apply(Selection(drive, range(10)), (-1, 1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"no manifest at .*m.json; make one with saunet doctor"),
        ("{", r"m.json cannot be read as JSON"),
        ("[]", r"m.json is not a manifest of format 1 \(found list\)"),
        ('{"format": 2}', r"found 2"),
        ('{"format": 1}', r"'leave_out' must map each drive"),
        ('{"format": 1, "leave_out": {"a": {"static": ["x"]}}}', r"'leave_out' must map each drive"),
        ('{"format": 1, "leave_out": {"a": [1]}}', r"'leave_out' must map each drive"),
    ],
)
def test_files_that_are_no_manifest_are_named(tmp_path, text, message):
    if text is not None:
        (tmp_path / "m.json").write_text(text)
    with pytest.raises(DataError, match=message):
        read_manifest(tmp_path / "m.json")


def test_training_leaves_out_what_the_manifest_names_and_tests_do_not(tmp_path):
    make_drive(tmp_path / "raw", 1, frames=range(20))
    entry = {f"{name(1)} l": {"static": [3, 4], "unreadable": [18]}}
    (tmp_path / "m.json").write_text(json.dumps({"format": 1, "leave_out": entry}))
    data = module(tmp_path / "raw", manifest=str(tmp_path / "m.json"), val_share=0.3)
    data.setup()
    assert len(names(data, "train")) == 11 - 2
    assert "2 static (manifest)" in data.summary("train")
    assert len(names(data, "val")) == 3
    assert len(names(data, "test")) == 6
    with pytest.raises(DataError, match=r"'val' has no usable frame .* 2 unreadable \(manifest\)"):
        module(tmp_path / "raw", manifest=str(tmp_path / "m.json"), offsets=[-1]).setup("validate")


def test_a_manifest_of_other_recordings_is_refused_and_of_some_warned_of(tmp_path):
    for number in (1, 2):
        make_drive(tmp_path / "raw", number, frames=range(20), sides=(2,))

    def setup(drives, stage="fit", **more):
        entry = {drive: {"static": [3]} for drive in drives}
        (tmp_path / "m.json").write_text(json.dumps({"format": 1, "leave_out": entry, **more}))
        data = module(tmp_path / "raw", manifest=str(tmp_path / "m.json"), val_drives=[name(2).partition("/")[2]])
        data.setup(stage)

    with pytest.raises(DataError, match=r"m.json names 2 recordings, none of them in the training data \(such as 'a'"):
        setup(["b", "a"])
    with pytest.warns(
        UserWarning, match=r"names 2 recordings, and 1 of them are not in the training data \(such as 'b'; here"
    ):
        setup(["b", f"{name(1)} l"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        setup([f"{name(1)} l", f"{name(2)} l"])
        setup([])
        setup(["b"], test_only=["b"])  # what only tests read tells nothing of the others
        setup([f"{name(1)} l"], "validate")  # as validation alone does not


def test_a_mixture_checks_its_own_manifest_and_those_of_its_sources(tmp_path):
    make_drive(tmp_path / "raw", 1, frames=range(20), sides=(2,))
    (tmp_path / "m.json").write_text(json.dumps({"format": 1, "leave_out": {f"{name(1)} l": {"static": [3]}}}))
    own, size = {"manifest": str(tmp_path / "m.json")}, {"height": 10, "width": 30, "batch_size": 2, "workers": 0}
    inside = datamodules.build("mixed", sources={"town": module(tmp_path / "raw", **own)}, **size)
    inside.setup("fit")
    assert "1 static (manifest)" in inside.summary("train")
    outside = datamodules.build("mixed", sources={"town": module(tmp_path / "raw")}, **own, **size)
    with pytest.raises(DataError, match=r"none of them in the training data .* here they are called 'town/"):
        outside.setup("fit")
    strange = {"format": 1, "leave_out": {"town/x": {"static": [3]}}}
    (tmp_path / "m.json").write_text(json.dumps(strange))
    with pytest.raises(
        DataError, match=r"none of them in the training data \(such as 'town/x'; here they are called '2011"
    ):
        datamodules.build("mixed", sources={"town": module(tmp_path / "raw", **own)}, **size).setup("fit")


def test_broken_files_are_skipped_and_counted(tmp_path):
    make_drive(tmp_path, 1, frames=range(20), sides=(2,))
    images = tmp_path / name(1) / "image_02" / "data"
    (images / "0000000005.png").write_bytes(b"")
    (images / "0000000018.png").write_bytes(b"broken")
    data = module(tmp_path, on_error="skip", val_share=0.3)
    with pytest.warns(UserWarning, match=r"frame left out: .*0000000018.png is not an image"):
        data.setup()
    assert "3 unreadable" in data.summary("val")
    assert "1 unreadable" in data.summary("test")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        batches = list(data.train_dataloader())
    assert any(
        "sample skipped" in str(each.message) and "0000000005.png is empty" in str(each.message) for each in told
    )
    assert len(batches) == len(data.datasets["train"]) // 2  # each broken sample was replaced
    seen = [each for batch in batches for each in batch["name"]]
    assert not {f"{name(1)} {number:010d} l" for number in (4, 5, 6)} & set(seen)
    assert [each[-4:-2] for each in data.skipped()] == ["04", "05", "06"]
    for path in images.glob("*.png"):
        path.write_bytes(b"")
    with pytest.raises(
        DataError, match=r"in a row cannot be read, so on_error=skip gives up; the last: .*png is empty"
    ):
        list(data.train_dataloader())


def test_loader_processes_share_the_count(tmp_path):
    make_drive(tmp_path, 1, frames=range(20), sides=(2,))
    (tmp_path / name(1) / "image_02" / "data" / "0000000005.png").write_bytes(b"")
    data = module(tmp_path, on_error="skip", workers=1)
    data.setup("fit")
    list(data.train_dataloader())
    assert len(data.skipped()) == 3
