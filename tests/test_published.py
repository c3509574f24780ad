"""The paper's numbers are the paper's, and there is one for each model that is measured beside them."""

from __future__ import annotations

from saunet.metrics.functional import ERROR_NAMES
from saunet.published import published
from saunet.tools.benchmark.tool import PAPER_METHODS


def test_the_papers_numbers_are_the_papers() -> None:
    rows = {row.method: row.errors for row in published().table1}
    assert len(rows) == 12
    assert {len(row) for row in rows.values()} == {len(ERROR_NAMES)}
    assert tuple(rows["SAU-Net"]) == (0.108, 0.745, 4.598, 0.183, 0.891, 0.964, 0.985)
    assert rows["Klodt"][3] is None
    assert [row.errors for row in published().table3] == [rows["Mono R18"], rows["Mono R50"], rows["SAU-Net"]]


def test_every_model_of_the_paper_has_its_size_and_accuracy() -> None:
    sizes = {row.method: row.megaparameters for row in published().table2}
    accuracy = {row.method: row.errors[0] for row in published().table1}
    found = {model: (sizes[method], accuracy[method]) for model, method in PAPER_METHODS.items()}
    assert found == {
        "mono_r18": (52.7, 0.115),
        "mono_r50": (68.7, 0.111),
        "packnet": (118.5, 0.111),
        "sau_net": (58.8, 0.108),
    }
