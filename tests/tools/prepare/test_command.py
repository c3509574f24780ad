"""``saunet prepare`` on the command line."""

from __future__ import annotations

import sys

import pytest
from jaxtyping import TypeCheckError
from prepare_tree import name

from saunet.cli import app
from saunet.errors import CheckpointError, ConfigError, DataError
from saunet.registry import Spec
from saunet.tools.prepare.tool import PrepareOptions
from saunet.tools.prepare.tool import prepare as prepare_tool


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Run the tool in an empty folder: (exit code, output, errors)."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["saunet"])
        try:
            app.main(["prepare", *words])
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def test_each_job_runs_and_leaves_only_its_results(command, tree, tmp_path):
    where = (f"root={tree}", "cameras=[left]")
    code, out, err = command("densify", *where, "workers=0", "folder=maps")
    assert (code, out.strip()) == (0, "10 frames made, 0 existed already, 0 have no scan, 0 skipped"), err
    code, out, err = command("cache", *where, "folder=cache", "height=10", "width=30", "workers=0", "format=webp")
    assert code == 0, err
    assert out.startswith("10 copies made (0 to replace damaged or outdated ones), 0 verified")
    teacher = f"input=maps/{name(1)}/depth_linear/l"
    code, out, err = command("teacher", *where, "drives=[0001_sync]", teacher, "folder=maps")
    assert (code, out.strip()) == (0, "6 frames made, 0 existed already, 0 skipped"), err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache", "maps", "raw"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["densfy"], "job is 'densfy'; did you mean 'densify'? allowed: densify, teacher, cache, import"),
        ([], "job is not set; add job=..."),
        (["densify"], "root is not set; add root=..."),
        (["cache", "data=synthetic", "folder=c"], "SyntheticDataModule reads no copies made by saunet prepare; use"),
        (["densify", "root=raw", "kinds=liner"], "kinds is 'liner'; did you mean 'linear'?"),
        (["densify", "root=raw", "executor=dask"], "executor=dask and scheduler="),
        (["cache", "root=raw", "folder=c", "scheduler=tcp://10.0.0.1:8786"], "belong together"),
        (["densify", "root=raw", "executor=dask", "scheduler=tcp://10.0.0.1:8786", "workers=2"], "workers counts"),
        (["densify", "root=raw", "workers=-1", "folder=maps"], "workers is -1; it must be at least 0"),
    ],
)
def test_what_cannot_work_is_one_sentence(command, tree, tmp_path, words, sentence):
    code, _, err = command(*words)
    assert code == 1
    assert sentence in err
    assert "Traceback" not in err
    assert [path.name for path in tmp_path.iterdir()] == ["raw"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"job": "densify", "root": None}, "root is not set"),
        ({"job": "cache", "data": Spec.of("data", "video", root="raw"), "folder": "c"}, "root is for KITTI raw trees"),
        (
            {"job": "densify", "data": Spec.of("data", "video", root="raw")},
            "data belongs to the job cache and pack",
        ),
        ({"job": "densify", "quality": 3}, "quality belongs to the job cache, not to densify"),
        ({"job": "densify", "device": "cpu"}, "device belongs to the job teacher"),
        ({"job": "cache"}, "a cache needs a folder of its own"),
        ({"job": "cache", "folder": "c", "quality": 0}, "quality is 0; it must lie between 1 and 100"),
        ({"job": "densify", "kinds": []}, "kinds is empty; name at least one of linear, colorization"),
        ({"job": "densify", "cameras": ["middle"]}, "cameras is 'middle', allowed: left, right"),
        ({"job": "densify", "workers": -1}, "workers is -1; it must be at least 0"),
        ({"job": "teacher"}, r"either checkpoint=.* or input="),
        ({"job": "teacher", "checkpoint": "x", "input": "y"}, r"either checkpoint=.* or input="),
    ],
)
def test_wrong_options_are_refused_at_once(options, message):
    with pytest.raises(ConfigError, match=message):
        PrepareOptions(**{"root": "raw", **options})


@pytest.mark.parametrize(
    "options",
    [
        {"job": "densfy"},
        {"job": "densify", "depth": "lidar_x"},
        {"job": "densify", "kinds": ["liner"]},
        {"job": "densify", "on_error": "ignore"},
        {"job": "teacher", "input": "y", "values": "meters"},
        {"job": "cache", "folder": "c", "format": "png"},
    ],
)
def test_unknown_words_are_refused_at_once(options):
    """By their types already, where these are checked as in the tests."""
    with pytest.raises((ConfigError, TypeCheckError)):
        PrepareOptions(**{"root": "raw", **options})


def test_a_checkpoint_that_is_not_there_is_named(tree):
    with pytest.raises(CheckpointError, match=r"x\.ckpt"):
        prepare_tool(PrepareOptions(job="teacher", root=str(tree), checkpoint="x.ckpt"))
    with pytest.raises(DataError, match="no data root at /nowhere"):
        prepare_tool(PrepareOptions(job="densify", root="/nowhere"))


def test_skipped_frames_are_named(command, tree):
    (tree / name(1) / "velodyne_points" / "data" / "0000000002.bin").write_bytes(b"123")
    code, out, err = command("densify", f"root={tree}", "cameras=[left]", "workers=0", "on_error=skip")
    assert code == 0
    assert "1 skipped" in out
    assert "0000000002.bin has 3 bytes" in err
    assert "0000000002.bin" in err
