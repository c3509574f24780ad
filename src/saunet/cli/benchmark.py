"""``saunet-benchmark``: parameters, FLOPs, time and memory of models, beside the paper's Table 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import pick_device, run


def build(model: DictConfig) -> Any:
    """Build the networks of a ``model`` config node, with random weights."""
    from saunet.benchmarking import Networks
    from saunet.models.depth import DepthNet
    from saunet.registry import instantiate

    node = config.plain(model)
    depth = DepthNet(instantiate(node["encoder"]), instantiate(node["decoder"]), node["min_depth"], node["max_depth"])
    return Networks(depth, instantiate(node["pose"]) if node["pose"] else None)


def benchmark(cfg: DictConfig) -> None:
    """Measure the chosen model, or each of ``models``, print a table, and write JSON and a picture."""
    import torch
    from hydra import compose
    from hydra.core.hydra_config import HydraConfig
    from rich.console import Console

    from saunet.benchmarking import Plan, run_suite
    from saunet.benchmarking.report import draw_figure, size_table, speed_table, write_measurements
    from saunet.progress import bar

    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    plan = Plan(
        sizes=list(cfg.sizes),
        devices=[pick_device(name) for name in cfg.devices],
        precisions=list(cfg.precisions),
        modes=list(cfg.modes),
        batch_sizes=list(cfg.batch_sizes),
        runs=cfg.runs,
        warmup=cfg.warmup,
    )
    if cfg.models:
        models = {name: build(compose("benchmark", overrides=[f"model={name}"]).model) for name in cfg.models}
    else:
        models = {HydraConfig.get().runtime.choices["model"]: build(cfg.model)}
    with bar() as shown:
        task = shown.add_task("")
        results = run_suite(
            models, plan, lambda text, done, total: shown.update(task, description=text, completed=done, total=total)
        )
    console = Console()
    console = console if console.is_terminal else Console(width=160)
    console.print(size_table(results), speed_table(results))
    output = Path(cfg.output_dir)
    write_measurements(results, output / "benchmark.json")
    if cfg.figure:
        draw_figure(results, output / "benchmark.png", dict(cfg.abs_rel))
    print(f"results: {output}")


def main() -> None:
    """Entry point of ``saunet-benchmark``."""
    run("benchmark", benchmark, kinds=("encoder", "decoder", "pose"))


if __name__ == "__main__":
    main()
