from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for `prepare_tree`: tests are imported without being a package


@pytest.fixture
def tree(tmp_path):
    """The root of a KITTI raw tree of two drives with scans."""
    from prepare_tree import make_tree

    make_tree(tmp_path / "raw")
    return tmp_path / "raw"
