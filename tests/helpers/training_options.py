"""A training's options from plain data, read as the command line reads them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from saunet.cli import compose, table
from saunet.training.tool import TrainOptions

_table = functools.cache(table.read)


def train_options(plain: Mapping[str, Any]) -> TrainOptions:
    return compose.options(TrainOptions, compose.Composed(plain, {}, (), ""), _table())
