"""Settings that stand in the running text, such as ``trainer=ddp``, are settings of a tool that the page names."""

from __future__ import annotations

import copy
import itertools
import shlex
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException
from pages import composed, inline, tools

from saunet.cli.table import config_dir
from saunet.registry import REGISTRIES

pytestmark = pytest.mark.usefixtures("hydra")

CONFIGURED = [path.stem for path in sorted(config_dir().glob("*.yaml"))]
WITH_DATA = ("train", "evaluate", "doctor")
PYTHON = {"align_corners=True", "weights_only=True", "features=", "channels="}
FORMS = {"key=value", "camera=[fx,fy,cx,cy]", "saunet predict ... outputs=[ply] camera=[fx,fy,cx,cy]"}
MISTAKES = {"optim.lr=much", "model.encoder.dephts=..."}  # which the page shows as such
# Registered by the page itself:
OWN_COMPONENTS = ("model/encoder=plain", "+objective.extra.near_prior", "plugins=[my_", "saunet train plugins=[my_")
SETTINGS = [
    (page, code)
    for page, code in inline()
    if code not in PYTHON | FORMS | MISTAKES and not code.startswith(OWN_COMPONENTS)
]


def _alternatives(code: str) -> list[list[str]]:
    """Return the overrides of a code, once for each of its alternatives: ``format=jpg|webp`` is two."""
    words = [word for word in shlex.split(code) if "=" in word and not word.startswith("hydra")]  # plugins' own
    choices = [[f"{word.partition('=')[0]}={one}" for one in word.partition("=")[2].split("|")] for word in words]
    return [list(each) for each in itertools.product(*choices)]


def _accepts(tool: str, overrides: list[str], data: str | None) -> bool:
    """Tell whether a tool composes with settings; of a key without a value, whether it has the key.

    Composing takes its time, so that only the choices of a group are composed, each once; values are set afterwards.
    """
    below = "data." if data else ""  # tables name the keys below data. without it
    parsed = OverridesParser.create().parse_overrides(
        [each if each.startswith((below, "data=", "+")) else f"{below}{each}" for each in overrides]
    )
    try:
        groups = composed(tool).hydra.runtime.choices
        chosen = [each for each in parsed if each.key_or_group in groups and not _is_open(each)]
        choices = [f"{each.key_or_group}={_first(each)}" for each in chosen]
        if data:
            choices.append(f"data={data}")
        cfg = copy.deepcopy(composed(tool, *choices))
        for each in parsed:
            if each.key_or_group in groups:
                continue
            if _is_open(each):
                _check_key(cfg, each)
            else:
                OmegaConf.update(cfg, each.key_or_group, _first(each), force_add=each.is_add())
    except (HydraException, OmegaConfBaseException):
        return False
    return True


def _is_open(override: Override) -> bool:
    value = str(override.value())
    return value in ("", "...") or (value.isupper() and value.isalpha())


def _check_key(cfg: DictConfig, override: Override) -> None:
    parent, _, name = override.key_or_group.rpartition(".")
    if override.is_add():
        parent, name = "", override.key_or_group.partition(".")[0]
    node = OmegaConf.select(cfg, parent) if parent else cfg
    if not OmegaConf.is_dict(node) or name not in node:
        raise ConfigKeyError(f"no key {override.key_or_group}")


def _first(override: Override) -> Any:
    return next(iter(override.sweep_iterator())) if override.is_sweep_override() else override.value()


def test_every_setting_in_the_text_is_one_of_a_tool_that_the_page_names() -> None:
    wrong = []
    for page, code in SETTINGS:
        command = code.split(" ")[1] if code.startswith("saunet ") else code.partition(" ")[0]
        others = (tool for tool in tools(page) if tool in CONFIGURED)
        named = [command] if command in CONFIGURED else list(dict.fromkeys(["train", *others]))
        for overrides in _alternatives(code):
            alone = ((tool, None) for tool in named)
            with_data = ((tool, data) for tool in named if tool in WITH_DATA for data in REGISTRIES["data"].names())
            if not any(_accepts(tool, overrides, data) for tool, data in itertools.chain(alone, with_data)):
                wrong.append(f"{page}: no tool takes {' '.join(overrides)}")
    assert not wrong, "\n".join(wrong)
