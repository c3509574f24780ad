"""A checkpoint as training writes it, of a small untrained network."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from torch import nn

from saunet.cli.compose import structured
from saunet.registry import REGISTRIES
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord


def component_node(kind: str, name: str) -> dict[str, Any]:
    settings = dataclasses.asdict(structured(REGISTRIES[kind].node(name))())
    return {key: value for key, value in settings.items() if value != "???"}


def write_checkpoint(path: Path, height: int = 64, width: int = 96) -> None:
    record = ModelRecord(
        encoder={**component_node("encoder", "lite_mono_tiny"), "dims": [8, 16, 16], "depths": [2, 2, 2]},
        decoder=component_node("decoder", "lite_mono"),
        pose=component_node("pose", "posecnn"),
        min_depth=0.1,
        max_depth=100.0,
        height=height,
        width=width,
    )
    depth, pose = build_networks(record)
    assert pose is not None
    state = nn.ModuleDict({"depth": depth, "pose": pose}).state_dict()
    atomic_save({"state_dict": dict(state), "saunet": record.to_plain(), "epoch": 1, "global_step": 2}, path)
