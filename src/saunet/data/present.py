"""All data sets found below one folder, to evaluate a model on each of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from typing_extensions import Unpack

from saunet import schema
from saunet.data.loading.module import DepthDataModule
from saunet.data.loading.options import Loading, LoadOptions
from saunet.data.loading.windows import Selection
from saunet.errors import ConfigError, DataError, one_of
from saunet.registry import Entry, Spec, datamodules


@datamodules.register("all_present")
class PresentDataModule(DepthDataModule):
    """Every data set with depth that is present, for ``saunet evaluate`` only, each with its own split and protocol.

    A data set is looked for in the folder of its name below ``root``, such as ``kitti``, or recognized by its files at
    the root or up to two folders below.

    Args:
        root: Folder of the data sets; None uses only ``roots``.
        roots: Data sets elsewhere, name -> root, such as ``{kitti: /data/kitti}``.
        sets: Names of the data sets to look for; all registered ones if empty.
        settings: Settings of single data sets, such as ``{kitti: {test_split: eigen_benchmark_test}}``.
        **loading: Loader settings, as in `LoadOptions`, for all of them.

    Raises:
        ConfigError: if a name is unknown, or neither ``root`` nor ``roots`` is given.
    """

    cacheable = False

    def __init__(
        self,
        *,
        root: str | None = None,
        roots: Any = None,
        sets: Sequence[str] = (),
        settings: Any = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(**loading)
        self.root, self.roots, self.sets = root, _mapping("roots", roots), tuple(sets)
        self.settings = _mapping("settings", settings)
        known = _entries()
        for name in (*self.roots, *self.sets, *self.settings):
            one_of("data set", name, known)
        defaults = {each.name: each.default for each in fields(LoadOptions)}
        self._changed = {key: value for key, value in loading.items() if value != defaults[key]}

    def select(self, split: str) -> Sequence[Selection]:
        raise ConfigError(
            "data=all_present is for saunet evaluate, which scores each data set by itself; to train on several, "
            "use data=mixed"
        )

    def candidates(self) -> Iterator[tuple[str, Spec, bool]]:
        """Yield each data set to try: its name, where to look, and whether it was named or has its own folder."""
        if self.root is None and not self.roots:
            raise ConfigError("data=all_present needs data.root=FOLDER, or data.roots={NAME: FOLDER, ...}")
        if self.root is not None and not Path(self.root).expanduser().is_dir():
            raise DataError(f"no folder at {self.root}; set data.root to the folder that holds the data sets")
        for name, entry in _entries().items():
            if self.sets and name not in self.sets and name not in self.roots:
                continue
            place, sure = self.roots.get(name), True
            if place is None and self.root is not None:
                own = Path(self.root).expanduser() / name
                place, sure = (str(own), True) if own.is_dir() else (self.root, name in self.sets)
                if not sure and not _class(entry).recognizable:
                    continue
            if place is not None:
                given = {**self._changed, "root": place, **self.settings.get(name, {})}
                yield name, Spec.of("data", name, **given), sure


def _mapping(key: str, given: Any) -> dict[str, Any]:
    if given is not None and not isinstance(given, Mapping):
        raise ConfigError(f"{key} is {given!r}; give it per data set, such as data.{key}={{kitti: ...}}")
    return dict(given or {})


def _entries() -> dict[str, Entry]:
    """Return the data sets that read files with depth; for several names of one class, the one without a preset."""
    found: dict[str, Entry] = {}
    for entry in sorted(datamodules, key=lambda entry: (len(entry.preset), entry.name)):
        target = entry.target
        reads = "root" in schema.parameters(target) and target is not PresentDataModule
        if reads and _class(entry).ground_truth != "none" and entry.path not in {each.path for each in found.values()}:
            found[entry.name] = entry
    return dict(sorted(found.items()))


def _class(entry: Entry) -> type[DepthDataModule]:
    target = entry.target
    return target if isinstance(target, type) and issubclass(target, DepthDataModule) else DepthDataModule
