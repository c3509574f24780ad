"""The only module that uses Hydra: it composes a tool's configuration, checks its types, and builds the tool's options.

Nothing is written for a single run: its folder appears with the first file that a tool writes, after its checks. In a
sweep each job has its own folder, a failed job does not stop the others, and every failure is listed at the end.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import re
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar, Union

import yaml
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.hydra import Hydra
from hydra._internal.sources_registry import SourcesRegistry
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import configure_log, setup_globals
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from hydra.version import setbase
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf._utils import get_yaml_loader

from saunet import schema
from saunet.cli.table import PLUGINS, TOOLS, TRAINER, Table, Tool, config_dir, read
from saunet.cli.words import hydra_value, unknown
from saunet.errors import ConfigError, one_of
from saunet.registry import Spec
from saunet.runs.folder import read as read_run
from saunet.weights.locate import of_run, run_of

T = TypeVar("T")
PATHS = ("checkpoint", "folder", "init_from", "input", "output", "output_dir", "predictions", "resume", "root")
"""Options that name files or folders."""
_OF_TRAINING = ("height", "width", "track_motion", "with_speed", "flip_prob", "color_jitter_prob", "crop_margin")
"""Settings of data that evaluation does not take over from a training; the size is that of the checkpoint."""
_SIZE = ("data.height", "data.width")
OF_SPLITS = {
    f"data.{key}"
    for key in (
        "split",
        "seed",
        "train_drives",
        *(f"{split}_{what}" for split in ("val", "test") for what in ("clips", "drives", "share")),
    )
}
"""Keys of data sets that decide which frames are trained on and which are held out."""
_CONVERTED = (tuple, Sequence, Mapping, typing.Literal)


class _Hydra(Hydra):
    """Hydra that checks a sweep with the first of its choices, because the choices of ``experiment=a,b`` bring keys."""

    def compose_config(
        self, config_name: str | None, overrides: list[str], run_mode: RunMode, *args: bool, **kwargs: bool
    ) -> DictConfig:
        swept: dict[str, str] = {}
        if run_mode is RunMode.MULTIRUN:
            for each in OverridesParser.create(self.config_loader).parse_overrides(overrides):
                if each.is_sweep_override() and self.config_loader.get_group_options(each.key_or_group):
                    swept[str(each.input_line)] = f"{each.get_key_element()}={next(each.sweep_string_iterator())}"
        with_first = [swept.get(word, word) for word in overrides]
        cfg: DictConfig = super().compose_config(config_name, with_first, run_mode, *args, **kwargs)
        if swept:
            given = {first: word for word, first in swept.items()}
            task = OmegaConf.to_container(cfg.hydra.overrides.task, resolve=False)  # some refer to a job
            assert isinstance(task, list)
            cfg.hydra.overrides.task = [given.get(str(word), word) for word in task]
        return cfg


@contextmanager
def hydra(tool: Tool, table: Table, extra: str | None = None) -> Iterator[Hydra]:
    """Return Hydra with the keys of a tool and of all components; an extra folder of YAML files comes first."""
    _register(table)
    _register_tool(table, tool)
    setbase("1.3")
    setup_globals()
    path = create_config_search_path(str(config_dir()))
    if extra is not None:
        if not Path(extra).is_dir():
            raise ConfigError(f"--config-dir is {extra}, which is not a folder; check the path")
        first = f"file://{Path(extra).resolve()}"
        path.prepend(provider="command-line", path=first, anchor=SearchPathQuery(provider="schema"))
    GlobalHydra.instance().clear()
    Plugins.instance()  # which registers the sources, of which ours replaces one
    sources = SourcesRegistry.instance().types
    usual = sources["file"]
    sources["file"] = _source(tool.name, table)
    try:
        yield _Hydra.create_main_hydra2(task_name=tool.name, config_search_path=path)
    finally:
        sources["file"] = usual
        GlobalHydra.instance().clear()


def _source(tool: str, table: Table) -> type[FileConfigSource]:
    """Return a YAML loader that keeps text as written where YAML would see a number, as in ``2024_05_01``."""

    def keep_text(node: yaml.Node, key: str) -> None:
        if isinstance(node, yaml.MappingNode):
            for name, value in node.value:
                keep_text(value, f"{key}.{name.value}" if key else name.value)
        elif isinstance(node, yaml.SequenceNode):
            for each in node.value:
                keep_text(each, key)
        elif not node.tag.endswith(":null") and table.type(tool, key).rstrip("?") in ("str", "list[str]"):
            node.tag = "tag:yaml.org,2002:str"

    class Source(FileConfigSource):
        def load_config(self, config_path: str) -> ConfigResult:
            text = Path(self.path, self._normalize_file_name(config_path)).read_text("utf-8")
            header = self._get_header_dict(text)
            loader = get_yaml_loader()(text)
            root = loader.get_single_node()
            config = OmegaConf.create()
            if root is not None:
                package = header.get("package") or config_path.rpartition("/")[0].replace("/", ".")
                keep_text(root, "" if package == "_global_" else package)
                config = OmegaConf.create(loader.construct_document(root))
            return ConfigResult(self.provider, f"{self.scheme()}://{self.path}", config, header)

    return Source


def register_configs() -> None:
    """Give Hydra the typed keys of all tools and components, for ``hydra.compose``."""
    table = read()
    _register(table)
    for tool in TOOLS.values():
        if tool.options is not None:
            _register_tool(table, tool)


@functools.cache
def _register_tool(table: Table, tool: Tool) -> None:
    node = table.tools[tool.name]
    # The trainer group's members bring the types of its keys.
    keys = (dataclasses.replace(key, type="any") if key.name == TRAINER[0] else key for key in node.keys)
    made = structured(dataclasses.replace(node, keys=tuple(keys)))
    ConfigStore.instance().store(name=f"{tool.config or tool.name}_schema", node=made)


@functools.lru_cache(maxsize=1)  # the latest table is what the store holds
def _register(table: Table) -> None:
    store = ConfigStore.instance()
    for group, nodes in table.groups.items():
        for name, each in nodes.items():
            store.store(group=group, name=name, node=structured(each))
    for name, each in table.components["model"].items():  # a choice of choices
        parts = [{key.name: key.default} for key in each.keys if f"model/{key.name}" in table.groups]
        rest = {key.name: key.default for key in each.keys if f"model/{key.name}" not in table.groups}
        store.store(group="model", name=name, node={"defaults": parts, **rest})


def structured(node: schema.Node) -> type:
    """Return the dataclass with which OmegaConf checks a node's keys and types."""
    fields: list[tuple[str, object, object]] = []
    if node.path is not None:
        fields += [("_target_", str, node.path), ("_convert_", str, "all")]
    if node.partial:
        fields.append(("_partial_", bool, True))
    for key in node.keys:
        if key.node is not None:
            made = structured(key.node)
            fields.append((key.name, made, dataclasses.field(default_factory=made)))
        elif isinstance(key.default, list | dict):
            fields.append((key.name, schema.python_type(key.type), dataclasses.field(default_factory=key.default.copy)))
        else:
            fields.append((key.name, schema.python_type(key.type), key.default))
    return dataclasses.make_dataclass(node.name, fields)


@dataclasses.dataclass(frozen=True)
class Composed:
    """A tool's configuration."""

    config: Mapping[str, object]
    """As plain data, resolved."""
    choices: Mapping[str, str | None]
    """Config group -> the choice."""
    overrides: tuple[str, ...]
    """The overrides of the command line."""
    folder: str
    """The run's folder, from ``hydra.run.dir``; it may not exist yet."""


def single(hydra: Hydra, name: str, overrides: list[str]) -> Composed | None:
    """Compose the configuration of one run; None if it asks for a sweep by itself."""
    try:
        cfg = hydra.compose_config(name, overrides, RunMode.RUN)
    except Exception as error:  # a YAML file may ask for a sweep
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


def effective(
    hydra: Hydra, name: str, overrides: list[str], multirun: bool
) -> tuple[dict[str, object], dict[str, str]]:
    """Return the values that a command has, by dotted key and not resolved, and the choice of each config group."""
    cfg = hydra.compose_config(name, overrides, RunMode.MULTIRUN if multirun else RunMode.RUN)
    chosen = {str(group): str(each) for group, each in cfg.hydra.runtime.choices.items() if each is not None}
    with open_dict(cfg):
        del cfg["hydra"]
    return dict(_flat(OmegaConf.to_container(cfg), "")), chosen


def _flat(node: object, prefix: str) -> Iterator[tuple[str, object]]:
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield from _flat(value, f"{prefix}{key}.")
    else:
        yield prefix.removesuffix("."), node


def of_job(cfg: DictConfig, hydra_cfg: DictConfig) -> Composed:
    """Return the configuration of a single run or of one job of a sweep."""
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        needed = " ".join(f"{key}=..." for key in missing)
        raise ConfigError(f"{missing[0]} is not set; add {needed} to the command line")
    choices, overrides = _plain(hydra_cfg.runtime.choices), tuple(hydra_cfg.overrides.task)
    chosen = {group: None if name is None else str(name) for group, name in choices.items()}
    return Composed(_plain(cfg), chosen, overrides, str(hydra_cfg.runtime.output_dir))


def parsed(overrides: Sequence[str]) -> dict[str, object]:
    """Return the keys that overrides set, with their values."""
    made = OverridesParser.create().parse_overrides(list(overrides))
    return {each.get_key_element().lstrip("+~"): each.value() for each in made}


def recorded_data(checkpoint: str, table: Table, *, needed: bool = True) -> tuple[list[str], Path | None]:
    """Return the overrides that choose the data of the run which a checkpoint belongs to, and the run's folder.

    There are none for a checkpoint without a run, or without a choice of data in its record.

    Raises:
        ConfigError: if they are needed and the data set is of a plugin that is not loaded.
    """
    path = Path(checkpoint).expanduser()
    folder = path if path.is_dir() else run_of(path.absolute())
    record = read_run(folder) if folder is not None else {}
    name, config = (record.get("choices") or {}).get("data"), (record.get("config") or {}).get("data")
    if not name or not isinstance(config, Mapping):
        return [], None
    node = table.groups["data"].get(name)
    if node is None and not needed:
        return [], None
    if node is None:
        words = (word for word in record.get("overrides") or () if word.startswith(f"{PLUGINS.name}="))
        plugin = next(words, f"{PLUGINS.name}=[FILE]")
        raise ConfigError(
            f"{folder} was trained on data={name}, which is not registered here; add {plugin}, or choose data=..."
        )
    values = {key.name: config[key.name] for key in node.keys if key.name in config and key.name not in _OF_TRAINING}
    if any(isinstance(value, Mapping) for value in values.values()):  # a mixture's sources, each chosen by itself
        return [word for word in record.get("overrides") or () if re.match(r"[+~]*data[.=@]", word)], folder
    defaults = {key.name: key.default for key in node.keys}
    changed = {key: value for key, value in values.items() if value != defaults[key]}
    return [f"data={name}", *(f"data.{key}={hydra_value(value)}" for key, value in changed.items())], folder


def _plain(cfg: DictConfig) -> dict[str, object]:
    plain = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def options(cls: Callable[..., T], composed: Composed, table: Table) -> T:
    """Build a tool's options; an unused key is an error."""
    given = {key: value for key, value in composed.config.items() if key != PLUGINS.name}
    _check(given, "", table)
    for key in PATHS:
        if given.get(key) == "":
            raise ConfigError(f"{key}= is empty, perhaps because a shell variable is not set; give a path")
    for key, names in (("checkpoint", ("best", "last")), ("init_from", ("best", "last")), ("resume", ("last",))):
        if given.get(key):  # a run's folder stands for the checkpoint in it
            folder = Path(str(given[key])).expanduser()
            found = of_run(folder, names)
            given[key] = given[key] if found == folder else str(found)
    return _build(cls, given, composed.choices, "")


def check_size(composed: Composed, options: object) -> None:
    """Refuse an image size on a command line that scores a model of another size: images are read at the model's.

    Raises:
        ConfigError: if the sizes differ.
        CheckpointError: if the model cannot be read.
    """
    given = [key for key in _SIZE if key in parsed(composed.overrides)]
    checkpoint, data = getattr(options, "checkpoint", None), composed.config.get("data")
    if not given or checkpoint is None or not isinstance(data, Mapping):
        return
    from saunet.prediction.prediction import load

    model = load(checkpoint, foreign=getattr(options, "foreign", None))
    own = {"data.height": model.height, "data.width": model.width}
    asked = {key: data[key.removeprefix("data.")] for key in given}
    if any(asked[key] != own[key] for key in given):
        told = " and ".join(f"{key} is {value}" for key, value in asked.items())
        raise ConfigError(
            f"{told}, but {composed.config['checkpoint']} takes images of {model.height}x{model.width} "
            "(height x width) and is scored at that size; leave the size out, or train a model of the wanted size"
        )


def _check(given: Mapping[str, object], prefix: str, table: Table) -> None:
    """Check the keys of every component: Hydra's ``+`` adds keys without checking them."""
    node = table.by_path(given.get("_target_"))
    known = [key.name for key in node.keys] if node else []
    for key, value in given.items():
        if node and key not in known and not key.startswith("_"):
            raise unknown(f"{prefix}{key}", [f"{prefix}{name}" for name in known])
        if isinstance(value, Mapping):
            _check(value, f"{prefix}{key}.", table)


def _build(cls: Callable[..., T], given: Mapping[str, object], choices: Mapping[str, str | None], prefix: str) -> T:
    hints = typing.get_type_hints(cls)
    fields = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]  # a dataclass
    for key in given:
        if key not in fields:
            raise unknown(f"{prefix}{key}", [f"{prefix}{name}" for name in fields])
    return cls(**{key: _value(hints[key], value, choices, f"{prefix}{key}") for key, value in given.items()})


def _value(annotation: object, value: object, choices: Mapping[str, str | None], key: str) -> object:
    """Return what the options' annotation asks for: a `Spec`, nested options, a path, a tuple or the plain value."""
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if value is None:
        return None
    if origin in (Union, types.UnionType):
        for each in inner:
            if each is Spec or dataclasses.is_dataclass(each) or typing.get_origin(each) in _CONVERTED:
                return _value(each, value, choices, key)
    if isinstance(value, Mapping):
        if annotation is Spec:
            return Spec(value, choices.get(key.replace(".", "/")))
        if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
            return _build(annotation, value, choices, f"{key}.")
        if key == TRAINER[0]:  # a config group of arguments
            return {name: each for name, each in value.items() if not str(name).startswith("_")}
    if origin is typing.Literal:
        return one_of(key, str(value), inner)
    if annotation is Path:
        return Path(str(value))
    if isinstance(value, list) and origin in (tuple, Sequence):
        return tuple(_value(inner[0], each, choices, key) for each in value)
    return value


class Failed:
    """The result of a job that failed and reported it."""


def sweep(hydra: Hydra, name: str, overrides: list[str], task: Callable[[bool, DictConfig], object]) -> int:
    """Run a job for each combination of the values given, and return the exit code.

    A job's task gets its configuration, and whether to raise its errors, as a search needs.
    """
    from saunet.runs.folder import FILE, locked
    from saunet.runs.sweep import PLAN, summary, write_plan

    # Each job prints its own name instead.
    logging.getLogger("hydra._internal.core_plugins.basic_launcher").setLevel(logging.WARNING)
    cfg = hydra.compose_config(name, overrides, RunMode.MULTIRUN)
    HydraConfig.instance().set_config(cfg)
    folder = Path(str(OmegaConf.select(cfg, "hydra.sweep.dir"))).absolute()
    planned = _planned(cfg)
    HydraConfig.instance().cfg = None
    ended: BaseException | None = None
    with locked(folder):
        if planned:
            write_plan(folder, planned)
        try:
            returned = hydra.multirun(name, functools.partial(task, not planned), overrides)
            jobs = [job for batch in returned for job in batch] if planned else []
            code = 1 if any(isinstance(job.return_value, Failed) for job in jobs) else 0
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            ended, code = error, 130 if isinstance(error, KeyboardInterrupt) else 1
    if isinstance(ended, Exception) and not any(folder.glob("**/.hydra")):  # no job was started
        for file in (PLAN, "multirun.yaml"):
            (folder / file).unlink(missing_ok=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        raise ended
    if any(folder.glob(f"**/{FILE}")):
        text, finished = summary(folder, planned)
    else:  # of a tool that keeps no record of a run
        finished = code == 0
        text = f"sweep: {len(planned) if finished else 'not all'} jobs finished; results: {folder}"
    print(text, file=sys.stdout if finished else sys.stderr)
    if isinstance(ended, SystemExit):  # a training that was asked to stop says how to resume
        raise ended
    return 0 if finished else code or 1


def _planned(cfg: DictConfig) -> list[list[str]]:
    """Return the overrides of every job; none if another sweeper than Hydra's own chooses them."""
    if "BasicSweeper" not in cfg.hydra.sweeper._target_:
        return []
    params = [f"{key}={value}" for key, value in (cfg.hydra.sweeper.params or {}).items()]
    # Unresolved: some refer to a job, and there is none now.
    given = OmegaConf.to_container(cfg.hydra.overrides.task, resolve=False)
    assert isinstance(given, list)
    parsed = OverridesParser.create().parse_overrides([*params, *map(str, given)])
    return [list(job) for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]


def check_job(config: Mapping[str, object], job: str) -> None:
    """Check that a job writes only to its own folder of the sweep, and does not start the sweep again."""
    folder = config.get("output_dir")
    if folder:  # an empty one is refused below
        given, own = Path(str(folder)).resolve(), Path(job).resolve()
        if own != given and own not in given.parents:
            raise ConfigError(
                f"output_dir is '{folder}' and the jobs of a sweep must not share a folder; leave it out and set "
                f"hydra.sweep.dir={folder}, where each job gets a folder of its own"
            )
    trainer = config.get("trainer")
    if isinstance(trainer, Mapping) and _replays(trainer):
        raise ConfigError(
            "--multirun with several processes per job would replay the whole sweep on every process; use one "
            "process per job, or start each training with its own command, for example in a shell loop"
        )


def _replays(trainer: Mapping[str, object]) -> bool:
    """Return whether a trainer will start further processes by running this command again."""
    strategy = str(trainer.get("strategy", "auto")).lower()  # a name, or a node with a _target_
    several = str(trainer.get("devices", 1)) not in ("1", "[0]", "auto") or trainer.get("num_nodes", 1) not in (1, None)
    return several or any(kind in strategy for kind in ("ddp", "fsdp", "deepspeed"))
