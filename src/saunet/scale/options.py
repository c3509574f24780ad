"""Options shared by evaluation and prediction: how depth becomes meters, and the source of motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from saunet.errors import ConfigError, one_of, positive
from saunet.runs.record import Scale

METHODS = ("camera_height", "speed", "stereo")
"""Ways to measure the scale."""
SCALE_METHODS = ("auto", "none", "stored", *METHODS)
"""``auto``: the factor stored in the checkpoint, where there is one; `METHODS` measure it."""

_USED_BY = {
    "camera_height": "camera_height",
    "speeds": "speed",
    "align": "speed",
    "stereo": "stereo",
    "baseline": "stereo",
}

MOTIONS = ("auto", "tracked")
"""Source of the camera's motion after training: a pose network if there is one, or tracked points."""


@dataclass(frozen=True, kw_only=True)
class ScaleOptions:
    """How depth becomes meters without ground truth; see docs/scale.md.

    Args:
        method: ``auto`` (the factor that the checkpoint stores, if any), ``none``, ``stored``, or one that measures:
            ``camera_height``, ``speed``, ``stereo``.
        camera_height: Meters from the road to the camera; by default from the data or ``camera.yaml``.
        speeds: A CSV file with the columns ``time`` or ``frame``, ``speed`` and, for several drives, ``drive``.
        align: Find the clock offset of the speeds from the predicted motion, if their clock differs from the frames'.
        fps: Frames per second of the speeds.
        stereo: Images of the other camera of a stereo pair.
        baseline: Meters to the other camera.
        frames: Largest number of frames to measure, evenly spread.
        store: Write the measured factor into the checkpoint, or into an exported folder's ``config.json``.

    Raises:
        ConfigError: if a value is out of range, or ``store`` is set without a measurement.
    """

    method: str = "auto"
    camera_height: float | None = None
    speeds: str | None = None
    align: bool = False
    fps: float | None = None
    stereo: str | None = None
    baseline: float | None = None
    frames: int = 100
    store: bool = False

    def __post_init__(self) -> None:
        one_of("scale.method", self.method, SCALE_METHODS)
        positive("scale.frames", self.frames)
        if self.fps is not None:
            positive("scale.fps", self.fps)
        if self.store and not self.measures:
            raise ConfigError(
                f"scale.store=true stores what is measured and scale.method is '{self.method}'; "
                f"set scale.method to one of {', '.join(METHODS)}"
            )
        for key, method in _USED_BY.items():
            if getattr(self, key) not in (None, False) and self.method != method:
                raise ConfigError(
                    f"scale.{key} is set and scale.method is '{self.method}', which does not use it; "
                    f"set scale.method={method}, or leave scale.{key} out"
                )

    @property
    def measures(self) -> bool:
        """Whether the scale is measured on images, not taken from the checkpoint."""
        return self.method in METHODS

    def storable(self, checkpoint: str | Path) -> Path | None:
        """Return the file to store the measured factor in, None if it is not to be stored; see `scale_file`."""
        if not self.store:
            return None
        from saunet.scale.storing import scale_file

        return scale_file(checkpoint)

    def chosen(self, known: Scale | None) -> Scale | None:
        """Return the scale to apply, given the measured or stored one."""
        if self.method == "stored" and known is None:
            raise ConfigError(
                "scale.method is 'stored' but the checkpoint stores no scale; measure one, such as with "
                "scale.method=camera_height, and keep it with scale.store=true"
            )
        return None if self.method == "none" else known
