"""Tests of files that are written whole or not at all."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from saunet.errors import ConfigError, DataError
from saunet.io.atomic import check_folder, remove_partial_files, replacing, write_bytes, write_json


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "picture.png"
    with replacing(path) as temporary:
        temporary.write_bytes(b"first")
        assert not path.exists()
        assert temporary.suffix == ".png"
    with pytest.raises(KeyboardInterrupt):
        _interrupted(path)
    assert path.read_bytes() == b"first"
    assert list(path.parent.iterdir()) == [path]


def _interrupted(path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(b"sec")
        raise KeyboardInterrupt


@pytest.mark.parametrize("error", [DataError, ConfigError])
def test_what_the_system_refuses_is_said_in_the_callers_voice(tmp_path: Path, error: type[Exception]) -> None:
    (tmp_path / "file").write_bytes(b"")
    for path, reason in (
        (tmp_path, "a folder has this name"),
        (tmp_path / "file" / "x", r"file.x: (Not a|File exists)"),
    ):
        with pytest.raises(error, match=reason):
            write_bytes(path, b"x", error)
        with pytest.raises(error, match=reason):
            write_json(path, {}, error)


def test_json_is_utf8_and_ends_its_last_line(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    content = {"Straße": [1, 0.5, None, True], "none": {}}
    write_json(path, content)
    text = path.read_bytes().decode("utf-8")
    assert text.startswith('{\n  "Straße": [\n    1,')
    assert text.endswith("}\n")
    assert json.loads(text) == content
    write_json(path, content, indent=None)
    assert path.read_text(encoding="utf-8") == '{"Straße": [1, 0.5, null, true], "none": {}}\n'


def test_json_keeps_names_of_files_that_are_not_utf8(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9 \\.mp4")
    write_json(tmp_path / "a.json", {"video": name})
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"video": name}


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_json_without_finite_numbers_is_refused_and_the_old_file_stays(tmp_path: Path, value: float) -> None:
    path = tmp_path / "a.json"
    write_json(path, [1])
    with pytest.raises(ConfigError, match=r"cannot write .*a\.json: .*JSON has only finite numbers"):
        write_json(path, {"a": [value]}, ConfigError)
    assert json.loads(path.read_text()) == [1]
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_looked_at_and_not_made(tmp_path: Path) -> None:
    check_folder(tmp_path / "new" / "folder")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("in the way")
    for place in ("file", "file/below/it"):
        with pytest.raises(ConfigError, match=r"cannot write to .*: .*file is not a folder; choose another one"):
            check_folder(tmp_path / place, ConfigError)
    if os.geteuid() != 0:  # root may write everywhere
        (tmp_path / "closed").mkdir(mode=0o500)
        with pytest.raises(ConfigError, match="no permission to write to"):
            check_folder(tmp_path / "closed" / "x", ConfigError)


def test_files_of_killed_processes_are_removed_and_no_others(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\n"
        "from saunet.io.atomic import replacing\n"
        "with replacing(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    (tmp_path / "deep").mkdir()
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "deep" / "a.png")], check=False)
    (left,) = (tmp_path / "deep").iterdir()
    (tmp_path / ".notes.1.partial.txt").touch()  # somebody else's
    with replacing(tmp_path / "b.png") as ours:
        ours.touch()
        assert remove_partial_files(tmp_path) == [left]
        assert ours.is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".notes.1.partial.txt", "b.png", "deep"]
    assert not left.exists()
