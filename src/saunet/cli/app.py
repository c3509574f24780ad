"""The command ``saunet``: its words become overrides, Hydra composes them, and a tool is called with its options.

Hydra's grammar turns ``2024_05_01`` into a number and stumbles over ``=`` and brackets in a path: values of keys that
hold text or a list are quoted or put into a list first.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import functools
import gc
import inspect
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, Protocol, cast, runtime_checkable

from saunet import __version__, plugins
from saunet.cli.table import PLUGINS, TOOLS, Table, Tool, config_dir, imported, read
from saunet.errors import ELSEWHERE, ConfigError, SaunetError, suggest
from saunet.threads import wait_briefly

if TYPE_CHECKING:
    from types import FrameType

    from omegaconf import DictConfig

    from saunet import schema
    from saunet.cli.compose import Composed


_OVERRIDE = re.compile(r"(?P<sign>\+{0,2}|~)(?P<key>[\w@/.:][\w@/.:-]*)=(?P<value>.*)", re.DOTALL)
_GLOB = re.compile(r"""['"]?glob\(['"]?(?P<pattern>[^,()'"]*/[^,()'"]*)['"]?\)['"]?""")
_FUNCTION = re.compile(
    r"(choice|range|interval|glob|sort|shuffle|tag|extend_list|int|float|str|bool|json_str)\(.*\)", re.DOTALL
)
_PLAIN = re.compile(r"[A-Za-z/.~-][\w/.~-]*|\d+[A-Za-z/-][\w/.~-]*")
_NOT_TEXT = re.compile(r"true|false|yes|no|on|off|null|none|inf|nan|~|\d+e\d+", re.IGNORECASE)


@runtime_checkable
class Partial(Protocol):
    """A result of which some parts failed, each said in one sentence."""

    failures: Sequence[str]


@runtime_checkable
class Shown(Protocol):
    """A result that prints itself, in colors and at the terminal's width; others are printed as text."""

    show: Callable[[], None]


@runtime_checkable
class Graded(Protocol):
    """A result that decides the exit code."""

    exit_code: int


RESUME = "continue a stopped training in its folder, with its own settings"
RESUME_HELP = """\
RUN is the run's folder, the one with run.json. Its command line is repeated from its last checkpoint; relative paths in
it start at the current folder. What follows differs: `saunet resume RUN epochs=20` trains longer. `saunet train --help`
lists the keys."""


@runtime_checkable
class Costed(Protocol):
    """A result with a number that a search over sweeps minimizes; None if there is none."""

    cost: float | None


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of ``saunet``."""
    tool, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    run(tool, rest)


def _end_if_unread() -> None:
    """End, where the reader of what is printed has gone, as a program does that SIGPIPE ends."""
    try:
        print(flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is buffered goes nowhere
        raise SystemExit(128 + 13) from None


def overview() -> str:
    """Return what ``saunet --help`` prints."""
    width = max(map(len, TOOLS))
    lines = [f"saunet {__version__}: self-supervised monocular depth", "", "usage: saunet TOOL [KEY=VALUE ...]", ""]
    for name, tool in TOOLS.items():
        lines += [f"  {name:{width}}  {tool.summary}", f"  {'':{width}}  $ saunet {tool.examples[0]}"]
        if name == "train":
            lines += [f"  {'resume':{width}}  {RESUME}", f"  {'':{width}}  $ saunet resume outputs/train/RUN"]
    return "\n".join([*lines, "", "`saunet TOOL --help` lists a tool's keys; --completion bash|zsh|fish sets up Tab."])


def run(name: str, argv: Sequence[str]) -> None:
    """Run a tool with the words of a command line; ends in `SystemExit` with the code, unless all went well.

    What a user can mend is said in one sentence; only a defect of the program shows a traceback.
    ``HYDRA_FULL_ERROR=1`` shows it always. It ends quietly when nobody reads what it prints, as after ``| head``.
    """
    wait_briefly()
    try:
        with _ended_by_signals():
            code = _run(name, argv)
            if sys.stdout is not None:  # without a console there is none
                sys.stdout.flush()
    except KeyboardInterrupt:
        code = _say(name, "interrupted", 130)
    except SystemExit as stop:  # a run that was asked to stop says how to resume
        if not stop.code or str(stop) == str(stop.code):
            raise
        code = _say(name, str(stop), int(stop.code) if isinstance(stop.code, int) else 1)
    except Exception as error:
        if isinstance(error, BrokenPipeError):
            _end_if_unread()
        from saunet.cli.errors import sentence

        # A process that DDP started inherits the variable.
        debug = os.environ.get("HYDRA_FULL_ERROR") == "1" and "LOCAL_RANK" not in os.environ
        said = None if debug else sentence(error, None if isinstance(error, SaunetError) else read())
        if said is None:
            raise
        code = _say(name, said, 1)
    if code:
        raise SystemExit(code)


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end a tool as Ctrl-C does, tidily and with a word; a training saves first."""

    def stop(number: int, _: object) -> NoReturn:
        from saunet.runs.folder import Stopped

        # A signal to the whole process group ends torch's loader processes too. Its handler for that raises wherever
        # the program is, and would make a failure of the stop that is under way.
        if hasattr(signal, "SIGCHLD"):
            before[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, lambda *_: None) or signal.SIG_DFL
        raise Stopped(f"stopped by {signal.Signals(number).name}; what is complete stays", 128 + number)

    main = threading.current_thread() is threading.main_thread()
    wanted = [getattr(signal, each) for each in ("SIGTERM", "SIGHUP") if main and hasattr(signal, each)]
    before: dict[int, Callable[[int, FrameType | None], object] | int | None] = {
        each: signal.signal(each, stop) for each in wanted if signal.getsignal(each) == signal.SIG_DFL
    }
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def _say(name: str, message: str, code: int) -> int:
    print(f"saunet {name}: {message}", file=sys.stderr)
    return code


def _run(name: str, argv: Sequence[str]) -> int:
    if name in ("-h", "--help", "help"):
        print(overview())
        return 0
    if name in ("-V", "--version", "version") or {"-V", "--version"} & set(argv):
        print(f"saunet {__version__}")
        return 0
    if name not in (*TOOLS, "resume", "--completion", "--complete"):
        hint = suggest(name, TOOLS) or f"; the tools are {', '.join(TOOLS)}"
        sys.exit(f"saunet: the first word is a tool, not '{name}'{hint}")
    from saunet.cli import help as help_

    if name.startswith("--"):
        print("\n".join((help_.complete if name == "--complete" else help_.completion)(argv[0] if argv else "")))
        return 0
    if name == "resume":
        if {"-h", "--help"} & set(argv):
            print(f"saunet resume: {RESUME}\n\nusage: saunet resume RUN [KEY=VALUE ...]\n\n{RESUME_HELP}")
            return 0
        name, argv = "train", resumed(argv)
    tool = TOOLS[name]
    argv = [tool.words.get(argv[0], argv[0]), *argv[1:]] if argv else []
    if tool.options is None:  # it reads its words itself
        imported(tool.function)(argv)
        return 0
    plugins.load(named_plugins(argv))
    table = read()
    flags, overrides = read_words(argv, tool, table)
    from saunet.cli import compose

    config, given = flags.config_name or tool.config or name, [*tool.preset, *overrides]
    with compose.hydra(tool, table, flags.config_dir) as hydra:
        if flags.help:
            print(help_.tool_help(tool, table, *compose.effective(hydra, config, given, flags.multirun)))
            return 0
        if flags.cfg:
            hydra.show_cfg(config, given, flags.cfg, flags.package, flags.resolve)
            return 0
        if flags.info:
            hydra.show_info(flags.info, config, given)
            return 0
        composed = None if flags.multirun else compose.single(hydra, config, given)
        if composed is None:
            return compose.sweep(hydra, config, [*given, "hydra.mode=MULTIRUN"], functools.partial(job, name))
    # What starts further processes runs this command again, with the same folder.
    kept = {"--config-dir": flags.config_dir, "--config-name": flags.config_name}
    again = [*overrides, *(f"{option}={value}" for option, value in kept.items() if value)]
    sys.argv[1:] = [name, *again, f"hydra.run.dir='{composed.folder}'"]
    return call(name, composed, table)[0]


def resumed(words: Sequence[str]) -> list[str]:
    """Return the command line that continues a run from its last checkpoint, given its folder and what shall differ."""
    from saunet.runs import folder as runs

    folder = Path(words[0]).absolute() if words else Path()
    content = runs.read(folder) if words else {}
    if not content:
        given = " ".join(words) or "none"
        raise ConfigError(f"saunet resume takes the folder of a run, with its run.json; got {given}")
    again = [word for word in content.get("overrides", []) if not word.startswith("resume=")]
    return [*again, f"resume={folder / 'checkpoints' / 'last.ckpt'}", f"hydra.run.dir='{folder}'", *words[1:]]


def call(name: str, composed: Composed, table: Table) -> tuple[int, object]:
    """Call a tool's function, print what it returns, and return the exit code and the result."""
    from saunet.cli import compose
    from saunet.cli.errors import sentence
    from saunet.cli.log import quiet

    made, called = map(imported, TOOLS[name].paths())
    options = compose.options(made, composed, table)
    record = {"choices": composed.choices, "overrides": composed.overrides, "describe": sentence}
    wanted = inspect.signature(called).parameters
    quiet()
    if gc.get_freeze_count() == 0:  # not before each job of a sweep, whose remains would stay for good
        gc.freeze()  # what is imported stays: to search it for garbage again and again doubles the time of an index
    result = called(options, **{key: value for key, value in record.items() if key in wanted})
    first = os.environ.get("RANK", "0") == "0"  # of the processes that torchrun started, if it did
    if isinstance(result, Shown) and first:
        result.show()
    elif result is not None and "describe" not in wanted and first:
        print(result)
    if isinstance(result, Partial):
        for failure in result.failures:
            _say(name, failure, 1)
    return (result.exit_code if isinstance(result, Graded) else 0), result


def job(name: str, raising: bool, cfg: DictConfig) -> object:
    """Do one job of a sweep, perhaps in another process, and return what a search minimizes.

    What goes wrong is said at once and ends this job only.
    """
    from hydra.core.hydra_config import HydraConfig

    from saunet.cli import compose
    from saunet.cli.errors import sentence

    hydra, own = HydraConfig.get(), False
    _say(name, f"job {hydra.job.num}: {hydra.job.override_dirname}", 0)
    try:
        plugins.load(cfg.plugins)
        composed = compose.of_job(cfg, cast("DictConfig", hydra))
        compose.check_job(composed.config, composed.folder)
        own = True
        code, result = call(name, composed, read())
        if code:
            raise ConfigError("some of it failed")
    except Exception as error:
        if own and "describe" in inspect.signature(imported(TOOLS[name].paths()[1])).parameters:
            from saunet.runs.folder import record_failed_start

            record_failed_start(composed.folder, name, error, sentence, overrides=list(composed.overrides))
        reason = sentence(error) or f"{type(error).__name__}: {error}"
        _say(name, f"job {hydra.job.num} ({hydra.job.override_dirname}) failed: {reason}", 1)
        if raising:
            raise
        return compose.Failed()
    return result.cost if isinstance(result, Costed) else None


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; see --help")


def split(words: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return Hydra's options and the other words."""
    parser = _Parser(add_help=False, allow_abbrev=False)
    for names in (("-h", "--help"), ("-m", "--multirun"), ("--resolve",), ("-r", "--run")):
        parser.add_argument(*names, action="store_true")
    for names in (("-p", "--package"), ("-cd", "--config-dir"), ("-cn", "--config-name")):
        parser.add_argument(*names)
    parser.add_argument("-c", "--cfg", choices=["job", "hydra", "all"])
    parser.add_argument("-i", "--info", nargs="?", const="all")
    flags, rest = parser.parse_known_args(words)
    for word, following in zip(rest, [*rest[1:], "VALUE"], strict=False):
        if word.startswith("-") and not _OVERRIDE.fullmatch(word) and not re.fullmatch(r"-[\d.]+", word):
            key = word.lstrip("-").replace("-", "_")
            said = key if "=" in key else f"{key}={following}"
            raise ConfigError(f"there is no option {word}; settings are written without dashes: {said}")
    return flags, rest


def choices(overrides: Sequence[str]) -> dict[str, str]:
    """Return what overrides choose: ``{"data": "kitti"}`` for ``data=kitti``."""
    found = (_OVERRIDE.fullmatch(word) for word in overrides)
    return {each["key"]: each["value"] for each in found if each and "." not in each["key"]}


def is_plugins(word: str) -> bool:
    return word.lstrip("+").startswith(f"{PLUGINS.name}=")


def named_plugins(words: Sequence[str]) -> list[str]:
    """Return the plugins that a command line names, which have to be imported before the rest is understood."""
    given = [word.partition("=")[2] for word in words if is_plugins(word)]
    lists = (value[1:-1] if value.startswith("[") and value.endswith("]") else value for value in given)
    return [item.strip().strip("'\"") for each in lists for item in _parts(each)]


def read_words(
    words: Sequence[str], tool: Tool, table: Table, conf: Path | None = None
) -> tuple[argparse.Namespace, list[str]]:
    """Return Hydra's options and, in its grammar, the overrides among the words after ``saunet TOOL``.

    ``conf`` has the YAML files that ``experiment=glob(table3/*)`` sees, where they are not the usual ones.
    """
    flags, rest = split(words)
    sweeping = flags.multirun or any(word.startswith(("sweep=", "hydra.mode=MULTIRUN")) for word in rest)
    own = flags.config_dir is None and flags.config_name is None
    return flags, _Reader(tool, table, sweeping, own, conf or config_dir()).overrides(rest)


@dataclass(frozen=True)
class _Reader:
    tool: Tool
    table: Table
    sweeping: bool
    own: bool
    """Whether all YAML files are ours, so that a key that they do not have is a mistake: told before Hydra starts."""
    conf: Path

    def overrides(self, words: Sequence[str]) -> list[str]:
        made, plain = [], []
        for word in words:
            found = _OVERRIDE.fullmatch(word)
            if found is None and word.startswith("~"):
                made.append(word)
            elif found is None or (self.tool.positional and not self._is_key(found["key"]) and _is_place(word)):
                plain.append(word)
            else:
                key = self.tool.aliases.get(found["key"], found["key"])
                made += self._override(found["sign"], key, found["value"])
        return [*made, *self._positional(plain, words)]

    def _is_key(self, key: str) -> bool:
        first = re.split(r"[./@]", key)[0]
        return first == "hydra" or bool(self.table.known(self.tool.name, first)) or (self.conf / first).is_dir()

    def _short(self, own: schema.Node) -> list[str]:
        return [*self.tool.aliases, *(["size"] if own.key("data") and not own.key("size") else [])]

    def _below(self, own: schema.Node) -> Iterator[str]:
        """Yield the keys below those of the tool: of nested options, and of the components that it takes."""
        for key in own.keys:
            yield from (f"{key.name}.{each.name}" for each in (key.node.keys if key.node else ()))
        for group, nodes in self.table.groups.items():
            if own.key(group.replace("/", ".")):
                yield from (f"{group.replace('/', '.')}.{key.name}" for node in nodes.values() for key in node.keys)

    def _positional(self, plain: Sequence[str], words: Sequence[str]) -> list[str]:
        if not plain:
            return []
        key = self.tool.positional
        if not key or (len(plain) > 1 and not key.endswith("*")):
            model = key == "input" and self.table.tools[self.tool.name].key("checkpoint") is not None
            hint = f"; if it is the model, write checkpoint={plain[-1]}" if key and model else ""
            hint += "; several images are a folder or a pattern" if key and model else ""
            raise ConfigError(
                f"'{plain[-1]}' is not KEY=VALUE{hint}; see `saunet {self.tool.name} --help` for the keys"
            )
        name = key.rstrip("*")
        if any(word.startswith(f"{name}=") for word in words):
            raise ConfigError(f"{name} is given twice, as {name}=... and as {plain[0]}; leave out one")
        quoted = ",".join(map(_quoted, plain))
        return [f"{name}=[{quoted}]" if key.endswith("*") else f"{name}={quoted}"]

    def _override(self, sign: str, key: str, value: str) -> list[str]:
        own = self.table.tools[self.tool.name]
        if glob := _GLOB.fullmatch(value):
            return [f"{sign}{key}={','.join(self._matching(key, glob['pattern']))}"]
        if self.own and not sign and key != "size" and not self._is_key(key):
            raise unknown(key, [each.name for each in own.keys], [*self._short(own), *self._below(own)])
        size = re.fullmatch(r"(\d+)x(\d+)", value) if key == "size" and own.key("size") is None else None
        if size:  # of images, height x width
            return [f"data.height={size[1]}", f"data.width={size[2]}"]
        if key == "size" and own.key("size") is None and own.key("data") and not sign:
            raise ConfigError(f"size is '{value}'; it needs height x width, such as size=192x640")
        if key == "data" and own.key("data") and self._is_path(value):
            return [f"{sign}data=video", f"data.root={self._meant(value, 'str')}"]
        group = key.replace(".", "/")
        if "." in key and value in self.table.groups.get(group, {}):
            raise ConfigError(f"{key}={value} sets a value; choose a component with a slash: {group}={value}")
        return [f"{sign}{key}={self._meant(value, self.table.type(self.tool.name, key).rstrip('?'))}"]

    def _is_path(self, value: str) -> bool:
        """Return whether ``data=`` names a video or a folder instead of a data module."""
        return value not in self.table.choices("data") and "${" not in value and ("/" in value or Path(value).exists())

    def _meant(self, value: str, kind: str) -> str:
        """Return a value as Hydra reads it back unchanged, for a key of this type."""
        if value in ("", "null", "???") or "${" in value or _FUNCTION.fullmatch(value):
            return value
        parts = _parts(value) if self.sweeping else [value]
        if kind == "str":
            return ",".join(map(_quoted, parts))
        return ",".join(_list(each, kind) for each in parts) if kind.startswith("list[") else value

    def _matching(self, group: str, pattern: str) -> list[str]:
        """Return the names below a group that a pattern matches; Hydra's own glob sees the files of one folder only."""
        folder = self.conf / group
        names = sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))
        matching = fnmatch.filter(names, pattern)
        if not matching:
            raise ConfigError(f"{group}=glob({pattern}) matches none of: {', '.join(names) or 'no files'}")
        return matching


def _is_place(word: str) -> bool:
    """Return whether a word with ``=`` in it is an address or a file."""
    return "://" in word.partition("=")[0] or Path(word).exists()


def _list(value: str, kind: str) -> str:
    if value.startswith("[") and value.endswith("]"):
        items = _parts(value[1:-1])
    else:
        items = [value] if Path(value).exists() else _parts(value)
    return f"[{','.join(_quoted(item.strip()) if kind.startswith('list[str') else item for item in items)}]"


def _quoted(text: str) -> str:
    """Return text in quotes, where Hydra would read it as something else without."""
    if len(text) > 1 and text[0] in "'\"" and text[-1] == text[0]:
        return text
    if (_PLAIN.fullmatch(text) and not _NOT_TEXT.fullmatch(text)) or "${" in text:
        return text
    escaped = re.sub(r"(\\*)'", lambda quote: quote[1] * 2 + "\\'", text)
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return f"'{escaped}{chr(92) * trailing}'"


def _parts(text: str) -> list[str]:
    """Split at the commas outside of quotes and brackets."""
    parts, depth, quote = [""], 0, ""
    for index, char in enumerate(text):
        if quote:
            quote = "" if char == quote and text[index - 1] != "\\" else quote
        elif char in "'\"":
            quote = char
        elif char in "[{(":
            depth += 1
        elif char in "]})":
            depth -= 1
        elif char == "," and depth == 0:
            parts.append("")
            continue
        parts[-1] += char
    return parts if text else []


def unknown(key: str, known: Sequence[str], further: Sequence[str] = ()) -> ConfigError:
    """Return the error for an unknown key, with the nearest one and all; ``further`` are short and nested ones."""
    names = (key, ELSEWHERE.get(key))
    same = next((each for each in further if each.rpartition(".")[2] in names), None)
    hint = f"; did you mean '{same}'?" if same else suggest(key, known)
    return ConfigError(f"unknown key '{key}'{hint or ';'} allowed: {', '.join(known)}")
