"""How long the command line takes to answer: processor time of this checkout beside that of another, in pairs.

``python benchmarks/startup.py /path/to/other/src`` prints the ratio for each command: this time over the other.
The other checkout may be older than the command ``saunet``:
its tools are then started as ``python -m saunet.cli.TOOL``.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).parents[1] / "src"
COMMANDS = {
    "train --help": (["train", "--help"], ["train", "--help"]),
    "a misspelt key": (["train", "sead=3"], ["train", "sead=3"]),
    "components": (["components"], ["components"]),
    "one key by Tab": (["--complete", "saunet train data.ba"], ["train", "-sc", "query=bash"]),
    "predict a picture": 2 * (["predict", "input=road.png", "checkpoint=run/checkpoints/last.ckpt", "output=out"],),
    "predict with street": 2 * (["predict", "input=road.png", "checkpoint=street", "output=out"],),
}
"""What is typed -> the words here, and the words for the other checkout."""


def seconds(source: Path, words: list[str], folder: Path) -> float:
    """Return user and system time of one start in a folder."""
    here = (source / "saunet" / "__main__.py").is_file()
    command = ["-m", "saunet", *words] if here else ["-m", f"saunet.cli.{words[0]}", *words[1:]]
    line = "saunet train data.ba"
    environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
    environment |= {"COMP_LINE": line, "COMP_POINT": str(len(line))}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, *command], env=environment, cwd=folder, capture_output=True, timeout=900, check=False
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if words[0] == "predict" and done.returncode:
        raise SystemExit(done.stderr.decode())
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path, help="src folder of the other checkout")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--only", nargs="*", choices=COMMANDS, default=list(COMMANDS))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folders = {source: Path(temporary, name) for name, source in (("here", HERE), ("other", given.other.resolve()))}
        for source, folder in folders.items():
            folder.mkdir()
            cv2.imwrite(str(folder / "road.png"), np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8))
            if "predict a picture" in given.only:
                seconds(source, ["train", "experiment=smoke", "hydra.run.dir=run"], folder)
        for name in given.only:
            _, other = folders
            compare(name, (HERE, folders[HERE]), (other, folders[other]), given.pairs)


def compare(name: str, here: tuple[Path, Path], other: tuple[Path, Path], count: int) -> None:
    """Print one line of the table; a place is the source and the folder to start in."""

    def start(place: tuple[Path, Path], words: list[str]) -> float:
        shutil.rmtree(place[1] / "out", ignore_errors=True)
        return seconds(place[0], words, place[1])

    ours, others = COMMANDS[name]
    start(here, ours)  # the table of keys is made once
    pairs = [(start(here, ours), start(other, others)) for _ in range(count)]
    ratios = sorted(one / two for one, two in pairs)
    mine, theirs = (statistics.median(times) for times in zip(*pairs, strict=True))
    ratio = f"{statistics.median(ratios):.3f} ({ratios[0]:.3f} to {ratios[-1]:.3f})"
    print(f"{name:18} {mine:6.2f} s / {theirs:6.2f} s, ratio {ratio}", flush=True)


if __name__ == "__main__":
    main()
