"""`benchmark`: parameters, FLOPs, time and memory of networks, beside the paper's Table 2."""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch

from saunet.errors import ConfigError, checked, positive, require_matplotlib, usable_device
from saunet.io.atomic import check_folder, write_json
from saunet.io.progress import bar
from saunet.models.systems import ModelOptions
from saunet.published import published
from saunet.tables import Row, Table, columns, show, stdout
from saunet.tables.drawing import Point, draw_speed, save
from saunet.tools.benchmark.measure import Measurement, Networks, Plan, run_suite

PAPER_METHODS = {"mono_r18": "Mono R18", "mono_r50": "Mono R50", "packnet": "PackNet", "sau_net": "SAU-Net"}
"""The paper's names of our models."""
CHANGED = " (changed)"
"""Suffix of a model's name if its parameters differ from those in the paper."""


@checked
@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions(Plan):
    """Options of `benchmark`: it measures every combination of the sequences, for ``model`` or each of ``models``.

    Args:
        model: Networks to measure; unused if ``models`` is given.
        models: Registered models by name, to measure side by side; in Python also a mapping of names to networks.
        sizes: Image sizes, height x width.
        devices: cpu, cuda or any other of torch's devices; auto is a GPU if there is one.
        precisions: fp32, bf16 or fp16: the format of weights and activations.
        modes: eager, compiled.
        batch_sizes: Images per call. Latency is per call, throughput in images per second.
        runs: Number of timed calls.
        warmup: Number of calls before that.
        threads: Threads of torch on the CPU; by default unchanged.
        figure: Also draw time against accuracy; needs matplotlib.
        abs_rel: Accuracy by model for the figure; the paper's for models not named.
        output_dir: Folder for the results; None writes none.

    Raises:
        ConfigError: if there is nothing to measure, or a choice, number or device is invalid.

    Examples:
        >>> saunet.BenchmarkOptions(models=["sau_net", "street"], sizes=["192x640"]).runs
        20
    """

    model: ModelOptions | None = None
    models: Sequence[str] | Mapping[str, Networks] = field(default=(), metadata={"type": "list[str]"})
    devices: Sequence[str] = ("auto",)
    threads: int | None = None
    figure: bool = False
    abs_rel: Mapping[str, float] = field(default_factory=dict)
    output_dir: str | Path | None = None

    def __post_init__(self) -> None:
        Plan.__post_init__(self)
        if not self.models and self.model is None:
            raise ConfigError("models is empty, so nothing would be measured; name at least one, such as sau_net")
        if self.threads is not None:
            positive("threads", self.threads)
        if self.figure:
            require_matplotlib("figure=true needs", "figure=false")


@dataclass(frozen=True)
class BenchmarkResult:
    """The measurements."""

    measurements: tuple[Measurement, ...]
    folder: Path | None = None
    """Folder of the files."""

    def tables(self, width: int = 160) -> tuple[Table, Table]:
        """Return a table of sizes, and one of times and memory, at most this many characters wide."""
        return size_table(self.measurements), speed_table(self.measurements, width)

    def show(self) -> None:
        """Print the tables, and where the files are."""
        console = stdout()
        show(self.tables(console.width), console)
        if self.folder is not None:
            print(f"results: {self.folder}")


def benchmark(
    options: BenchmarkOptions, *, choices: Mapping[str, str | None] | None = None, overrides: Sequence[str] = ()
) -> BenchmarkResult:
    """Measure networks, and write JSON and a picture.

    Args:
        options: What to measure, and how.
        choices: The choices of the command line: ``model`` names the options' model.
        overrides: The overrides of the command line.

    Returns:
        The measurements; `BenchmarkResult.show` prints the tables.

    Raises:
        ConfigError: if a size does not fit a model, or ``models`` is combined with changes of a model; nothing is
            measured then.
        DataError: if a file cannot be written.

    Examples:
        >>> from saunet.tools.benchmark import Networks
        >>> networks = Networks(torch.nn.Conv2d(3, 1, 3, padding=1))
        >>> options = saunet.BenchmarkOptions(models={"one layer": networks}, sizes=("32x64",), runs=1)
        >>> saunet.benchmark(options).measurements[0].depth_parameters
        28
    """
    networks = _networks(options, (choices or {}).get("model"), overrides)
    folder = None if options.output_dir is None else check_folder(options.output_dir)
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    plan = replace(options, devices=tuple(str(usable_device(name)) for name in options.devices))
    with bar() as shown:
        task = shown.add_task("")

        def progress(text: str, done: int, total: int) -> None:
            shown.update(task, description=text, completed=done, total=total)

        results = run_suite(networks, plan, progress)
    if folder is not None:
        write_measurements(results, folder / "benchmark.json")
        if options.figure:
            given = options.abs_rel
            own = {label: given[name] for label in networks if (name := label.removesuffix(CHANGED)) in given}
            draw_figure(results, folder / "benchmark.png", {**given, **own})
    return BenchmarkResult(tuple(results), folder)


def _networks(options: BenchmarkOptions, name: str | None, overrides: Sequence[str]) -> dict[str, Networks]:
    """Return the networks to measure, by their displayed names."""
    changes = [change for change in overrides if re.match(r"[+~]*model[=./@]", change)]
    if options.models and changes:
        raise ConfigError(
            f"models= measures each named model unchanged, so '{changes[0]}' would have no effect; leave out one of "
            "the two"
        )
    if isinstance(options.models, Mapping):
        return dict(options.models)
    chosen = {each: ModelOptions.named(each) for each in options.models}
    if not chosen and options.model is not None:
        changed = name is not None and not options.model.same_architecture(ModelOptions.named(name))
        chosen = {(name or "model") + CHANGED * changed: options.model}
    built = {label: each.build() for label, each in chosen.items()}
    return {label: Networks(each.depth, each.pose) for label, each in built.items()}


def size_table(results: Sequence[Measurement]) -> Table:
    """Return parameters and FLOPs by model and image size, with the paper's Table 2 if it has the system."""
    printed = {row.method: row.megaparameters for row in published().table2}
    rows = []
    for row in {(row.model, row.size): row for row in results}.values():
        method = PAPER_METHODS.get(row.model)
        counts = (count / 1e6 for count in (row.depth_parameters, row.pose_parameters, row.total_parameters))
        paper = f"{printed[method]} ({method})" if method else None
        rows.append(Row((row.model, row.size, *counts, paper, row.flops / 1e9)))
    title = "Size: parameters in millions (M); GFLOP of the depth network for one image"
    headings = columns("model", "size", "depth M|.1f", "pose M|.1f", "total M|.1f", "paper M", "GFLOP|.1f")
    return Table("sizes", title, headings, tuple(rows))


def speed_table(results: Sequence[Measurement], width: int = 160) -> Table:
    """Return time and memory of every measurement; times in milliseconds.

    Settings shared by all measurements are in the title. If the rest is too wide, the settings share one column that
    wraps, so no number is cut off.
    """
    keys = ("model", "size", "device", "precision", "mode", "batch_size")
    settings = {key.removesuffix("_size"): [str(getattr(row, key)) for row in results] for key in keys}
    shared = [name for name, values in settings.items() if len(set(values)) == 1 and name != "model"]
    said = "".join(f", {'batch ' * (name == 'batch')}{settings.pop(name)[0]}" for name in shared)
    title = f"Speed: ms per call{said}; matmul is the speed of one large matrix product"
    numbers = columns("median|.1f", "p90|.1f", "warm-up|.0f", "images/s|.1f", "peak MB|.0f", "of matmul|.0%")

    def table(headings: Sequence[str], labels: Sequence[Sequence[str]]) -> Table:
        rows = []
        for label, row in zip(labels, results, strict=True):
            times = (1e3 * seconds for seconds in (row.median, row.p90, row.warmup))
            memory = None if row.memory is None else row.memory / 1e6
            rows.append(Row((*label, *times, row.throughput, memory, row.ceiling_share)))
        return Table("speed", title, (*columns(*headings), *numbers), tuple(rows))

    labels = list(zip(*settings.values(), strict=True))
    wide = table(list(settings), labels)
    return wide if wide.width() <= width else table([" ".join(settings)], [[" ".join(label)] for label in labels])


def write_measurements(results: Sequence[Measurement], path: Path) -> None:
    """Write the measurements, with a description of the machine."""
    machine = {
        "torch": torch.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
    write_json(path, {"machine": machine, "results": [asdict(row) for row in results]})


def draw_figure(results: Sequence[Measurement], path: Path, abs_rel: Mapping[str, float] | None = None) -> None:
    """Draw time per image against accuracy; models of unknown accuracy are shown at the side."""
    printed = {row.method: row.errors[0] for row in published().table1}
    accuracy = {model: printed[method] for model, method in PAPER_METHODS.items()} | dict(abs_rel or {})
    points = []
    for row in results:
        setting = f"{row.size}, {row.device} {row.precision} {row.mode}, batch {row.batch_size}"
        points.append(Point(row.model, accuracy.get(row.model), row.median / row.batch_size, setting))
    save(draw_speed(points, "Abs Rel, KITTI Eigen (as published unless given)"), path)
