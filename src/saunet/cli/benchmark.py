"""``saunet benchmark``: parameters, FLOPs, time and memory of models, beside the paper's Table 2."""

from __future__ import annotations

from omegaconf import DictConfig

from saunet.cli._app import run
from saunet.cli._models import CHANGED, build, chosen
from saunet.cli._options import options_of
from saunet.tools.benchmark import BenchmarkOptions
from saunet.tools.benchmark import benchmark as measure


def benchmark(cfg: DictConfig) -> None:
    """Measure the chosen model, or each of ``models``, and print the tables."""
    nodes, accuracy = chosen(cfg), dict(cfg.abs_rel)
    accuracy |= {label: accuracy[name] for label in nodes if (name := label.removesuffix(CHANGED)) in accuracy}
    models = {label: build(node) for label, node in nodes.items()}
    measure(options_of(BenchmarkOptions, cfg, models=models, abs_rel=accuracy)).show()


def main() -> None:
    """Entry point of ``saunet benchmark``."""
    run("benchmark", benchmark, kinds=("encoder", "decoder", "pose"))


if __name__ == "__main__":
    main()
