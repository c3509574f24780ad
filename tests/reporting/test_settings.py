"""Differing keys, and names made from them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from made_runs import make_run

from saunet.reporting.inputs import collect
from saunet.runs.run import read_run
from saunet.runs.sweep import differing, labels, ratio, sweeps_ratio, typed_names, values, write_plan


def test_a_component_of_another_name_is_one_difference(tmp_path: Path) -> None:
    runs = [read_run(make_run(tmp_path / name, encoder=name)) for name in ("resnet18", "stratified_nano")]
    assert differing(runs) == ["model.encoder"]
    assert labels([runs]) == [["resnet18 + aunet", "stratified_nano + aunet"]]


def test_other_keys_are_named_by_their_last_part(tmp_path: Path) -> None:
    runs = [read_run(make_run(tmp_path / str(beta), beta=beta)) for beta in (0.1, 0.2)]
    assert differing(runs) == ["objective.beta"]
    assert labels([runs]) == [["beta = 0.1", "beta = 0.2"]]


def test_numbers_are_shown_alike_however_they_were_typed(tmp_path: Path) -> None:
    runs = [read_run(make_run(tmp_path / str(beta), beta=beta)) for beta in (0.0002, 0.0003)]
    typed = dataclasses.replace(
        runs[0], overrides={"objective.beta": "2e-4", "name": "2011_09", "x": "1.50", "y": "1e3"}
    )
    assert values(typed, ["objective.beta", "name", "x", "y"]) == ["0.0002", "2011_09", "1.5", "1000"]
    assert values(runs[1], ["objective.beta"]) == ["0.0003"]
    same = dataclasses.replace(runs[1], overrides={"objective.beta": "0.00020"})
    assert differing([typed, same], by_overrides=True) == ["name", "x", "y"]


def test_a_key_that_older_versions_lack_is_no_difference_while_it_is_off(tmp_path: Path) -> None:
    old, new = (read_run(make_run(tmp_path / name)) for name in ("old", "new"))
    newer = dataclasses.replace(new, config={**new.config, "speed": {"compile": False, "ema": 0.0, "freeze": []}})
    assert differing([old, newer]) == []
    newest = dataclasses.replace(new, config={**new.config, "speed": {"compile": True}})
    assert differing([old, newest]) == ["speed.compile"]


def test_runs_alike_go_by_their_own_names_and_never_twice_by_one(tmp_path: Path) -> None:
    one, other = (read_run(make_run(tmp_path / folder / "same")) for folder in ("x", "y"))
    assert labels([[one, other]]) == [["same (x/same)", "same (y/same)"]]
    assert labels([[one]]) == [["same"]]


def test_the_ratio_of_the_weights_names_an_alpha_beta_sweep(sweep: Path) -> None:
    (found,) = collect([sweep]).sweeps
    assert sweeps_ratio(found.runs)
    assert [ratio(run) for run in found.runs] == [1, 10, 100]
    assert labels([found.runs]) == [["α/β = 1", "α/β = 10", "α/β = 100"]]


def test_a_job_that_left_nothing_is_named_by_its_plan(sweep: Path) -> None:
    planned = [[f"objective.beta={beta}"] for beta in (10, 1, 0.1, 0.01)]
    write_plan(sweep, planned)
    (found,) = collect([sweep]).sweeps
    assert labels([found.runs])[0][-1] == "beta = 0.01"


def test_jobs_named_one_by_one_go_by_what_was_swept(sweep: Path) -> None:
    jobs = [read_run(sweep / name) for name in ("0", "1")]
    assert not any(job.swept for job in jobs)  # their Hydra does not say that it ran several
    for name in ("0", "1"):
        file = sweep / name / ".hydra" / "hydra.yaml"
        file.write_text(file.read_text() + "  mode: MULTIRUN\n")
    jobs = [read_run(sweep / name) for name in ("0", "1")]
    whole = [run for run in collect([sweep]).sweeps[0].runs if run.path in {job.path for job in jobs}]
    assert typed_names(jobs) == typed_names(whole) == labels([whole])[0]
    assert typed_names(jobs[:1]) == [f"{sweep.name}/0"]


def test_no_ratio_without_a_gradient_term(tmp_path: Path) -> None:
    assert ratio(read_run(make_run(tmp_path / "a", beta=0))) is None
