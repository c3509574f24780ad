"""``saunet benchmark``: which networks are measured, and the names they go by."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields

import yaml

from saunet.cli.config import config_dir
from saunet.errors import ConfigError, one_of
from saunet.models.depth import DepthNet
from saunet.registry import Spec
from saunet.tools.benchmark import BenchmarkOptions, Networks, Plan
from saunet.tools.benchmark import benchmark as measure

CHANGED = " (changed)"
"""Stands behind the name of a model that the command line has changed: it is not what the paper measured."""


@dataclass(frozen=True, kw_only=True)
class Model:
    """Networks.

    Args:
        encoder: Depth encoder.
        decoder: Depth decoder.
        pose: Pose network; None for none.
        min_depth: Smallest depth that the network can say.
        max_depth: Largest depth.
    """

    encoder: Spec
    decoder: Spec
    pose: Spec | None = None
    min_depth: float = 0.1
    max_depth: float = 100.0

    @classmethod
    def named(cls, name: str) -> Model:
        """Return a choice of the group ``model``.

        Raises:
            ConfigError: if there is none of this name.
        """
        folder = config_dir() / "model"
        one_of("models", name, sorted(path.stem for path in folder.glob("*.yaml")))
        content = yaml.safe_load((folder / f"{name}.yaml").read_text())
        parts = {
            kind: Spec.of(kind, part) for each in content["defaults"] for kind, part in each.items() if kind[0] != "_"
        }
        changed = {kind: spec.changed(**content.get(kind, {})) for kind, spec in parts.items()}
        return cls(
            encoder=changed["encoder"],
            decoder=changed["decoder"],
            pose=changed.get("pose"),
            min_depth=content.get("min_depth", cls.min_depth),
            max_depth=content.get("max_depth", cls.max_depth),
        )

    def networks(self) -> Networks:
        """Build the networks with random weights."""
        decoder = Spec({**self.decoder.node, "_partial_": True}).build()
        depth = DepthNet(self.encoder.build(), decoder, self.min_depth, self.max_depth)
        return Networks(depth, self.pose.build() if self.pose else None)

    def architecture(self) -> list[object]:
        """Return what decides the cost: all parameters but the weights to start from."""
        specs = (self.encoder, self.decoder, self.pose)
        found = [{**_defaults(spec), **spec.node} if spec else None for spec in specs]
        kept = [
            each and {key: _listed(value) for key, value in each.items() if key[0] != "_" and key != "weights"}
            for each in found
        ]
        return [*kept, [spec and spec.node["_target_"] for spec in specs], self.min_depth, self.max_depth]


def _defaults(spec: Spec) -> dict[str, object]:
    return {name: each.default for name, each in spec.parameters.items() if each.default is not each.empty}


def _listed(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


@dataclass(frozen=True, kw_only=True)
class BenchmarkCommand(Plan):
    """What ``saunet benchmark`` measures: ``model``, or each of ``models``.

    Args:
        model: Networks.
        models: Names of choices of ``model``, to measure side by side.
        sizes: Image sizes, height x width.
        devices: cpu, cuda or any other that torch knows; auto is a GPU if there is one.
        precisions: fp32, bf16 or fp16: the format of weights and activations.
        modes: eager, compiled.
        batch_sizes: Images per call. Latency is that of the call, throughput is in images.
        runs: Timed calls.
        warmup: Calls before that.
        threads: Of torch on the CPU; as it is by default.
        figure: Also draw time against accuracy; needs matplotlib.
        abs_rel: Accuracy by model for the figure; the paper's where a model is not named.
        output_dir: Folder for the results.
    """

    model: Model
    models: tuple[str, ...] = ()
    devices: Sequence[str] = ("auto",)
    threads: int | None = None
    figure: bool = False
    abs_rel: Mapping[str, float] = field(default_factory=dict)
    output_dir: str | None = None


def benchmark(
    options: BenchmarkCommand,
    *,
    choices: Mapping[str, str | None],
    overrides: Sequence[str],
    describe: Callable[[Exception], str | None],
) -> None:
    """Measure the chosen model, or each of ``models``, and print the tables.

    Raises:
        ConfigError: if ``models`` stands beside changes of a model.
    """
    changes = [change for change in overrides if re.match(r"[+~]*model[=./@]", change)]
    if options.models and changes:
        raise ConfigError(
            f"models= measures each model as it is named, so '{changes[0]}' would change nothing; "
            "leave out one of the two"
        )
    if options.models:
        models = {name: Model.named(name) for name in options.models}
    else:
        name = str(choices["model"])
        changed = options.model.architecture() != Model.named(name).architecture()
        models = {name + CHANGED * changed: options.model}
    given = dict(options.abs_rel)
    given |= {label: given[name] for label in models if (name := label.removesuffix(CHANGED)) in given}
    shared = {
        each.name: getattr(options, each.name) for each in fields(options) if each.name not in ("model", "models")
    }
    networks = {label: model.networks() for label, model in models.items()}
    measure(BenchmarkOptions(**{**shared, "models": networks, "abs_rel": given})).show()
