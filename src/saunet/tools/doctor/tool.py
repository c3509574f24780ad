"""The doctor: check a data set before hours of training; findings, a sheet of pictures and a manifest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from saunet.data.loading.selecting import Manifest, write_manifest
from saunet.errors import ConfigError, checked, one_of, positive
from saunet.io.atomic import check_folder
from saunet.io.images import encode_png, write_image
from saunet.io.progress import bar
from saunet.registry import Spec, datamodules
from saunet.tools.doctor.findings import Finding, diagnose, manifest_of
from saunet.tools.doctor.sheet import draw_sheet
from saunet.tools.doctor.survey import SPLITS, Survey, survey


@checked
@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Options of `doctor`: what it checks, and where it writes.

    Raises:
        ConfigError: for no or an unknown split, or a negative number of frames.

    Examples:
        >>> options = saunet.DoctorOptions(data=saunet.Spec.of("data", "synthetic"), output_dir="look")
        >>> options.frames
        1000
    """

    data: Spec
    """The data module, with the settings of the planned training."""
    output_dir: str | Path | None = None
    """Folder for ``doctor.png`` and ``manifest.json``; None, the default in Python, writes none."""
    splits: Sequence[str] = SPLITS
    """Splits to check, out of ``train``, ``val`` and ``test``."""
    frames: int = 1000
    """Largest number of frames to read, evenly spread; 0 reads all."""

    def __post_init__(self) -> None:
        if not self.splits:
            raise ConfigError(f"splits is empty; name at least one of {', '.join(SPLITS)}")
        for split in self.splits:
            one_of("splits", split, SPLITS)
        positive("frames", self.frames, allow_zero=True)


@dataclass(frozen=True)
class Diagnosis:
    """The result of `doctor`; ``print`` shows the findings and what to do about them, a notebook also the pictures."""

    survey: Survey
    """All measurements."""
    findings: Sequence[Finding]
    """The findings, errors first."""
    manifest: Manifest
    """Frames that a training should leave out, as in ``manifest.json``."""
    picture: UInt8[np.ndarray, "_ _ 3"] = field(repr=False)
    """Frames, charts and findings on one sheet, RGB."""
    sheet: Path | None = None
    """The file of the sheet."""

    @property
    def usable(self) -> bool:
        """Whether the findings have no error."""
        return all(finding.level != "error" for finding in self.findings)

    @property
    def exit_code(self) -> int:
        """1 if the data cannot be trained on as they are."""
        return 0 if self.usable else 1

    def __str__(self) -> str:
        found, path = self.survey, self.manifest.path
        lines = [*map(str, self.findings), *([f"pictures: {self.sheet}"] if self.sheet else [])]
        if found.judged and self.sheet:
            left_out = sum(len(frames) for reasons in self.manifest.leave_out.values() for frames in reasons.values())
            judged = "all" if found.judged == found.known else f"{found.judged} of {found.known}; frames=0 checks all"
            frames = "1 frame" if left_out == 1 else f"{left_out} frames"
            lines.append(f"manifest: {path} lists {frames} to leave out (checked: {judged})")
            if self.usable and left_out:
                lines.append(f"train with data.manifest={path}")
        return "\n".join(lines)

    def _repr_png_(self) -> bytes:
        return encode_png(self.picture)


def doctor(options: DoctorOptions, *, advance: Callable[[int, int], None] | None = None) -> Diagnosis:
    """Read and check frames of a data set, and write ``doctor.png`` and ``manifest.json``.

    Args:
        options: What to check, and where to write.
        advance: Called with the number of frames read and their total; a progress bar if None.

    Returns:
        The findings; broken data are findings, not exceptions.

    Raises:
        ConfigError: if the data module cannot be built.
        DataError: if the results cannot be written.

    Examples:
        >>> data = saunet.Spec.of("data", "synthetic_tiny", workers=0)
        >>> diagnosis = saunet.doctor(saunet.DoctorOptions(data=data, output_dir="look", frames=4))
        >>> diagnosis.usable
        True
    """
    folder = None if options.output_dir is None else check_folder(options.output_dir)
    data = options.data.build()
    with bar() as shown:
        task = shown.add_task("reading frames", total=None)
        progress = advance or (lambda done, total: shown.update(task, completed=done, total=total))
        found = survey(data, options.splits, options.frames, progress)
    findings = diagnose(found)
    manifest = manifest_of(found, findings, (folder or Path()) / "manifest.json")
    title = f"saunet doctor: {data.root or type(data).__name__.removesuffix('DataModule').lower()}"
    picture = draw_sheet(found, findings, title)
    if folder is None:
        return Diagnosis(found, findings, manifest, picture)
    write_manifest(manifest.path, manifest)
    write_image(folder / "doctor.png", picture)
    return Diagnosis(found, findings, manifest, picture, folder / "doctor.png")


def inspect(data: str | Path | Spec, *, frames: int = 200, **settings: Any) -> Diagnosis:
    """Check a data set: frames, their motion, the camera, and problems; nothing is written.

    Args:
        data: A folder of clips or a video, a data module's name (one of ``available("data")``), or its `Spec`.
        frames: Largest number of frames to read, evenly spread; 0 reads all.
        **settings: Parameters of the data module, such as ``root="/data/kitti"``.

    Returns:
        The findings; a notebook shows them with pictures.

    Raises:
        ConfigError: for a path that does not exist, or parameters that do not fit the data module.

    Examples:
        >>> found = saunet.inspect("synthetic_tiny", frames=4)
        >>> found.usable
        True
    """
    if not isinstance(data, Spec):
        path = Path(data)
        known = str(data) in datamodules.names()
        if not known and not path.exists():
            one_of("data", str(data), datamodules.names())
        data = Spec.of("data", str(data), **settings) if known else Spec.of("data", "video", root=str(data), **settings)
    else:
        data = data.changed(**settings)
    return doctor(DoctorOptions(data=data, frames=frames))
