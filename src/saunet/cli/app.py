"""The command ``saunet``: which tools there are, and the way from a command line to a tool's function.

A tool is a dataclass of options and a function that takes it, both in the room that owns the tool. Hydra composes the
keys, they become the options once, the function is called, and what it returns is printed.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast, runtime_checkable

from saunet import __version__, plugins
from saunet.cli.config import config_dir
from saunet.errors import ConfigError, SaunetError, suggest

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from saunet.cli.compose import Composed
    from saunet.cli.table import Table


@dataclass(frozen=True)
class Tool:
    """One tool of the command line.

    Args:
        summary: What it does, in a line.
        options: Its options as ``module:Class``; empty for a tool with a command line of its own.
        function: What is called with them, as ``module:function``.
        examples: Command lines without ``saunet``.
        positional: The key that plain words stand for; a trailing ``*`` takes several.
        aliases: Short form -> key.
        words: First word -> what it stands for.
        recorded: Whether the function is also given ``choices`` and ``overrides`` for the record of a run, and
            ``describe``, which puts an error into one sentence; what it returns is not printed.
        config: Name of the root config; the tool's own by default.
        preset: Overrides that come before those of the command line.
    """

    summary: str
    options: str = ""
    function: str = ""
    examples: Sequence[str] = ()
    positional: str | None = None
    aliases: dict[str, str] = field(default_factory=dict)
    words: dict[str, str] = field(default_factory=dict)
    recorded: bool = False
    config: str = ""
    preset: Sequence[str] = ()


TOOLS: dict[str, Tool] = {
    "train": Tool(
        "train a depth network on driving video",
        "saunet.training.tool:TrainOptions",
        "saunet.training.tool:train",
        (
            "train experiment=selfsup data=kitti data.root=/data/kitti/raw",
            "train experiment=smoke model/encoder=resnet18 epochs=2 lr=2e-4",
            "train -m sweep=loss_ablation experiment=smoke",
            "resume outputs/train/2026-01-31_12-00-00",
        ),
        aliases={"epochs": "trainer.max_epochs", "lr": "optim.lr", "batch": "data.batch_size"},
        recorded=True,
    ),
    "predict": Tool(
        "depth of an image, a folder, a video or a camera, as pictures, points and videos",
        "saunet.prediction.tool:PredictOptions",
        "saunet.prediction.tool:predict",
        (
            "predict road.png output=out",
            "predict drive.mp4 checkpoint=last.ckpt output=out outputs=[mp4,html] camera=[90]",
        ),
        positional="input",
    ),
    "evaluate": Tool(
        "score a checkpoint, or predictions made elsewhere",
        "saunet.evaluation.tool:EvaluateOptions",
        "saunet.evaluation.tool:evaluate",
        ("evaluate last.ckpt data=kitti data.root=/data/kitti/raw", "evaluate predictions=maps data=kitti"),
        positional="checkpoint",
    ),
    "odometry": Tool(
        "the camera's path through whole sequences, with its errors",
        "saunet.evaluation.paths:OdometryOptions",
        "saunet.evaluation.paths:odometry",
        ("odometry last.ckpt data.root=/data/kitti/odometry",),
        positional="checkpoint",
    ),
    "export": Tool(
        "write a checkpoint as files to deploy or share, each checked against the network",
        "saunet.exporting.tool:ExportOptions",
        "saunet.exporting.tool:export",
        ("export last.ckpt output=exported",),
        positional="checkpoint",
    ),
    "report": Tool(
        "one page of tables, curves and pictures from finished runs; how runs differ",
        "saunet.reporting.tool:ReportOptions",
        "saunet.reporting.tool:report",
        ("report outputs/train", "report compare outputs/train/A outputs/train/B"),
        positional="runs*",
        words={"compare": "compare=true"},
    ),
    "benchmark": Tool(
        "parameters, FLOPs, time and memory of networks",
        "saunet.cli.benchmark:BenchmarkCommand",
        "saunet.cli.benchmark:benchmark",
        ("benchmark models=[sau_net,street]", "benchmark model/encoder=resnet18 sizes=192x640,320x1024"),
        recorded=True,
    ),
    "doctor": Tool(
        "look at a data set before hours of training",
        "saunet.tools.doctor.tool:DoctorOptions",
        "saunet.tools.doctor.tool:doctor",
        examples=("doctor data=kitti data.root=/data/kitti/raw",),
    ),
    "calibrate": Tool(
        "make camera.yaml from a video or pictures of a board",
        "saunet.tools.calibrate.tool:CalibrateOptions",
        "saunet.tools.calibrate.tool:calibrate",
        examples=("calibrate print_board=board.png", "calibrate board.mp4 columns=10 rows=7 square=0.025"),
        positional="input",
    ),
    "prepare": Tool(
        "do once before training: dense depth, a teacher's depth, smaller copies of images",
        "saunet.tools.prepare.tool:PrepareOptions",
        "saunet.tools.prepare.tool:prepare",
        examples=("prepare densify root=/data/kitti/raw",),
        positional="job",
    ),
    "components": Tool(
        "list every registered component with its keys",
        function="saunet.cli.components:main",
        examples=("components encoder",),
    ),
    "demo": Tool(
        "the README's demo: train on rendered video, evaluate, draw",
        "saunet.training.tool:TrainOptions",
        "saunet.cli.demo:demo",
        ("demo", "demo epochs=2"),
        aliases={"epochs": "trainer.max_epochs", "lr": "optim.lr", "batch": "data.batch_size"},
        recorded=True,
        config="train",
        preset=("experiment=demo",),
    ),
}
"""Every tool by name, in the order of ``saunet --help``."""


@runtime_checkable
class Partial(Protocol):
    """A result of which some parts failed, each said in one sentence."""

    @property
    def failures(self) -> Sequence[str]:
        """One sentence for each part that failed."""


@runtime_checkable
class Shown(Protocol):
    """A result that prints itself; others are printed as text."""

    def show(self) -> None:
        """Print tables in colors and at the terminal's width."""


@runtime_checkable
class Graded(Protocol):
    """A result that decides the exit code."""

    @property
    def exit_code(self) -> int:
        """0 if all is well."""


@runtime_checkable
class Costed(Protocol):
    """A result with a number that a search over sweeps minimizes."""

    @property
    def cost(self) -> float | None:
        """The number; None if there is none."""


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of ``saunet``.

    What a user can mend ends in one sentence and exit code 1; only a defect of the program shows a traceback.
    ``HYDRA_FULL_ERROR=1`` shows it always.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    tool, *rest = given or ["--help"]
    if tool in ("-h", "--help", "help"):
        print(overview())
    elif tool in ("-V", "--version", "version"):
        print(f"saunet {__version__}")
    elif tool == "--completion" or tool == "--complete":
        _completion(tool, rest[0] if rest else "")
    elif tool == "resume":
        run("train", rest, read=resumed)
    elif tool in TOOLS:
        run(tool, rest)
    else:
        hint = suggest(tool, TOOLS) or f"; the tools are {', '.join(TOOLS)}"
        sys.exit(f"saunet: the first word is a tool, not '{tool}'{hint}")


def _completion(asked: str, word: str) -> None:
    from saunet.cli.completion import complete, script

    try:
        print(script(word) if asked == "--completion" else "\n".join(complete(word, [*TOOLS, "resume"], table())))
    except ConfigError as error:
        sys.exit(f"saunet: {error}")


def overview() -> str:
    """Return what ``saunet --help`` prints."""
    width = max(map(len, TOOLS))
    lines = [f"saunet {__version__}: self-supervised monocular depth", "", "usage: saunet TOOL [KEY=VALUE ...]", ""]
    for name, tool in TOOLS.items():
        lines += [f"  {name:{width}}  {tool.summary}", f"  {'':{width}}  $ saunet {tool.examples[0]}"]
    return "\n".join([*lines, "", "`saunet TOOL --help` lists a tool's keys; --completion bash|zsh|fish sets up Tab."])


def table() -> Table:
    """Return the keys of all tools and components."""
    from saunet.cli.table import read

    return read({name: tool.options for name, tool in TOOLS.items() if tool.options})


def resumed(words: Sequence[str]) -> list[str]:
    """Return the command line that continues a run: the run's own, from its last checkpoint, in its folder.

    Args:
        words: The run's folder, and what shall differ.

    Raises:
        ConfigError: if that is no run's folder.
    """
    from saunet.runs.folder import read

    folder = Path(words[0]).absolute() if words else Path()
    content = read(folder) if words else {}
    if not content:
        raise ConfigError(
            f"saunet resume takes the folder of a run, with its run.json; got {' '.join(words) or 'none'}"
        )
    again = [word for word in content.get("overrides", []) if not word.startswith(("resume=", "init_from="))]
    return [*again, f"resume={folder / 'checkpoints' / 'last.ckpt'}", f"hydra.run.dir='{folder}'", *words[1:]]


def run(name: str, argv: Sequence[str], read: Callable[[Sequence[str]], Sequence[str]] = list) -> None:
    """Run a tool with the words of a command line.

    Args:
        name: The tool.
        argv: The words.
        read: What makes them the tool's own.

    Raises:
        SystemExit: with the exit code, unless all went well.
    """
    try:
        code = _run(name, read(argv))
    except KeyboardInterrupt:
        code = _say(name, "interrupted", 130)
    except SystemExit as stop:  # a run that was asked to stop says how to resume
        if not stop.code or str(stop) == str(stop.code):
            raise
        code = _say(name, str(stop), int(stop.code) if isinstance(stop.code, int) else 1)
    except Exception as error:
        from saunet.cli.errors import sentence

        # A process that DDP started inherits the variable.
        debug = os.environ.get("HYDRA_FULL_ERROR") == "1" and "LOCAL_RANK" not in os.environ
        said = None if debug else sentence(error, None if isinstance(error, SaunetError) else table())
        if said is None:
            raise
        code = _say(name, said, 1)
    if code:
        raise SystemExit(code)


def _run(name: str, argv: Sequence[str]) -> int:
    from saunet.cli import compose, words

    tool, conf = TOOLS[name], config_dir()
    argv = [tool.words.get(argv[0], argv[0]), *argv[1:]] if argv else []
    if not tool.options:
        from saunet.cli.table import imported

        sys.argv[1:] = argv  # it reads them itself
        imported(tool.function)()
        return 0
    plugins.load(words.named(argv))
    keys = table()
    line = words.overrides(argv, name, keys, tool.positional, tool.aliases, conf)
    flags = line.flags
    if flags.help:
        from saunet.cli.help import tool_help

        print(tool_help(name, tool, keys, words.choices(line.overrides)))
        return 0
    config, overrides = flags.config_name or tool.config or name, [*tool.preset, *line.overrides]
    with compose.hydra(name, tool.config or name, keys, conf, flags.config_dir) as hydra:
        if flags.cfg:
            hydra.show_cfg(config, overrides, flags.cfg, flags.package, flags.resolve)
            return 0
        if flags.info:
            hydra.show_info(flags.info, config, overrides)
            return 0
        composed = None if flags.multirun else compose.single(hydra, config, overrides)
        if composed is None:
            from saunet.cli.sweeps import sweep

            return sweep(hydra, config, [*overrides, "hydra.mode=MULTIRUN"], functools.partial(job, name))
    # What starts further processes runs this command again, with the same folder.
    sys.argv[1:] = [name, *line.again, f"hydra.run.dir='{composed.folder}'"]
    return call(name, composed, keys)[0]


def call(name: str, composed: Composed, keys: Table) -> tuple[int, object]:
    """Call a tool's function and print what it returns.

    Returns:
        The exit code, and the result.
    """
    from saunet.cli import compose
    from saunet.cli.errors import sentence
    from saunet.cli.log import quiet
    from saunet.cli.table import imported

    tool = TOOLS[name]
    options = compose.options(imported(tool.options), composed, keys)
    record = {"choices": composed.choices, "overrides": composed.overrides, "describe": sentence}
    function = imported(tool.function)
    quiet()
    result = function(options, **(record if tool.recorded else {}))
    if isinstance(result, Shown):
        result.show()
    elif result is not None and not tool.recorded:
        print(result)
    if isinstance(result, Partial):
        for failure in result.failures:
            print(f"saunet {name}: {failure}", file=sys.stderr)
    return (result.exit_code if isinstance(result, Graded) else 0), result


def job(name: str, raising: bool, cfg: DictConfig) -> object:
    """Do one job of a sweep, perhaps in another process; what goes wrong is said at once and ends this job only.

    Returns:
        What a search minimizes, where the result has a ``cost``.
    """
    from hydra.core.hydra_config import HydraConfig

    from saunet.cli import compose
    from saunet.cli.errors import sentence
    from saunet.cli.sweeps import Failed, check_job

    hydra, own = HydraConfig.get(), False
    try:
        plugins.load(cfg.plugins)
        keys = table()
        composed = compose.of_job(cfg, cast("DictConfig", hydra))
        check_job(composed.config, composed.folder)
        own = True
        code, result = call(name, composed, keys)
        if code:
            raise ConfigError("some of it failed")
    except Exception as error:
        if own and TOOLS[name].recorded:
            from saunet.runs.folder import record_failed_start

            record_failed_start(composed.folder, name, error, sentence, overrides=list(composed.overrides))
        reason = sentence(error) or f"{type(error).__name__}: {error}"
        print(f"saunet {name}: job {hydra.job.num} ({hydra.job.override_dirname}) failed: {reason}", file=sys.stderr)
        if raising:
            raise
        return Failed()
    return result.cost if isinstance(result, Costed) else None


def _say(name: str, message: str, code: int) -> int:
    print(f"saunet {name}: {message}", file=sys.stderr)
    return code
