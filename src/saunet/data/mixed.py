"""Several data sets as one: trained on together, evaluated together and separately."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from functools import partial
from typing import Any

from typing_extensions import Unpack

from saunet import schema
from saunet.data.drive import Drive, DriveProxy
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading
from saunet.data.loading.windows import Selection, measured_distance
from saunet.errors import ConfigError, one_of
from saunet.registry import datamodules

SHARED: tuple[str, ...] = ("height", "width", "offsets", "batch_size", "workers", "crop_margin", "seed")
SHARED += ("target_depth", "with_pose", "stereo", "on_error", "guess_camera")
"""Settings that belong to the mixture and apply to all sources."""


@datamodules.register("mixed")
class MixedDataModule(DepthDataModule):
    """Several named data sets as one, such as KITTI and your own clips; images get one size, and each keeps its own K.

    On the command line: ``data=mixed +data@data.sources.town=kitti +data@data.sources.clips=video`` and then
    ``data.sources.town.root=...``. Settings that every data set has (size, offsets, batch, augmentation) are set for
    the mixture. If only one source has ``with_speed``, its samples have the distance traveled, and those of others mark
    it unknown.

    Args:
        sources: Name -> data module; sample names begin with these names.
        train: Names of the sources to train and validate on; all if empty.
        test: Names of the sources to test and predict; all if empty.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if there is no source, a name is unknown, a source contradicts the mixture, or their ground truth
            is of different kinds.
    """

    cacheable = False

    def __init__(
        self,
        *,
        sources: Mapping[str, Any] | None = None,
        train: Sequence[str] = (),
        test: Sequence[str] = (),
        target_depth: bool = False,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, **loading)
        if not sources:
            raise ConfigError(
                "data=mixed has no sources; add them with +data@data.sources.NAME=kitti (or video, ...) and set "
                "data.sources.NAME.root"
            )
        self.sources: dict[str, DepthDataModule] = {}
        for name, source in sources.items():
            if not isinstance(source, DepthDataModule) or isinstance(source, MixedDataModule) or "/" in name:
                raise ConfigError(
                    f"data.sources.{name} is {type(source).__name__}; it must be a data module other than a mixture, "
                    "and its name must not contain '/'"
                )
            self.sources[name] = self._fitted(name, source)
        self._names = {
            key: tuple(one_of(key, name, self.sources) for name in names) or tuple(self.sources)
            for key, names in (("train", train), ("test", test))
        }
        with_speed = frozenset(name for name, source in self.sources.items() if source.odometer or self.odometer)
        self.odometer = partial(_distance, with_speed) if with_speed else None
        self.ground_truth, self.protocol = _truth([self.sources[name] for name in self._names["test"]])

    @property
    def camera_height(self) -> float | None:
        """Meters from the road to the camera if all sources in use agree, else None."""
        names = {*self._names["train"], *self._names["test"]}
        heights = {self.sources[name].camera_height for name in names}
        return heights.pop() if len(heights) == 1 else None

    @property
    def protocols(self) -> tuple[str, ...]:
        """Names of the protocols of its sources to test: for their ground truth, and for those without any."""
        tested = [self.sources[name] for name in self._names["test"]]
        without = [source.protocol for source in tested if source.ground_truth == "none"]
        return tuple(dict.fromkeys((self.protocol, *without)))

    def prepare_data(self) -> None:
        for source in self.sources.values():
            source.prepare_data()

    def select(self, split: str) -> Sequence[Selection]:
        """Return the frames of all sources of a split; a drive's name begins with its source's."""
        selections = []
        for name in self._names["train" if split in ("train", "val") else "test"]:
            source = self.sources[name]
            for each in source.select(split):
                selection = Selection(*each)
                if source.manifest is not None and split in ("train", "val"):
                    selection = source.manifest.apply(selection, self.offsets if self.has_neighbors(split) else ())
                selections.append(selection._replace(drive=_Named(f"{name}/{selection.drive.name}", selection.drive)))
        return selections

    def overlap(self) -> str | None:
        found = ((name, self.sources[name].overlap()) for name in self._names["train"])
        return "; ".join(f"{name}: {said}" for name, said in found if said) or None

    def speed_problems(self) -> list[str]:
        return [f"{name}: {problem}" for name, source in self.sources.items() for problem in source.speed_problems()]

    def _check_manifests(self, names: Set[str]) -> None:
        super()._check_manifests(names)
        for name in self._names["train"]:
            start = f"{name}/"
            own = {each.removeprefix(start) for each in names if each.startswith(start)}
            self.sources[name]._check_manifests(own)

    def _fitted(self, name: str, source: DepthDataModule) -> DepthDataModule:
        """Apply the mixture's settings to a source; refuse contradicting ones."""
        if source.maps or source.copies:
            raise ConfigError(
                f"data.sources.{name} reads stored maps or a cache of small images, which a mixture does not "
                "support; leave dense, teacher and cache out"
            )
        parameters = schema.parameters(type(source))
        presets = [entry.preset for entry in datamodules if entry.target is type(source)]
        for key in (*SHARED, "flip_prob", "color_jitter_prob"):
            defaults = [parameters[key].default] if key in parameters else []
            defaults += [preset[key] for preset in presets if key in preset]
            given, ours = getattr(source, key), getattr(self, key)
            defaults = [tuple(each) if isinstance(each, list) else each for each in defaults]
            if key in parameters and given not in (ours, *defaults):
                has = key in schema.parameters(type(self))
                advice = f"set only data.{key}, which applies to all sources" if has else "leave it out"
                raise ConfigError(f"data.sources.{name}.{key} is {given} but the mixture's is {ours}; {advice}")
        for key in SHARED:
            setattr(source, key, getattr(self, key))
        return source


class _Named(DriveProxy):
    """A recording under another name."""

    def __init__(self, name: str, drive: Drive) -> None:
        super().__init__(drive)
        self._name = name

    @property
    def name(self) -> str:
        return self._name


def _distance(with_speed: frozenset[str], drive: Drive, first: int, second: int) -> float:
    """Return the meters traveled if the drive's source has ``with_speed``, else NaN."""
    return measured_distance(drive, first, second) if drive.name.partition("/")[0] in with_speed else math.nan


def _truth(sources: Sequence[DepthDataModule]) -> tuple[str, str]:
    """Return the kind of ground truth of sources that have any, and the protocol for it."""
    kinds = {source.ground_truth: source.protocol for source in sources if source.ground_truth != "none"}
    if not kinds:
        return sources[0].ground_truth, sources[0].protocol
    if set(kinds) == {"camera_z", "exact"}:  # a renderer's depth is a camera's z
        return "camera_z", kinds["camera_z"]
    if len(kinds) > 1:
        raise ConfigError(
            f"the sources have ground truth of different kinds ({', '.join(sorted(kinds))}), which no protocol can "
            "mix; give all sources the same data.sources.NAME.depth, or name the sources to evaluate with data.test"
        )
    return next(iter(kinds.items()))
