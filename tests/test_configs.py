"""Every YAML composes, names do not collide, and a typo fails while composing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
import torch
from hydra import compose
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from plain import plain

from saunet.cli.table import config_dir
from saunet.registry import REGISTRIES, models

pytestmark = pytest.mark.usefixtures("hydra")

ROOTS = {"train", "evaluate", "odometry", "predict", "benchmark", "report", "calibrate", "doctor", "prepare"}
GROUPS = ("trainer", "callbacks", "logger")
COMPONENTS = {
    registry.group: registry.names()
    for registry in REGISTRIES.values()
    if registry.group in ("model/encoder", "model/decoder", "model/pose", "objective", "data")
}


def _yaml(group: str) -> list[str]:
    folder = config_dir() / group
    return sorted(str(path.relative_to(folder).with_suffix("")) for path in folder.rglob("*.yaml"))


def _compose(*overrides: str, root: str = "train") -> object:
    given = list(overrides) if root in ("predict", "calibrate", "prepare") else ["output_dir=/tmp/x", *overrides]
    return compose(root, overrides=given)


def _resolved(*overrides: str) -> dict[str, object]:
    cfg = _compose(*overrides, "data.root=/nowhere") if "data=kitti" in overrides else _compose(*overrides)
    result = {key: plain(cfg[key]) for key in ("model", "objective", "data", "optim", "trainer")}  # type: ignore[index]
    assert all(result.values())
    return result


@pytest.mark.parametrize("root", sorted(ROOTS))
def test_every_root_composes(root: str) -> None:
    assert _compose(root=root)


@pytest.mark.parametrize("name", models.names())
def test_every_registered_model_chooses_its_parts(name: str) -> None:
    model = _compose(f"model={name}").model  # type: ignore[attr-defined]
    with torch.device("meta"):
        built = models.build(name)
    parts = {"encoder": built.depth.encoder, "decoder": built.depth.decoder, "pose": built.pose}
    made = {kind: f"{type(part).__module__}.{type(part).__qualname__}" for kind, part in parts.items()}
    assert made == {kind: model[kind]._target_ for kind in parts}


@pytest.mark.parametrize("name", _yaml("experiment"))
def test_every_experiment_composes_and_lands_at_the_root(name: str) -> None:
    assert (config_dir() / "experiment" / f"{name}.yaml").read_text().startswith("# @package _global_\n")
    cfg = _compose(f"experiment={name}")
    assert "experiment" not in OmegaConf.to_container(cfg)  # type: ignore[arg-type]


def _rounds(groups: Mapping[str, Sequence[str]]) -> list[dict[str, str]]:
    """Return choices in which every name of every group occurs, as few as can be: composing takes its time."""
    longest = max(map(len, groups.values()))
    return [{group: names[each % len(names)] for group, names in groups.items()} for each in range(longest)]


@pytest.mark.parametrize("chosen", _rounds({**COMPONENTS, **{group: _yaml(group) for group in GROUPS}}), ids=str)
def test_every_registered_name_and_every_yaml_composes_from_the_command_line(chosen: dict[str, str]) -> None:
    cfg = _compose(*(f"{group}={name}" for group, name in chosen.items()))
    for group in COMPONENTS:
        target = OmegaConf.select(cfg, group.replace("/", "."))._target_  # type: ignore[arg-type]
        entry = next(each for each in REGISTRIES.values() if each.group == group).entry(chosen[group])
        assert target == entry.path


def test_no_yaml_is_named_like_a_registered_component() -> None:
    for registry in REGISTRIES.values():
        if registry.group is not None:
            folder = config_dir() / registry.group
            taken = {path.stem for path in folder.glob("*.yaml")}
            assert taken.isdisjoint(registry.names()), f"conf/{registry.group} repeats a registered name"


@pytest.mark.parametrize(
    "override",
    [
        "sead=3",
        "model.encoder.dephts=[2,2]",
        "model.encoder.depths=[a]",
        "model.max_dept=3",
        "objective.alhpa=3",
        "objective.alpha=much",
        "data.heigth=64",
        "optim.learning_rate=1",
        "trainer.max_epoch=3",
    ],
)
def test_a_typo_fails_while_composing(override: str) -> None:
    with pytest.raises((HydraException, OmegaConfBaseException)):
        _compose(override)


@pytest.mark.parametrize("group", ["model/encoder", "model/decoder", "objective", "data", "experiment"])
def test_an_unknown_choice_lists_the_known_ones(group: str) -> None:
    with pytest.raises(HydraException, match=r"(?s)Available options|Could not find"):
        _compose(f"{group}=nonsense")


@pytest.mark.parametrize("experiment", ["smoke", "selfsup"])
@pytest.mark.parametrize("chosen", _rounds({key: COMPONENTS[key] for key in ("data", "objective")}), ids=str)
def test_experiments_go_with_any_data_and_objective(experiment: str, chosen: dict[str, str]) -> None:
    assert _compose(f"experiment={experiment}", *(f"{group}={name}" for group, name in chosen.items()))


def test_one_seed_decides_everything() -> None:
    assert _resolved("seed=7")["data"]["seed"] == 7  # type: ignore[index]


def test_pose_offsets_follow_the_data() -> None:
    model = _resolved("data.offsets=[-2,2]")["model"]
    assert model["pose"]["offsets"] == [-2, 2]  # type: ignore[index]


def test_configs_ship_with_the_package() -> None:
    assert (config_dir() / "train.yaml").is_file()
    assert Path(config_dir()).is_absolute()
