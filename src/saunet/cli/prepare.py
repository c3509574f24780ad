"""``saunet-prepare``: work done once before training: dense depth, a teacher's depth, smaller copies of recordings."""

from __future__ import annotations

import sys
from typing import Any

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import pick_device, run
from saunet.errors import ConfigError, one_of, suggest
from saunet.roots import PrepareConfig

KITTI = ("root", "cameras", "drives", "split")
"""Keys that choose recordings of a KITTI raw tree."""
SHARED = ("job", *KITTI, "folder", "on_error")
KEYS = {
    "densify": (*SHARED, "kinds", "depth", "workers"),
    "teacher": (*SHARED, "checkpoint", "input", "values", "device"),
    "cache": (*SHARED, "data", "height", "width", "format", "quality", "workers"),
}
"""Job -> the keys that it uses."""


def prepare(cfg: DictConfig) -> None:
    """Do one job and say what was done.

    Raises:
        ConfigError: if the job is unknown, or a key is not one of its own.
        DataError: if a recording cannot be read.
    """
    from saunet.data.workers import available_cores

    one_of("job", cfg.job, KEYS)
    plain = config.plain(cfg)
    default = PrepareConfig()
    for key, value in plain.items():
        if key not in KEYS[cfg.job] and value != getattr(default, key):
            owners = " and ".join(job for job, keys in KEYS.items() if key in keys)
            raise ConfigError(f"{key} belongs to saunet-prepare {owners}, not to {cfg.job}; leave it out")
        if plain["data"] and key in KITTI and value != getattr(default, key):
            raise ConfigError(f"{key} is for KITTI raw trees without data=...; with it, set data.{key} or leave it out")
    workers = available_cores() if cfg.workers is None else cfg.workers
    one_of("depth", cfg.depth, ("camera_z", "improved"))
    failures = _JOBS[cfg.job](plain, _recordings(plain), workers)
    for failure in failures:
        print(f"saunet-prepare: skipped: {failure}", file=sys.stderr)


def _recordings(cfg: dict[str, Any]) -> Any:
    from saunet.registry import instantiate
    from saunet.tools.prepare.recordings import kitti_recordings, module_recordings

    if cfg["data"]:
        data = instantiate(cfg["data"])
        if cfg["on_error"] == "skip":
            data.on_error = "skip"
        return module_recordings(data)
    if cfg["root"] is None:
        raise ConfigError("root is not set; add root=... to the command line")
    return kitti_recordings(cfg["root"], cfg["cameras"], cfg["drives"], cfg["split"], cfg["depth"])


def _densify(cfg: dict[str, Any], recordings: Any, workers: int) -> tuple[str, ...]:
    from saunet.tools.prepare.densify import densify

    done = densify(recordings, cfg["kinds"], cfg["folder"], workers, cfg["on_error"])
    print(
        f"{done.made} frames made, {done.before} were there, {done.without} have no scan, {len(done.failures)} skipped"
    )
    return done.failures


def _teacher(cfg: dict[str, Any], recordings: Any, workers: int) -> tuple[str, ...]:
    from saunet.tools.prepare.teacher import source_of, teach

    source = source_of(cfg["checkpoint"], cfg["input"], cfg["values"], pick_device(cfg["device"]))
    done = teach(recordings, source, cfg["folder"], cfg["on_error"])
    print(f"{done.made} frames made, {done.before} were there, {len(done.failures)} skipped")
    return done.failures


def _cache(cfg: dict[str, Any], recordings: Any, workers: int) -> tuple[str, ...]:
    from saunet.data.image_cache import CacheSettings
    from saunet.tools.prepare.cache import build_cache

    if cfg["folder"] is None:
        raise ConfigError("a cache needs a folder of its own; set folder=...")
    settings = CacheSettings(*(cfg[key] for key in ("height", "width", "format", "quality")))
    done = build_cache(recordings, cfg["folder"], settings, workers, cfg["on_error"])
    print(
        f"{done.made} copies made ({done.replaced} in place of damaged or outdated ones), {done.verified} verified: "
        f"{cfg['folder']}"
    )
    return done.failures


_JOBS = {"densify": _densify, "teacher": _teacher, "cache": _cache}


def main() -> None:
    """Entry point of ``saunet-prepare``."""
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    if word in KEYS:
        sys.argv[1] = f"job={word}"
    elif not word.startswith(("-", "job=")):
        hint = suggest(word, KEYS) or ";"
        sys.exit(f"saunet-prepare: the first word is the job, not '{word}'{hint} jobs: {', '.join(KEYS)}")
    run("prepare", prepare)


if __name__ == "__main__":
    main()
