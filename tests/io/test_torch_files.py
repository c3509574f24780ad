"""The reader of torch's files: whatever a broken file makes torch raise becomes one sentence, and nothing else does."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest
import torch

from saunet.errors import CheckpointError
from saunet.io.plain import read_torch


def legacy() -> bytes:
    """A file as torch wrote them before 1.6, the format that raises the most kinds of errors when broken."""
    stream = io.BytesIO()
    torch.save({"a": torch.zeros(3)}, stream, _use_new_zipfile_serialization=False)
    return stream.getvalue()


def with_another_storage() -> bytes:
    """Name, in the list of what follows, a storage that no tensor asked for: an AssertionError of torch's."""
    data = legacy()
    *_, last = re.finditer(rb"\d{6,}", data)
    return data[: last.start()] + b"7" * len(last[0]) + data[last.end() :]


def test_plain_content_comes_back(tmp_path: Path) -> None:
    (tmp_path / "x.pt").write_bytes(legacy())
    assert torch.equal(read_torch(tmp_path / "x.pt", "a checkpoint")["a"], torch.zeros(3))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"error code: 1010",  # what a server may send in place of a file: IndexError
        b"image,depth\n1,2\n",
        b"<html>not found</html>",
        b"PK\x03\x04 half a zip",
        b"\x80\x02r",  # struct.error
        b"\x80\x02h&",  # KeyError
        b"\x80\x02c\xafL",  # UnicodeDecodeError
        with_another_storage(),
        legacy()[:-5],
    ],
)
def test_broken_files_end_in_one_sentence(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.pt").write_bytes(data)
    with pytest.raises(
        CheckpointError, match=r"x\.pt is (not a checkpoint, or is damaged|damaged or truncated)"
    ) as error:
        read_torch(tmp_path / "x.pt", "a checkpoint")
    assert "\n" not in str(error.value)
    assert error.value.__cause__ is not None


def test_a_broken_archive_at_every_byte(tmp_path: Path) -> None:
    """One byte of a legacy file changed: some can still be read, and no other error than ours leaves the reader."""
    data = legacy()
    for place in range(len(data)):
        (tmp_path / "x.pt").write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        with contextlib.suppress(CheckpointError):
            read_torch(tmp_path / "x.pt", "a checkpoint")


@pytest.mark.parametrize("kind", [MemoryError, KeyboardInterrupt])
def test_what_is_not_the_files_fault_is_not_hidden(
    kind: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise kind

    monkeypatch.setattr(torch, "load", fail)
    with pytest.raises(kind):
        read_torch(tmp_path / "x.pt", "a checkpoint")
