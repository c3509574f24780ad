"""``saunet-prepare`` on the command line."""

from __future__ import annotations

import sys

import pytest
from prepare_tree import name

from saunet.cli import prepare


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Run the tool in an empty folder: (exit code, output, errors)."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["saunet-prepare", *words])
        try:
            prepare.main()
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
    assert (code, out.strip()) == (0, "10 frames made, 0 were there, 0 have no scan, 0 skipped"), err
    code, out, err = command("cache", *where, "folder=cache", "height=10", "width=30", "workers=0", "format=webp")
    assert code == 0, err
    assert out.startswith("10 copies made (0 in place of damaged or outdated ones), 0 verified")
    teacher = f"input=maps/{name(1)}/depth_linear/l"
    code, out, err = command("teacher", *where, "drives=[0001_sync]", teacher, "folder=maps")
    assert (code, out.strip()) == (0, "6 frames made, 0 were there, 0 skipped"), err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache", "maps", "raw"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["densfy"], "the first word is the job, not 'densfy'; did you mean 'densify'? jobs: densify, teacher, cache"),
        ([], "the first word is the job"),
        (["densify"], "root is not set; add root=..."),
        (
            ["cache", "data=campus", "data.root=raw", "root=raw", "folder=c"],
            "root is for KITTI raw trees without data=",
        ),
        (["cache", "data=synthetic", "folder=c"], "SyntheticDataModule reads no copies made by saunet-prepare; use"),
        (["densify", "data=campus", "data.root=raw"], "data belongs to saunet-prepare cache, not to densify"),
        (["densify", "root=raw", "quality=3"], "quality belongs to saunet-prepare cache, not to densify"),
        (["cache", "root=raw"], "a cache needs a folder of its own; set folder=..."),
        (["densify", "root=/nowhere"], "no data root at /nowhere"),
        (["densify", "root=raw", "depth=lidar_x"], "depth is 'lidar_x', allowed: camera_z, improved"),
        (["densify", "root=raw", "kidns=[linear]"], "did you mean 'kinds'?"),
        (["densify", "root=raw", "kinds=linear"], "kinds is 'linear'; it must be a list: kinds=[linear]"),
        (["densify", "root=raw", "drives=9015"], "drives is '9015'; it must be a list: drives=[9015]"),
        (["teacher", "root=raw", "checkpoint=x.ckpt"], "x.ckpt"),
    ],
)
def test_what_cannot_work_is_one_sentence(command, tree, words, sentence):
    code, _, err = command(*words)
    assert code == 1
    assert sentence in err
    assert "Traceback" not in err


def test_what_is_refused_leaves_nothing(command, tree, tmp_path):
    code, _, err = command("densify", f"root={tree}", "cameras=[left]", "workers=-1", "folder=maps")
    assert code == 1
    assert "workers is -1; it must be at least 0" in err
    assert not (tmp_path / "maps").exists()


def test_skipped_frames_are_named(command, tree):
    (tree / name(1) / "velodyne_points" / "data" / "0000000002.bin").write_bytes(b"123")
    code, out, err = command("densify", f"root={tree}", "cameras=[left]", "workers=0", "on_error=skip")
    assert code == 0
    assert "1 skipped" in out
    assert "skipped:" in err
    assert "0000000002.bin" in err
