"""Stored depth maps: a record that cannot be right is refused before it scales anything."""

from __future__ import annotations

import json

import pytest
from drives import NumberDrive

from saunet.data.loading.stored import DepthMaps
from saunet.errors import DataError


@pytest.mark.parametrize("factor", ["0", "-2", "NaN", "1e999"])
def test_a_factor_that_is_not_positive_is_refused(tmp_path, factor):
    maps, drive = DepthMaps("teacher", tmp_path), NumberDrive()
    maps.claim(drive, {"model": "x"}, 1.5)
    path = maps.home(drive) / "maps.json"
    assert maps.info(drive)["factor"] == 1.5
    path.write_text(path.read_text().replace("1.5", factor))
    assert "factor" in json.loads(path.read_text())
    with pytest.raises(DataError, match=r"maps\.json.*(factor|NaN|out of range)"):
        maps.info(drive)
