"""What a resumed run keeps of what it logged before."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from saunet.training.resume import keep_rows


def test_a_resumed_run_keeps_its_csv_rows_up_to_the_checkpoint(tmp_path: Path) -> None:
    first = CSVLogger(tmp_path, name=None, version="csv")
    for step in range(4):
        first.log_metrics({"loss": 1.0 + step}, step)
    first.save()
    with (tmp_path / "csv" / "metrics.csv").open("a") as file:
        file.write("7.0")  # a kill cut the row

    resumed = CSVLogger(tmp_path, name=None, version="csv")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        keep_rows(resumed, {"global_step": 2})  # the rows of steps 2 and 3 come again
    resumed.log_metrics({"loss": 9.0, "other": 5.0}, 2)
    resumed.save()
    with (tmp_path / "csv" / "metrics.csv").open() as file:
        rows = [(row["step"], row["loss"], row["other"]) for row in csv.DictReader(file)]
    assert rows == [("0", "1.0", ""), ("1", "2.0", ""), ("2", "9.0", "5.0")]


def test_nothing_is_done_without_rows_or_for_another_logger(tmp_path: Path) -> None:
    keep_rows(CSVLogger(tmp_path, name=None, version="csv"), {"global_step": 2})
    keep_rows(TensorBoardLogger(tmp_path, name=None, version="tensorboard"), {"global_step": 2})
    assert list(tmp_path.iterdir()) == []
