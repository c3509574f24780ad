"""The tools and everything configurable: plain data in a file, read instead of importing every component.

The file lies in the user's cache folder. It is valid only for the sources, installed packages and Python that it was
made from; otherwise it is made again, which imports everything once.
"""

from __future__ import annotations

import hashlib
import json
import os
import pkgutil
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import saunet
from saunet import schema
from saunet.errors import ConfigError
from saunet.registry import REGISTRIES, Entry

_TEXT = """\
train: train a depth network on driving video
    train experiment=selfsup data=kitti data.root=/data/kitti
    train experiment=smoke model/encoder=resnet18 epochs=2 lr=2e-4
    train -m sweep=loss_ablation experiment=smoke
    resume outputs/train/2026-01-31_12-00-00
predict input: depth of an image, a folder, a video or a camera, as pictures, points and videos
    predict road.png
    predict drive.mp4 checkpoint=last.ckpt output=out outputs=[mp4,html] camera=[90]
app checkpoints*: a page in the browser: drop a picture or a video, see its depth
    app
    app last.ckpt port=8000
evaluate checkpoint: score a checkpoint, or predictions made elsewhere
    evaluate runs/first
    evaluate last.ckpt data=kitti data.root=/data/kitti
    evaluate predictions=maps data=kitti
odometry checkpoint: the camera's path through whole sequences, with its errors
    odometry last.ckpt data.root=/data/kitti_odometry
export checkpoint: write a checkpoint as files to deploy or share, each checked against the network
    export last.ckpt output=exported
report runs*: one page of tables, curves and pictures from finished runs; how runs differ
    report outputs/train
    report compare outputs/train/A outputs/train/B
watch run: a running or finished training or sweep in the browser: curves, pictures, health
    watch outputs/train/2026-01-31_12-00-00
benchmark: parameters, FLOPs, time and memory of networks
    benchmark models=[sau_net,street]
    benchmark model/encoder=resnet18 sizes=192x640,320x1024
doctor: look at a data set before hours of training
    doctor data=kitti data.root=/data/kitti
calibrate input: make camera.yaml from a video or pictures of a board
    calibrate print_board=board.png
    calibrate board.mp4 columns=10 rows=7 square=0.025
    calibrate video=drive.mp4
prepare job: do once before training: dense depth, a teacher's depth, small images, clips of bags and GoPros, a pack
    prepare densify root=/data/kitti
    prepare import input=drive.bag folder=clips
components: list every registered component with its keys
    components encoder
demo: the README's demo: train on rendered video, evaluate, draw
    demo
    demo epochs=2
"""
"""Each tool's name, the key that plain words stand for (``*`` takes several), what it does, and examples."""


@dataclass(frozen=True, eq=False)
class Tool:
    """One tool: ``saunet predict`` calls `saunet.predict` with `saunet.PredictOptions`.

    Its function may also take ``choices``, ``overrides`` and ``describe`` (an error as one sentence) for the record of
    a run; its result is not printed then.
    """

    name: str
    summary: str
    examples: Sequence[str]
    positional: str = ""
    aliases: Mapping[str, str] = field(default_factory=dict)
    words: Mapping[str, str] = field(default_factory=dict)
    """First word -> its meaning."""
    function: str = ""
    """The function to call, as ``module:name``, if it is not the tool's name in saunet."""
    options: str | None = ""
    """The options it is called with; None if it parses the command line itself."""
    config: str = ""
    """The root config, if it is not named like the tool."""
    preset: Sequence[str] = ()
    """Overrides applied before those of the command line."""

    def paths(self) -> tuple[str, str]:
        """Return the locations of the options and the function, as ``module:name``."""
        return self.options or f"saunet:{self.name.title()}Options", self.function or f"saunet:{self.name}"


TOOLS = {
    name: Tool(name, summary, [line.strip() for line in examples.splitlines()], positional)
    for name, positional, summary, examples in re.findall(r"^(\w+) ?([\w*]*): (.*)\n((?: .*\n)+)", _TEXT, re.MULTILINE)
}
"""Every tool by name, in the order of ``saunet --help``."""
_SHORT = {"epochs": "trainer.max_epochs", "lr": "optim.lr", "batch": "data.batch_size"}
TOOLS["train"] = replace(TOOLS["train"], aliases=_SHORT)
TOOLS["doctor"] = replace(TOOLS["doctor"], aliases={"batch": "data.batch_size"})
TOOLS["evaluate"] = replace(TOOLS["evaluate"], function="saunet.evaluation.present:run")
TOOLS["report"] = replace(TOOLS["report"], words={"compare": "compare=true"})
TOOLS["components"] = replace(TOOLS["components"], function="saunet.cli.help:components", options=None)
TOOLS["demo"] = replace(
    TOOLS["demo"],
    aliases=_SHORT,
    function="saunet.cli.demo:demo",
    options="saunet:TrainOptions",
    config="train",
    preset=("experiment=demo",),
)
TRAINER = ("trainer", "lightning", "lightning:Trainer", "lightning.Trainer")
"""A config node that is not a component: its group and name, the class it configures, and the path to build it from."""
PLUGINS = schema.Key(
    "plugins",
    "list[str]",
    [],
    "Your own modules or .py files, imported first; they may register components.",
    annotation="list[str]",
)
"""The key that every tool has in addition to its options."""
HIDDEN = {"base", "lightning"}
"""Config group members that only serve as a base for others and are not offered."""
_IMPORTED = time.time_ns()
"""Roughly when this process imported the sources: a table made later from sources that changed since is not kept."""


def config_dir() -> Path:
    """Return the folder of the YAML files: inside the installed package, or ``conf/`` of a source checkout."""
    package = Path(saunet.__path__[0]).resolve()
    for folder in (package / "conf", package.parents[1] / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise ConfigError(f"no configuration files found beside {package}; reinstall saunet")


@dataclass(frozen=True, eq=False)
class Table:
    """Config keys."""

    tools: Mapping[str, schema.Node]
    """Tool -> the keys of its options."""
    components: Mapping[str, Mapping[str, schema.Node]]
    """Kind -> name -> the component's keys."""
    groups: Mapping[str, Mapping[str, schema.Node]]
    """Config group, such as ``model/encoder`` -> name -> keys."""

    def choices(self, group: str) -> list[str]:
        """Return the names that a config group offers."""
        registered = self.components["model"] if group == "model" else self.groups.get(group, {})
        files = {path.stem for path in (config_dir() / group).glob("*.yaml")}
        return sorted({*files, *registered} - HIDDEN)

    def known(self, tool: str, key: str) -> list[schema.Key]:
        """Return the values a key can take, from the tool's options or any component that has the key."""
        if own := self.tools[tool].key(key):
            return [own]
        nodes = [
            (node, key[len(group) + 1 :])
            for group, each in self.groups.items()
            for node in each.values()
            if key.startswith(f"{group.replace('/', '.')}.")
        ]
        return [found for node, rest in nodes if (found := node.key(rest))]

    def type(self, tool: str, key: str) -> str:
        """Return the type of a key as `saunet.schema.Key.type`; ``any`` for one that is not known."""
        found = {each.type for each in self.known(tool, key)}
        alike = {each.rstrip("?") for each in found}  # one data set may require a folder that another does not
        return "any" if len(alike) != 1 else found.pop() if len(found) == 1 else f"{alike.pop()}?"

    def by_path(self, path: object) -> schema.Node | None:
        """Return the keys of the component named by a ``_target_``; None if it is not a component."""
        return next((node for each in self.groups.values() for node in each.values() if node.path == path), None)

    def by_name(self, name: str) -> schema.Node | None:
        """Return the keys of a class, by its name alone, as in Hydra's messages."""
        found = [node for each in (self.tools, *self.groups.values()) for node in each.values()]
        inner = [key.node for node in found for key in node.keys if key.node]
        return next((node for node in [*found, *inner] if node.name == name), None)


def imported(path: str) -> Callable[..., object]:
    """Return what ``module:name`` names."""
    found: Callable[..., object] = pkgutil.resolve_name(path)
    return found


def read() -> Table:
    """Return the table, from the file or, where that is missing or outdated, made now and written.

    Components that plugins registered in this process are included but never written.
    """
    registered = tuple(entry for registry in REGISTRIES.values() for entry in registry.registered())
    return _read(_state(), os.environ.get("XDG_CACHE_HOME"), registered)


@lru_cache(maxsize=4)
def _read(state: str, cache_home: str | None, registered: tuple[Entry, ...]) -> Table:
    cache = Path(cache_home or Path.home() / ".cache")
    where = hashlib.sha256(f"{sys.executable} {saunet.__path__[0]}".encode()).hexdigest()[:12]
    file, plain = cache / "saunet" / f"keys-{where}.json", None
    with suppress(OSError, ValueError):
        plain = json.loads(file.read_bytes())
    if plain is None or plain["state"] != state:
        plain = {"state": state, **_make()}
        with suppress(OSError):  # without a cache folder it is merely slower
            if all(path.stat().st_mtime_ns <= _IMPORTED for path in _sources()):
                file.parent.mkdir(parents=True, exist_ok=True)
                temporary = file.with_suffix(f".{os.getpid()}")
                temporary.write_text(json.dumps(plain))
                temporary.replace(file)
    tools = {name: replace(each, keys=(*each.keys, PLUGINS)) for name, each in _nodes(plain["tools"]).items()}
    components = {kind: _nodes(each) for kind, each in plain["components"].items()}
    for kind, registry in REGISTRIES.items():
        for entry in registry.registered():
            if entry.name not in components[kind]:
                components[kind][entry.name] = schema.node(entry.target, entry.preset, registry.late)
            elif not entry.path.startswith("saunet."):
                registry.names()  # imports the built-in component of that name, which refuses the plugin's
    groups = {registry.group: components[kind] for kind, registry in REGISTRIES.items() if registry.group}
    return Table(tools, components, {**groups, TRAINER[0]: _nodes(plain["trainer"])})


def _nodes(plain: Mapping[str, Mapping[str, object]]) -> dict[str, schema.Node]:
    return {name: schema.Node.from_plain(each) for name, each in plain.items()}


def _sources() -> list[Path]:
    return sorted(Path(saunet.__path__[0]).rglob("*.py"))


def _state() -> str:
    """Return what the table depends on: our sources, the folders of installed packages, and Python."""
    sources = [path.stat() for path in _sources()]
    folders = [Path(each) for each in sys.path if Path(each).name in ("site-packages", "dist-packages")]
    packages = [each.stat().st_mtime_ns for each in folders if each.is_dir()]
    state = [sys.version, saunet.__version__, [(each.st_mtime_ns, each.st_size) for each in sources], packages]
    return hashlib.sha256(json.dumps(state).encode()).hexdigest()


def _make() -> dict[str, Mapping[str, object]]:
    own = [entry for each in REGISTRIES.values() for entry in each.registered() if entry.path.split(".")[0] != "saunet"]
    _, name, target, path = TRAINER
    options = {name: tool.paths()[0] for name, tool in TOOLS.items() if tool.options is not None}
    return {
        "tools": {name: asdict(schema.node(imported(path), path=None)) for name, path in options.items()},
        "components": {
            kind: {entry.name: asdict(registry.node(entry.name)) for entry in registry if entry not in own}
            for kind, registry in REGISTRIES.items()
        },
        "trainer": {name: asdict(schema.node(imported(target), path=path))},
    }
