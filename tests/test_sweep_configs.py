"""The loss studies: every job of a sweep composes, with any data and model, and differs in nothing but its loss."""

from __future__ import annotations

import math

import pytest
from hydra import compose
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from plain import plain

from saunet.cli.table import config_dir

pytestmark = pytest.mark.usefixtures("hydra")

SWEEPS = ("alpha_beta", "loss_ablation")
WITH = [
    ("data=kitti", "trainer=smoke"),
    ("data=synthetic_tiny", "model=mono_r18"),
    ("experiment=smoke",),
    ("experiment=paper",),
]


def jobs(sweep: str) -> list[list[str]]:
    """Expand a sweep into the overrides of its jobs, as Hydra's sweeper does."""
    cfg = compose("train", overrides=[f"sweep={sweep}"], return_hydra_config=True)
    assert cfg.hydra.mode.name == "MULTIRUN"
    params = [f"{key}={value}" for key, value in cfg.hydra.sweeper.params.items()]
    (batch,) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(params), None)
    return batch


def losses(overrides: list[str], *others: str) -> dict[str, object]:
    cfg = compose("train", overrides=["output_dir=/tmp/x", *others, *overrides])
    return {key: plain(cfg[key]) for key in ("objective", "data", "model", "seed")}


@pytest.mark.parametrize("sweep", SWEEPS)
def test_a_sweep_lands_at_the_root_and_names_itself(sweep: str) -> None:
    assert (config_dir() / "sweep" / f"{sweep}.yaml").read_text().startswith("# @package _global_\n")
    cfg = compose("train", overrides=[f"sweep={sweep}", "output_dir=/tmp/x", "experiment=smoke"])
    assert cfg.name == sweep
    assert not {"sweep", "loss", "hydra"} & set(OmegaConf.to_container(cfg))  # type: ignore[arg-type]


@pytest.mark.parametrize("others", WITH, ids=" ".join)
def test_sweeps_go_with_any_data_model_and_trainer(others: tuple[str, ...]) -> None:
    for last in ("sweep=alpha_beta objective.beta=0.01", "sweep=loss_ablation loss=gradient_lidar"):
        assert compose("train", overrides=["output_dir=/tmp/x", *others, *last.split()])


def test_data_without_lidar_go_with_the_terms_that_need_none() -> None:
    for loss in ("primary", "gradient_image"):
        cfg = compose("train", overrides=["output_dir=/tmp/x", "data=kitti_odometry", f"loss={loss}"])
        assert cfg.objective.gradient.target == "image"


def test_alpha_beta_changes_the_ratio_from_1_to_1000_and_nothing_else() -> None:
    settings = [losses(job) for job in jobs("alpha_beta")]
    ratios = [cfg["objective"]["alpha"] / cfg["objective"]["beta"] for cfg in settings]  # type: ignore[index]
    wanted = [1, 3, 10, 30, 95, 100, 105, 300, 1000]
    assert all(math.isclose(*pair, rel_tol=1e-5) for pair in zip(ratios, wanted, strict=True))
    for cfg in settings:
        cfg["objective"].pop("beta")  # type: ignore[attr-defined]
    assert all(cfg == settings[0] for cfg in settings)  # the batch size and the seed among them


def test_loss_ablation_is_primary_then_each_gradient_target() -> None:
    settings = [losses(job) for job in jobs("loss_ablation")]
    found = [
        (cfg["objective"]["beta"], cfg["objective"]["gradient"]["target"], cfg["data"]["target_depth"])  # type: ignore[index]
        for cfg in settings
    ]
    assert found == [(0, "image", False), (0.1, "image", False), (0.1, "lidar", True)]


def test_loss_ablation_also_undoes_what_the_papers_experiment_chose() -> None:
    image = losses(["loss=gradient_image"], "experiment=paper", "data.root=/nowhere")
    lidar = losses(["loss=gradient_lidar"], "experiment=paper", "data.root=/nowhere")
    assert image["objective"]["gradient"]["target"] == "image"  # type: ignore[index]
    assert lidar["objective"]["gradient"]["domain"] == "depth"  # type: ignore[index]
