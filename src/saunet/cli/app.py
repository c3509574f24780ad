"""The command ``saunet``: its words become overrides, Hydra composes them, and a tool is called with its options."""

from __future__ import annotations

import contextlib
import functools
import gc
import inspect
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, Protocol, cast, runtime_checkable

from saunet import __version__, plugins
from saunet.cli.table import TOOLS, Table, imported, read
from saunet.cli.words import named_plugins, read_words
from saunet.errors import ConfigError, SaunetError, suggest
from saunet.io.said import PRINTED, say
from saunet.threads import wait_briefly

if TYPE_CHECKING:
    from types import FrameType

    from omegaconf import DictConfig

    from saunet.cli.compose import Composed

    _Handlers = dict[int, Callable[[int, FrameType | None], object] | int | None]


@runtime_checkable
class Partial(Protocol):
    """A result with failed parts, one sentence for each."""

    failures: Sequence[str]


@runtime_checkable
class Shown(Protocol):
    """A result that prints itself with colors and at the terminal's width; other results are printed as text."""

    show: Callable[[], None]


@runtime_checkable
class Graded(Protocol):
    """A result that decides the exit code."""

    exit_code: int


RESUME = "continue a stopped training in its folder, with its own settings"
RESUME_HELP = """\
RUN is the run's folder, the one with run.json. Its command is run again from its last checkpoint; relative paths in it
start at the current folder. Keys that you add change it: `saunet resume RUN epochs=20` trains longer. All keys: `saunet
train --help`."""


@runtime_checkable
class Costed(Protocol):
    """A result with a number that a search over sweeps minimizes; None if there is none."""

    cost: float | None


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of ``saunet``."""
    tool, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    run(tool, rest)


def _end_if_unread() -> None:
    """Exit as after SIGPIPE if nobody reads the output any more."""
    try:
        print(flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # drops what is still buffered
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
    """Run a tool with the words of a command line; raises `SystemExit` with the exit code if anything failed.

    An error that the user can fix is one sentence; only a bug shows a traceback. ``HYDRA_FULL_ERROR=1`` always shows
    it. The tool exits quietly when nobody reads its output, as with ``| head``.
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
            PRINTED.info(f"saunet {name}: ended by a defect of the program", exc_info=error)
            raise
        code = _say(name, said, 1)
    if code:
        raise SystemExit(code)


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP end a tool as Ctrl-C does, tidily and with a message; a training saves first."""

    def stop(number: int, _: object) -> NoReturn:
        from saunet.runs.folder import Stopped

        # A signal to the whole process group also ends torch's loader processes. Torch's handler for that raises
        # wherever the program is, and would turn the stop in progress into a failure.
        if hasattr(signal, "SIGCHLD"):
            before[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, lambda *_: None) or signal.SIG_DFL
        raise Stopped(f"stopped by {signal.Signals(number).name}; finished results are kept", 128 + number)

    wanted = (each for each in _signals("SIGTERM", "SIGHUP") if signal.getsignal(each) == signal.SIG_DFL)
    before: _Handlers = {each: signal.signal(each, stop) for each in wanted}
    with _put_back(before):
        yield


@contextlib.contextmanager
def _ended_at_once(name: str) -> Iterator[None]:
    """Let a signal end a process that only imports, without an exception inside somebody else's import.

    Half of torch prints figures of its own at the exit, and half of NumPy fails in another way than with the exception.
    """

    def end(number: int, _: object) -> NoReturn:
        word = "interrupted" if number == signal.SIGINT else f"stopped by {signal.Signals(number).name}"
        os._exit(_say(name, word, 128 + number))  # nothing has been written or printed yet

    wanted = (each for each in _signals("SIGINT", "SIGTERM", "SIGHUP") if callable(signal.getsignal(each)))
    with _put_back({each: signal.signal(each, end) for each in wanted}):
        yield


def _signals(*names: str) -> list[signal.Signals]:
    """Return those of the signals that this system has; none outside the main thread, which alone may handle them."""
    main = threading.current_thread() is threading.main_thread()
    return [getattr(signal, each) for each in names if main and hasattr(signal, each)]


@contextlib.contextmanager
def _put_back(before: _Handlers) -> Iterator[None]:
    """Restore handlers of signals in the end; ``before`` may grow meanwhile."""
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def _say(name: str, message: str, code: int) -> int:
    say(f"saunet {name}: {message}", error=True)
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
    if tool.options is None:  # it parses its own words
        imported(tool.function)(argv)
        return 0
    with _ended_at_once(name):
        plugins.load(named_plugins(argv))
    table = read()
    flags, overrides = read_words(argv, tool, table)
    if name == "evaluate" and not (flags.help or flags.cfg or flags.info):
        overrides = [*data_of_run(overrides, table), *overrides]
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
    # Launchers of further processes run this command again, with the same folder.
    kept = {"--config-dir": flags.config_dir, "--config-name": flags.config_name}
    again = [*overrides, *(f"{option}={value}" for option, value in kept.items() if value)]
    sys.argv[1:] = [name, *again, f"hydra.run.dir='{composed.folder}'"]
    return call(name, composed, table)[0]


def resumed(words: Sequence[str]) -> list[str]:
    """Return the command line that resumes a run from its last checkpoint, given its folder and the keys to change."""
    from saunet.runs import folder as runs

    folder = Path(words[0]).absolute() if words else Path()
    content = runs.read(folder) if words else {}
    if not content:
        given = " ".join(words) or "none"
        raise ConfigError(f"saunet resume takes the folder of a run, with its run.json; got {given}")
    again = [word for word in content.get("overrides", []) if not word.startswith("resume=")]
    return [*again, f"resume={folder / 'checkpoints' / 'last.ckpt'}", f"hydra.run.dir='{folder}'", *words[1:]]


def data_of_run(overrides: Sequence[str], table: Table) -> list[str]:
    """Return the overrides that choose the data a run was trained on, where a command line evaluates it and names none.

    Says which data are meant, for scores of others would look just as plausible.
    """
    from saunet.cli import compose
    from saunet.runs.folder import first_process

    given = compose.parsed(overrides)
    if "checkpoint" not in given or any(key.startswith("data@") for key in given):
        return []
    chosen = "data" in given
    found, folder = compose.recorded_data(str(given["checkpoint"]), table, needed=not chosen)
    recorded = compose.parsed(found)
    if chosen:
        same = all(str(given.get(key)) == str(recorded.get(key)) for key in ("data", "data.root"))
        lacking = [word for word in found if same and word.partition("=")[0] in compose.OF_SPLITS - given.keys()]
        if lacking and first_process():
            print(
                f"data: the run of {folder} also has {' '.join(lacking)}; without it, frames that it was trained on "
                "may be scored: add it, or leave out data=... to take the run's data"
            )
        return []
    if first_process():
        said = f"those of {folder}: {' '.join(found)}" if found else "rendered streets, data=synthetic"
        print(f"data: {said}; to score on others, give data=...")
    return found


def call(name: str, composed: Composed, table: Table) -> tuple[int, object]:
    """Call a tool's function, print what it returns, and return the exit code and the result."""
    from saunet.cli import compose
    from saunet.cli.errors import sentence
    from saunet.cli.log import quiet

    with _ended_at_once(name):
        made, called = map(imported, TOOLS[name].paths())
    options = compose.options(made, composed, table)
    if name in ("evaluate", "odometry"):
        compose.check_size(composed, options)
    record = {"choices": composed.choices, "overrides": composed.overrides, "describe": sentence}
    wanted = inspect.signature(called).parameters
    quiet()
    if gc.get_freeze_count() == 0:  # not before each job of a sweep, whose leftovers would never be removed
        gc.freeze()  # imported modules stay: searching them for garbage again and again doubles an index's time
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

    An error is reported at once and ends this job only.
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
