"""Readers of plain data: what is refused, in one sentence, and that damage of any kind ends so, quickly."""

from __future__ import annotations

import io
import json
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import saunet
from saunet.errors import CheckpointError, UnreadableError
from saunet.io import plain
from saunet.io.plain import (
    different_settings,
    iterate_json,
    parse_json,
    read_array,
    read_arrays,
    read_json,
    read_text,
    read_yaml,
)

ALIASED = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def refused(read: Callable[[Path], Any], path: Path, data: bytes) -> str:
    path.write_bytes(data)
    start = time.process_time()
    with pytest.raises(UnreadableError) as error:
        read(path)
    assert time.process_time() - start < 2
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    assert len(text) < 600
    return text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "nesting"),
        ("[" * 70 + "]" * 70, "nesting"),
        ('{"a": 1, "a": 2}', "'a' is given twice"),
        ('{"a": ' + "9" * 400 + "}", "400 digits"),
        ('{"a": 1e999}', "out of range"),
        ('{"a": NaN}', "NaN is no number"),
        ('{"a": ', "Expecting value"),
        ("", "Expecting value"),
    ],
)
def test_json_that_is_refused(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(read_json, tmp_path / "a.json", text.encode())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 1000 + "]" * 1000, "nesting"),
        (ALIASED, "aliases"),
        ("a: 1\nb: 2\na: 3\n", "'a' is given twice, again in line 3"),
        ("a: {b: 1, b: 2}", "'b' is given twice"),
        ("a: " + "9" * 400, "400 digits"),
        ("a: 2020-13-45", "month"),
        ("a: !!python/object/apply:os.system [x]", "python/object"),
        ("[a]: b\n? {c: d}\n: e", "as YAML"),
        ("a: [1, 2", "as YAML"),
        ("x" * 200_000, "131,072 bytes"),
    ],
)
def test_yaml_that_is_refused(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(read_yaml, tmp_path / "a.yaml", text.encode())


def _with_header(header: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "as a .npy file"),
        (b"PK\x03\x04 what", "as a .npy file"),
        (npy(np.zeros(9))[:-4], "72 bytes and 68 follow"),
        (_with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 9), }"), "promises"),
        (_with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 9), }"), "shape"),
        (_with_header("{'descr': '<f8', 'fortran_order'"), "as a .npy file"),
        (_with_header("(" * 9000), "as a .npy file"),
        (npy(np.array(["text"])), "not numbers"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f", "header of"),
    ],
)
def test_arrays_that_are_refused(tmp_path: Path, data: bytes, words: str) -> None:
    assert words in refused(read_array, tmp_path / "a.npy", data)


def test_archives_that_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, a=np.zeros((3, 4)), b=np.arange(5))
    path = tmp_path / "a.npz"
    path.write_bytes(stream.getvalue())
    found = read_arrays(path)
    assert set(found) == {"a", "b"}
    np.testing.assert_array_equal(found["b"], np.arange(5))
    assert "as a .npz file" in refused(read_arrays, path, stream.getvalue()[:-30])
    monkeypatch.setattr(plain, "ARRAY_BYTES", 100)
    assert "more than 100 bytes" in refused(read_arrays, path, stream.getvalue())


def test_what_is_whole_is_read_as_by_the_libraries(tmp_path: Path) -> None:
    content = {"a": [1, 2.5, None, True, "ä"], "b": {"c": -3, "d": {}}}
    (tmp_path / "a.json").write_text(json.dumps(content))
    assert read_json(tmp_path / "a.json") == content
    (tmp_path / "a.yaml").write_text("# a camera\nbase: &k [1, 2]\nsame: *k\nday: 2020-02-03\nx: {<<: {y: 1}, y: 2}\n")
    found = read_yaml(tmp_path / "a.yaml")
    assert found["same"] == [1, 2]
    assert found["day"].year == 2020
    assert found["x"] == {"y": 2}
    array = np.arange(12, dtype=np.float32).reshape(3, 4)
    np.save(tmp_path / "a.npy", array)
    for mapped in (False, True):
        np.testing.assert_array_equal(read_array(tmp_path / "a.npy", mapped=mapped), array)
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "absent.json")


def test_the_error_is_of_the_class_that_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="the record cannot be read as JSON"):
        parse_json("{", "the record", CheckpointError)
    (tmp_path / "a").write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(CheckpointError, match="not text in UTF-8"):
        read_text(tmp_path / "a", error=CheckpointError)


def _one_sentence(read: Callable[[Any], Any], path: Any) -> bool:
    """Return whether a file is read, or refused in one short line; anything else is raised."""
    try:
        read(path)
    except UnreadableError as error:
        return "\n" not in str(error) and len(str(error)) < 600
    return True


_READERS: dict[str, tuple[Callable[[Path], Any], bytes]] = {
    "json": (read_json, json.dumps({"a": [1, 2.5, {"b": None}], "cde": "ä", "e": -1e-3}).encode()),
    "yaml": (read_yaml, b"K: [1, 2.5, 0x1f]\na: &a {b: 2020-01-01, c: !!str 3}\nd: *a\ne: |\n  text\n"),
    "npy": (read_array, npy(np.arange(6, dtype=np.float32).reshape(2, 3))),
}


@pytest.mark.parametrize("kind", _READERS)
def test_damage_of_any_kind_ends_in_a_sentence(kind: str, tmp_path: Path) -> None:
    """Bytes replaced, removed, repeated and inserted: nothing but our own error, and never slow."""
    read, whole = _READERS[kind]
    path = tmp_path / f"a.{kind}"
    end = time.process_time() + 5

    @settings(max_examples=300, deadline=2000)
    @given(place=st.integers(0, len(whole)), cut=st.integers(0, 8), added=st.binary(max_size=9))
    def damage(place: int, cut: int, added: bytes) -> None:
        if time.process_time() < end:
            path.write_bytes(whole[:place] + added + whole[place + cut :])
            assert _one_sentence(read, path)

    damage()


@settings(max_examples=100, deadline=2000)
@given(st.binary(max_size=200))
def test_damaged_archives(data: bytes) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.npy", npy(np.arange(3)) if len(data) < 20 else data)
    whole = stream.getvalue()
    damaged = io.BytesIO(whole[: len(data)] + data + whole[2 * len(data) :])
    assert _one_sentence(read_arrays, damaged)


@pytest.mark.parametrize("part", [200, 211, 1 << 20])
def test_a_long_list_is_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int) -> None:
    rows = [{"token": f"a{{]{number}\\", "at": [number / 3, None, {"deep": [True]}], "é": "ü"} for number in range(50)]
    monkeypatch.setattr(plain, "_PART", part)
    for text in (json.dumps(rows), json.dumps(rows, indent=2, ensure_ascii=False), "\n[ \n" + json.dumps(rows)[1:]):
        (tmp_path / "rows.json").write_text(text, encoding="utf-8")
        assert list(iterate_json(tmp_path / "rows.json")) == rows
    (tmp_path / "rows.json").write_text("[]")
    assert list(iterate_json(tmp_path / "rows.json")) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "its end is missing"),
        ('[{"a": 1}, {"b": 2}', "its end is missing"),
        ('[{"a": 1}, {"b": ', "end is missing"),
        ('{"a": 1}', "a list of objects is expected, and '{' found"),
        ("[1, 2]", "a list of objects is expected, and '1' found"),
        ('[{"a": NaN}]', "NaN is no number"),
        ('[{"a": ' + "9" * 40 + "}]", "40 digits"),
        ('[{"a" 1}' + " " * (3 << 20), "delimiter"),
    ],
)
def test_a_long_list_that_is_refused(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(lambda path: list(iterate_json(path)), tmp_path / "rows.json", text.encode())


def test_settings_that_differ_from_a_record_are_named() -> None:
    settings = {"model": "a", "size": (64, 192), "camera": None}
    assert different_settings({"model": "a", "size": [64, 192]}, settings) == ""
    recorded = {"model": "b", "size": [64, 96], "camera": None}
    assert different_settings(recorded, settings, {"model": "network"}) == "different settings (network, size)"
    assert different_settings(["model"], settings) == "different settings (model, size)"


def test_a_message_quotes_no_word_of_any_length() -> None:
    error = saunet.DataError(f"the lens model is '{'9' * 5000}'; known: pinhole")
    assert len(str(error)) < 200
    assert len(str(saunet.DataError(f"no parameter '{'a: {' * 600}'; allowed: dims"))) < 200
    assert "known: pinhole" in str(error)
