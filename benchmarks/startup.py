"""How long the command line takes to answer: processor time of this checkout beside that of another, in pairs.

``python benchmarks/startup.py /path/to/other/src`` prints the ratio for each command: this time over the other.
The other checkout may be older than the command ``saunet``:
its tools are then started as ``python -m saunet.cli.TOOL``.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parents[1] / "src"
COMMANDS = {
    "train --help": (["train", "--help"], ["train", "--help"]),
    "a misspelt key": (["train", "sead=3"], ["train", "sead=3"]),
    "components": (["components"], ["components"]),
    "one key by Tab": (["--complete", "saunet train data.ba"], ["train", "-sc", "query=bash"]),
}
"""What is typed -> the words here, and the words for the other checkout."""


def seconds(source: Path, words: list[str]) -> float:
    """Return user and system time of one start."""
    here = (source / "saunet" / "__main__.py").is_file()
    command = ["-m", "saunet", *words] if here else ["-m", f"saunet.cli.{words[0]}", *words[1:]]
    line = "saunet train data.ba"
    environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
    environment |= {"COMP_LINE": line, "COMP_POINT": str(len(line))}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *command], env=environment, capture_output=True, timeout=300, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path, help="src folder of the other checkout")
    parser.add_argument("--pairs", type=int, default=5)
    given = parser.parse_args()
    for name, (ours, others) in COMMANDS.items():
        seconds(HERE, ours)  # the table of keys is made once
        pairs = [(seconds(HERE, ours), seconds(given.other, others)) for _ in range(given.pairs)]
        ratios = sorted(one / other for one, other in pairs)
        mine, other = (statistics.median(times) for times in zip(*pairs, strict=True))
        ratio = f"{statistics.median(ratios):.3f} ({ratios[0]:.3f} to {ratios[-1]:.3f})"
        print(f"{name:16} {mine:6.2f} s / {other:6.2f} s, ratio {ratio}")


if __name__ == "__main__":
    main()
