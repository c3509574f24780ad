"""From measurements to the manifest: the frames that a training should leave out, by reason."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from saunet.data.manifest import UNREADABLE, Manifest
from saunet.data.motion import SAME_PICTURE
from saunet.data.static import MIN_FLOW
from saunet.tools.doctor.findings import BRIGHT, DARK, FLAT, Finding
from saunet.tools.doctor.survey import FrameFacts, Survey


def manifest_of(survey: Survey, findings: Sequence[Finding], path: str | Path) -> Manifest:
    """Return what ``data.manifest=`` reads: each frame that was read and is of no use, under the first reason."""
    leave_out: dict[str, dict[str, list[int]]] = {}
    for frame in survey.frames:
        reason = _reason(frame)
        if reason:
            leave_out.setdefault(frame.drive, {}).setdefault(reason, []).append(frame.index)
    facts: dict[str, Any] = {
        "read": f"{survey.judged} of {survey.known} frames read; only these are judged",
        "splits": {
            split: {"samples": count, "left_out": survey.left_out[split], "sha256": survey.fingerprints[split]}
            for split, count in survey.windows.items()
        },
        "findings": [{"level": each.level, "text": each.text, "fix": each.fix} for each in findings],
    }
    numbering = {drive: survey.numbering[drive] for drive in leave_out}
    return Manifest(leave_out, numbering, facts, Path(path), survey.test_only & leave_out.keys())


def _reason(frame: FrameFacts) -> str | None:
    if frame.problem:
        return UNREADABLE
    if frame.brightness < DARK:
        return "dark"
    if frame.brightness > BRIGHT:
        return "bright"
    if frame.contrast < FLAT:
        return "flat"
    if frame.change is not None and frame.change < SAME_PICTURE:
        return "doubled"
    if frame.flow is not None and frame.flow < MIN_FLOW:
        return "static"
    return None
