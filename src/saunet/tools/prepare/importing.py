"""Recordings of robots and cameras as clips for ``data=video``: ROS bags, MCAP, GoPro videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from saunet.data.video.calibrations import FILE_NAME
from saunet.data.video.camera import read_camera, write_camera
from saunet.errors import ConfigError, DataError
from saunet.io.video import VIDEO_SUFFIXES
from saunet.tools.prepare.bags import Bag, BagClip
from saunet.tools.prepare.gopro import RECORD, has_telemetry, import_video
from saunet.tools.prepare.pool import OnError

_BAGS = (".bag", ".mcap", ".db3")


@dataclass(frozen=True, slots=True)
class ImportReport:
    """The result of `import_recordings`."""

    made: int
    """Pictures written now."""
    before: int
    """Pictures that existed already."""
    failures: tuple[str, ...]
    """One sentence for each picture or video that cannot be read and was skipped."""
    clips: tuple[str, ...]
    """The content of each clip, one line per clip."""

    def __str__(self) -> str:
        counts = f"{self.made} frames made, {self.before} existed already, {len(self.failures)} skipped"
        return "\n".join([*self.clips, counts])


def import_recordings(
    source: str | Path,
    folder: str | Path,
    topics: Sequence[str] = (),
    camera: str | None = None,
    on_error: OnError = "raise",
) -> ImportReport:
    """Turn the bags and GoPro videos at a path into clips below a folder, one for each image topic or video."""
    source, folder = Path(source).expanduser(), Path(folder).expanduser()
    failures = list[str]()
    bags, videos = find_recordings(source, failures if on_error == "skip" else None)
    given = read_camera(camera) if camera else None
    if topics and not bags:
        raise ConfigError(f"topics chooses image topics of bags, but {source} has none; leave it out")
    from_bags, made = list[BagClip](), list[tuple[Path, str]]()
    for bag in bags:
        from_bags += Bag(bag, folder, topics, on_error, failures).clips()
    for video in videos:
        try:
            made.append(import_video(video, folder))
        except DataError as error:
            if on_error == "raise":
                raise
            failures.append(str(error))
    homes = [*(clip.home for clip in from_bags if clip.names or clip.before), *(home for home, _ in made)]
    for home in homes:
        if given and not (home / FILE_NAME).exists():
            write_camera(home / FILE_NAME, given, f"saunet prepare import: from {camera}")
    lines = [
        f"{home}: {about}, " + ("camera" if (home / FILE_NAME).is_file() else f"no camera: add {FILE_NAME}")
        for home, about in made
    ]
    frames, before = (sum(getattr(clip, each) for clip in from_bags) for each in ("made", "before"))
    return ImportReport(frames, before, tuple(failures), (*map(str, from_bags), *lines))


def find_recordings(source: Path, failures: list[str] | None = None) -> tuple[list[Path], list[Path]]:
    """Return the bags and the GoPro videos at a path, itself or all below it; a ROS 2 bag has ``metadata.yaml``.

    Videos below it that cannot be read are added to ``failures``, or raised without such a list.
    """
    if not source.exists():
        raise DataError(f"no file or folder at {source}; check the path")
    suffix = source.suffix.lower()
    if source.is_file() and suffix in VIDEO_SUFFIXES:
        if not has_telemetry(source):
            raise DataError(
                f"{source} has no GoPro data track, so there is nothing to import; data=video reads it directly"
            )
        return [], [source]
    if source.is_file() or (source / "metadata.yaml").is_file():
        if source.is_file() and suffix not in _BAGS:
            raise DataError(
                f"{source} is neither a bag ({', '.join(_BAGS)}) nor a video; give one, or a folder of them"
            )
        return [source], []
    folders = [path.parent for path in source.rglob("metadata.yaml")]
    files = [path for path in source.rglob("*") if path.is_file() and not path.name.startswith(".")]
    files = [path for path in files if not (path.parent / RECORD).exists()]  # imported before
    bags = {*folders, *(path for path in files if path.suffix.lower() in _BAGS and path.parent not in folders)}
    videos = list[Path]()
    for path in sorted(path for path in files if path.suffix.lower() == ".mp4"):
        try:
            videos += [path] if has_telemetry(path) else []
        except DataError as error:
            if failures is None:
                raise
            failures.append(str(error))
    if not bags and not videos:
        raise DataError(
            f"no bag below {source}; looked for {', '.join(_BAGS)}, folders with metadata.yaml and .mp4 of GoPros"
        )
    return sorted(bags), videos
