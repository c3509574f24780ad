"""``saunet benchmark``: parameters, FLOPs, time and memory of models, beside the paper's Table 2."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from saunet.cli._app import pick_device, run
from saunet.cli._models import CHANGED, build, chosen
from saunet.errors import positive


def benchmark(cfg: DictConfig) -> None:
    """Measure the chosen model, or each of ``models``, print a table, and write JSON and a picture."""
    import torch
    from rich.console import Console

    from saunet.io.progress import bar
    from saunet.tools.benchmark import Plan, run_suite
    from saunet.tools.benchmark.report import draw_figure, size_table, speed_table, write_measurements

    if cfg.threads is not None:
        torch.set_num_threads(int(positive("threads", cfg.threads)))
    plan = Plan(
        sizes=list(cfg.sizes),
        devices=[pick_device(name) for name in cfg.devices],
        precisions=list(cfg.precisions),
        modes=list(cfg.modes),
        batch_sizes=list(cfg.batch_sizes),
        runs=cfg.runs,
        warmup=cfg.warmup,
    )
    nodes, accuracy = chosen(cfg), dict(cfg.abs_rel)
    models = {label: build(node) for label, node in nodes.items()}
    accuracy |= {label: accuracy[name] for label in nodes if (name := label.removesuffix(CHANGED)) in accuracy}
    with bar() as shown:
        task = shown.add_task("")
        results = run_suite(
            models, plan, lambda text, done, total: shown.update(task, description=text, completed=done, total=total)
        )
    console = Console()
    console = console if console.is_terminal else Console(width=160)
    console.print(size_table(results), speed_table(results, console.width))
    output = Path(cfg.output_dir)
    write_measurements(results, output / "benchmark.json")
    if cfg.figure:
        draw_figure(results, output / "benchmark.png", accuracy)
    print(f"results: {output}")


def main() -> None:
    """Entry point of ``saunet benchmark``."""
    run("benchmark", benchmark, kinds=("encoder", "decoder", "pose"))


if __name__ == "__main__":
    main()
