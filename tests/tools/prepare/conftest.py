from __future__ import annotations

import pytest


@pytest.fixture
def tree(tmp_path):
    """The root of a KITTI raw tree of two drives with scans."""
    from prepare_tree import make_tree

    make_tree(tmp_path / "raw")
    return tmp_path / "raw"
