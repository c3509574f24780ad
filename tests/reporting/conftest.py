"""A sweep on disk, for several tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from made_runs import make_run


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Four jobs of the ratio alpha/beta: two finished, one failed, one that left nothing."""
    folder = tmp_path / "multirun"
    task = {"hydra": {"sweeper": {"_target_": "a.BasicSweeper", "params": {"objective.beta": "10,1,0.1,0.01"}}}}
    task["hydra"]["overrides"] = {"task": ["experiment=smoke"]}  # type: ignore[dict-item]
    folder.mkdir()
    (folder / "multirun.yaml").write_text(yaml.safe_dump({**task, "name": "alpha_beta"}))
    times = {"started": "2026-01-01T00:00:00+00:00", "ended": "2026-01-01T00:03:00+00:00"}
    for job, (beta, extra) in enumerate(
        [
            (10.0, {"status": "finished", **times}),
            (1.0, {"status": "failed", "error": "the loss became NaN", **times}),
            (0.1, {"status": "finished", **times}),
        ]
    ):
        history = (0.3 - 0.1 * job,) if extra["status"] == "finished" else ()
        overrides = [f"objective.beta={beta:g}", "experiment=smoke"]
        make_run(folder / str(job), beta=beta, abs_rel=history, overrides=overrides, job=job, **extra)
    return folder
