"""Hydra and nothing else: a tool's configuration, composed and checked by type, becomes the tool's options.

Nothing is written here: Hydra's own run folder appears with the first file that a tool writes, after its checks.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Optional, TypeVar, Union

from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import configure_log, setup_globals
from hydra.types import RunMode
from hydra.version import setbase
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from saunet import schema
from saunet.cli import words
from saunet.cli.table import Table
from saunet.errors import ConfigError, one_of
from saunet.registry import Spec

T = TypeVar("T")
PATHS = ("checkpoint", "folder", "init_from", "input", "output", "output_dir", "predictions", "resume", "root")
"""Options that name files or folders."""
_CONVERTED = (tuple, Sequence, Mapping, typing.Literal)
_TYPES: Mapping[str, object] = {"bool": bool, "int": int, "float": float, "str": str}


@contextmanager
def hydra(tool: str, root: str, table: Table, conf: Path, extra: str | None = None) -> Iterator[Hydra]:
    """Give Hydra, knowing the keys of a tool and of all components.

    Args:
        tool: The tool.
        root: Name of its root config.
        table: All config keys.
        conf: The folder of the YAML files.
        extra: Another folder of YAML files, which comes first.

    Raises:
        ConfigError: if there is no such folder.
    """
    register(table, {root: tool})
    setbase("1.3")
    setup_globals()
    path = create_config_search_path(str(conf))
    if extra is not None:
        if not Path(extra).is_dir():
            raise ConfigError(f"--config-dir is {extra}, which is no folder; check the path")
        first = f"file://{Path(extra).resolve()}"
        path.prepend(provider="command-line", path=first, anchor=SearchPathQuery(provider="schema"))
    GlobalHydra.instance().clear()
    try:
        yield Hydra.create_main_hydra2(task_name=tool, config_search_path=path)
    finally:
        GlobalHydra.instance().clear()


def register(table: Table, roots: Mapping[str, str]) -> None:
    """Give Hydra the typed keys of tools and of all components.

    Args:
        table: All config keys.
        roots: Root config -> the tool whose keys it has.
    """
    store = ConfigStore.instance()
    for root, tool in roots.items():
        node = table.tools[tool]
        # A group's members bring the types of its keys.
        keys = [dataclasses.replace(key, type="any") if key.name in table.library else key for key in node.keys]
        store.store(name=f"{root}_schema", node=structured(dataclasses.replace(node, keys=(*keys, words.PLUGINS))))
    for group, nodes in table.groups().items():
        for name, each in nodes.items():
            store.store(group=group, name=name, node=structured(each))


def structured(node: schema.Node) -> type:
    """Return the dataclass by which OmegaConf checks a node's keys and types."""
    fields: list[tuple[str, object, object]] = []
    if node.path is not None:
        fields += [
            ("_target_", str, dataclasses.field(default=node.path)),
            ("_convert_", str, dataclasses.field(default="all")),
        ]
    if node.partial:
        fields.append(("_partial_", bool, dataclasses.field(default=True)))
    for key in node.keys:
        if key.node is not None:
            made = structured(key.node)
            fields.append((key.name, made, dataclasses.field(default_factory=made)))
        else:
            fields.append((key.name, _python(key.type), _field(key.default)))
    return dataclasses.make_dataclass(node.name, fields)


def _python(name: str) -> object:
    """Return the type that OmegaConf checks for a `saunet.schema.Key.type`."""
    if name.endswith("?"):
        return Optional[_python(name[:-1])]  # noqa: UP045 (OmegaConf wants the typing form)
    kind, _, item = name.partition("[")
    if kind in ("list", "dict"):
        inner = _python(item[:-1])
        return list[inner] if kind == "list" else dict[str, inner]  # type: ignore[valid-type]
    return _TYPES.get(name, typing.Any)


def _field(default: object) -> object:
    if isinstance(default, list | dict):
        return dataclasses.field(default_factory=default.copy)
    return dataclasses.field(default=default)


@dataclasses.dataclass(frozen=True)
class Composed:
    """A tool's configuration.

    Args:
        config: As plain data, resolved.
        choices: Config group -> what was chosen.
        overrides: What the command line said.
        folder: The run's folder as ``hydra.run.dir`` says, not made yet.
    """

    config: Mapping[str, object]
    choices: Mapping[str, str | None]
    overrides: tuple[str, ...]
    folder: str


def single(hydra: Hydra, name: str, overrides: list[str]) -> Composed | None:
    """Compose the configuration of one run; None if it asks for a sweep by itself."""
    try:
        cfg = hydra.compose_config(name, overrides, RunMode.RUN)
    except Exception as error:  # perhaps of a sweep whose YAML file says so
        if "multirun" not in str(error):
            raise
        cfg = hydra.compose_config(name, overrides, RunMode.MULTIRUN)
        if cfg.hydra.mode != RunMode.MULTIRUN:
            raise
    if cfg.hydra.mode == RunMode.MULTIRUN:
        return None
    HydraConfig.instance().set_config(cfg)
    try:
        folder = str(Path(str(OmegaConf.select(cfg, "hydra.run.dir"))).absolute())
        with read_write(cfg.hydra.runtime), open_dict(cfg.hydra.runtime):
            cfg.hydra.runtime.output_dir = folder
        HydraConfig.instance().set_config(cfg)
        configure_log(cfg.hydra.job_logging, cfg.hydra.verbose)
        hydra_cfg = cfg.hydra
        with open_dict(cfg):
            del cfg["hydra"]
        return of_job(cfg, hydra_cfg)
    finally:
        HydraConfig.instance().cfg = None


def of_job(cfg: DictConfig, hydra_cfg: DictConfig) -> Composed:
    """Return what a job of a sweep, or a single run, is to do.

    Raises:
        ConfigError: if a value is missing.
    """
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        needed = " ".join(f"{key}=..." for key in missing)
        raise ConfigError(f"{missing[0]} is not set; add {needed} to the command line")
    plain = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    choices = OmegaConf.to_container(hydra_cfg.runtime.choices, resolve=True)
    assert isinstance(choices, dict)
    return Composed(
        {str(key): value for key, value in plain.items()},
        {str(key): value for key, value in choices.items()},
        tuple(hydra_cfg.overrides.task),
        str(hydra_cfg.runtime.output_dir),
    )


def options(cls: Callable[..., T], composed: Composed, table: Table) -> T:
    """Build a tool's options.

    Raises:
        ConfigError: for a key that nobody reads, or a value that the options refuse.
    """
    given = {key: value for key, value in composed.config.items() if key != words.PLUGINS.name}
    _check(given, "", table)
    for key in PATHS:
        if given.get(key) == "":
            raise ConfigError(f"{key}= is empty, perhaps from a shell variable that is not set; name a path")
    for key in ("checkpoint", "init_from", "resume"):
        if key in given:
            given[key] = _checkpoint(given[key], ("last",) if key == "resume" else ("best", "last"))
    return _build(cls, given, composed, table, "")


def _checkpoint(given: object, names: Sequence[str]) -> object:
    """Return the checkpoint in a run's folder; what is no such folder stays as it is."""
    files = [Path(str(given)).expanduser() / "checkpoints" / f"{name}.ckpt" for name in names]
    return next((str(file) for file in files if given and file.is_file()), given)


def _build(cls: Callable[..., T], given: Mapping[str, object], composed: Composed, table: Table, prefix: str) -> T:
    hints = typing.get_type_hints(cls)
    fields = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]  # a dataclass
    for key in given:
        if key not in fields:
            raise ConfigError(words.nearest(f"{prefix}{key}", [f"{prefix}{name}" for name in fields]))
    made = {key: _value(hints[key], value, composed, table, f"{prefix}{key}") for key, value in given.items()}
    return cls(**made)


def _value(annotation: object, value: object, composed: Composed, table: Table, key: str) -> object:
    if value is None:
        return None
    if typing.get_origin(annotation) in (Union, types.UnionType):
        for each in typing.get_args(annotation):
            if each is Spec or dataclasses.is_dataclass(each) or typing.get_origin(each) in _CONVERTED:
                return _value(each, value, composed, table, key)
    if annotation is Spec:
        assert isinstance(value, Mapping)
        return Spec(value, composed.choices.get(key.replace(".", "/")))
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        assert isinstance(value, Mapping)
        return _build(annotation, value, composed, table, f"{key}.")
    if isinstance(value, Mapping) and key in table.library:  # a config group of arguments
        return {name: each for name, each in value.items() if not str(name).startswith("_")}
    if typing.get_origin(annotation) is typing.Literal:
        return one_of(key, str(value), typing.get_args(annotation))
    if annotation is Path:
        return Path(str(value))
    if isinstance(value, list) and typing.get_origin(annotation) in (tuple, Sequence):
        item, *_ = typing.get_args(annotation)
        return tuple(_value(item, each, composed, table, key) for each in value)
    return value


def _check(given: Mapping[str, object], prefix: str, table: Table) -> None:
    """Check the keys of every component: Hydra's ``+`` adds keys that nobody reads."""
    node = table.by_path(given.get("_target_"))
    known = [key.name for key in node.keys] if node else []
    for key, value in given.items():
        if node and key not in known and not key.startswith("_"):
            raise ConfigError(words.nearest(f"{prefix}{key}", [f"{prefix}{name}" for name in known]))
        if isinstance(value, Mapping):
            _check(value, f"{prefix}{key}.", table)
