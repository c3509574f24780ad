"""Which frames a training should leave out: what ``saunet doctor`` writes and ``data.manifest=`` reads, as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lightning.pytorch.utilities import rank_zero_warn

from saunet.data.loading.windows import Selection
from saunet.errors import DataError
from saunet.io.atomic import write_json
from saunet.io.plain import read_json

FORMAT = 1
"""Version of the file's layout."""
UNREADABLE = "unreadable"
"""The reason that also forbids a frame as a neighbor; all others only forbid it as a target."""

LeaveOut = Mapping[str, Mapping[str, Sequence[int]]]
"""Drive -> reason -> frame numbers."""


@dataclass(frozen=True)
class Manifest:
    """Frames to leave out of training and validation."""

    leave_out: LeaveOut
    numbering: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    path: Path = Path("manifest.json")
    test_only: Set[str] = frozenset()

    def check(self, names: Set[str]) -> None:
        """Check that the manifest is of these drives; warn where some of its drives are not among them."""
        mine = self.leave_out.keys() - self.test_only
        strange = sorted(mine - names)
        if not strange:
            return
        listed = f"such as '{strange[0]}'; here they are called '{min(names)}'" if names else f"such as '{strange[0]}'"
        if len(strange) == len(mine):
            raise DataError(
                f"{self.path} names {len(mine)} recordings and none of them is trained on ({listed}...); make it with "
                "saunet doctor and the data settings of this run, or set data.manifest=null"
            )
        rank_zero_warn(
            f"{self.path} names {len(mine)} recordings, and {len(strange)} of them are not trained on ({listed}...); "
            "if they should be, run saunet doctor again with the data settings of this run"
        )

    def apply(self, selection: Selection, offsets: Sequence[int]) -> Selection:
        """Return a selection without the frames to leave out, counted by reason."""
        name = selection.drive.name
        if name in self.numbering and self.numbering[name] != selection.drive.numbering:
            raise DataError(
                f"{self.path} was made for '{name}' with {self.numbering[name] or 'other settings'} and it is now read "
                f"with {selection.drive.numbering or 'other settings'}, which counts its frames differently; "
                "run saunet doctor again with the settings of this run, or set data.manifest=null"
            )
        kept, left_out = list(selection.frames), dict(selection.left_out)
        for reason, numbers in self.leave_out.get(name, {}).items():
            unwanted = set(numbers)
            if reason == UNREADABLE:
                unwanted |= {number - offset for number in numbers for offset in offsets}
            before = len(kept)
            kept = [frame for frame in kept if frame not in unwanted]
            left_out[f"{reason} (manifest)"] = before - len(kept)
        return Selection(selection.drive, kept, left_out)


def write_manifest(path: str | Path, manifest: Manifest) -> None:
    """Write a manifest, whole or not at all."""
    plain = {
        "format": FORMAT,
        **manifest.facts,
        "numbering": dict(manifest.numbering),
        "test_only": sorted(manifest.test_only),
        "leave_out": {
            drive: {reason: sorted(numbers) for reason, numbers in reasons.items()}
            for drive, reasons in manifest.leave_out.items()
        },
    }
    write_json(path, plain, indent=1)


def read_manifest(path: str | Path) -> Manifest:
    """Read a manifest."""
    path = Path(path).expanduser()
    try:
        plain = read_json(path)
    except FileNotFoundError as reason:
        raise DataError(f"no manifest at {path}; make one with saunet doctor, or set data.manifest=null") from reason
    except (OSError, ValueError) as reason:
        raise DataError(f"{reason}; make it again with saunet doctor") from reason
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        found = plain.get("format") if isinstance(plain, dict) else type(plain).__name__
        raise DataError(f"{path} is not a manifest of format {FORMAT} (found {found}); make it with saunet doctor")
    leave_out, numbered = plain.get("leave_out"), plain.get("numbering", {})
    if not isinstance(leave_out, dict) or not isinstance(numbered, dict) or not all(map(_is_entry, leave_out.values())):
        raise DataError(
            f"{path}: 'leave_out' must map each drive to reasons and these to lists of frame numbers, such as "
            '{"clip l": {"static": [4, 5]}}'
        )
    test_only = frozenset(map(str, plain.get("test_only") or ()))
    return Manifest(leave_out, {str(key): str(value) for key, value in numbered.items()}, {}, path, test_only)


def _is_entry(reasons: Any) -> bool:
    return isinstance(reasons, dict) and all(
        isinstance(numbers, list) and all(isinstance(number, int) for number in numbers) for numbers in reasons.values()
    )
