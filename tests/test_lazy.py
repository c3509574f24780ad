"""Names that packages import when they are first used."""

from __future__ import annotations

from types import ModuleType

import pytest

import saunet
import saunet.exporting
import saunet.prediction
import saunet.scale


@pytest.mark.parametrize("package", [saunet, saunet.exporting, saunet.prediction, saunet.scale])
def test_every_name_of_a_package_is_there_and_no_other(package: ModuleType) -> None:
    for name in package.__all__:
        assert getattr(package, name) is getattr(package, name)
    with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'Nonsense'"):
        _ = package.Nonsense
