"""The doctor: look at a data set before hours of training; findings, a sheet of pictures and a manifest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from saunet.data.loading.selecting import Manifest, write_manifest
from saunet.errors import ConfigError, checked, one_of, positive
from saunet.io.atomic import check_folder
from saunet.io.images import write_image
from saunet.io.progress import bar
from saunet.registry import Spec
from saunet.tools.doctor.findings import Finding, diagnose, manifest_of
from saunet.tools.doctor.sheet import draw_sheet
from saunet.tools.doctor.survey import SPLITS, Survey, survey


@checked
@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """What `doctor` looks at, and where it writes.

    Raises:
        ConfigError: for an unknown split, none, or a negative number of frames.

    Examples:
        >>> options = saunet.DoctorOptions(data=saunet.Spec.of("data", "synthetic"), output_dir="look")
        >>> options.frames
        1000
    """

    data: Spec
    """The data module, with the settings of the training to come."""
    output_dir: str
    """Folder for ``doctor.png`` and ``manifest.json``."""
    splits: Sequence[str] = SPLITS
    """Which of ``train``, ``val`` and ``test``."""
    frames: int = 1000
    """Frames to read at most, evenly spread; 0 reads all."""

    def __post_init__(self) -> None:
        if not self.splits:
            raise ConfigError(f"splits is empty; name at least one of {', '.join(SPLITS)}")
        for split in self.splits:
            one_of("splits", split, SPLITS)
        positive("frames", self.frames, allow_zero=True)


@dataclass(frozen=True)
class Diagnosis:
    """What `doctor` found; ``print`` shows the findings and what to do about them."""

    survey: Survey
    """Everything that was measured."""
    findings: Sequence[Finding]
    """What is wrong or noteworthy, errors first."""
    manifest: Manifest
    """Frames that a training should leave out, as written to ``manifest.json``."""
    sheet: Path
    """The sheet of pictures."""

    @property
    def usable(self) -> bool:
        """Whether there is no error among the findings."""
        return all(finding.level != "error" for finding in self.findings)

    @property
    def exit_code(self) -> int:
        """1 if the data cannot be trained on as they are."""
        return 0 if self.usable else 1

    def __str__(self) -> str:
        found, path = self.survey, self.manifest.path
        lines = [*map(str, self.findings), f"pictures: {self.sheet}"]
        if found.judged:
            left_out = sum(len(frames) for reasons in self.manifest.leave_out.values() for frames in reasons.values())
            judged = "all" if found.judged == found.known else f"{found.judged} of {found.known}; frames=0 judges all"
            lines.append(f"manifest: {path} names {left_out} frames to leave out (judged: {judged})")
            lines.append(f"train with data.manifest={path}")
        return "\n".join(lines)


def doctor(options: DoctorOptions, *, advance: Callable[[int, int], None] | None = None) -> Diagnosis:
    """Read frames of a data set, judge them, and write ``doctor.png`` and ``manifest.json``.

    Args:
        options: What to look at, and where to write.
        advance: Called with the number of frames read and their total; a progress bar if None.

    Returns:
        The findings; what is broken in the data is a finding, not an exception.

    Raises:
        ConfigError: if the data module cannot be built.
        DataError: if the results cannot be written.

    Examples:
        >>> data = saunet.Spec.of("data", "synthetic_tiny", workers=0)
        >>> diagnosis = saunet.doctor(saunet.DoctorOptions(data=data, output_dir="look", frames=4))
        >>> diagnosis.usable
        True
    """
    folder = check_folder(options.output_dir)
    data = options.data.build()
    with bar() as shown:
        task = shown.add_task("reading frames", total=None)
        progress = advance or (lambda done, total: shown.update(task, completed=done, total=total))
        found = survey(data, options.splits, options.frames, progress)
    findings = diagnose(found)
    manifest = manifest_of(found, findings, folder / "manifest.json")
    title = f"saunet doctor: {type(data).__name__}{f' at {data.root}' if data.root else ''}"
    sheet = folder / "doctor.png"
    write_manifest(manifest.path, manifest)
    write_image(sheet, draw_sheet(found, findings, title))
    return Diagnosis(found, findings, manifest, sheet)
