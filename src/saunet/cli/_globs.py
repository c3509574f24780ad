"""``experiment=glob(table3/*)``: Hydra's own glob sees the files of one folder only, this one those below it."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Sequence
from pathlib import Path

from saunet.errors import ConfigError

_GLOB = re.compile(r"""(?P<group>\w+)=['"]?glob\(['"]?(?P<pattern>[^,()'"]*/[^,()'"]*)['"]?\)['"]?""")


def expand_globs(arguments: Sequence[str], folder: Path) -> list[str]:
    """Return command-line arguments with every glob over a subfolder replaced by the names that it matches.

    Args:
        arguments: Such as ``["-m", "experiment=glob(table3/*)"]``.
        folder: The root of the YAML files.

    Raises:
        ConfigError: if a glob matches nothing; Hydra would run no job at all and call it success.
    """
    return [_expand(argument, folder) for argument in arguments]


def _expand(argument: str, folder: Path) -> str:
    found = _GLOB.fullmatch(argument)
    if not found:
        return argument
    group, pattern = found["group"], found["pattern"]
    names = sorted(
        path.relative_to(folder / group).with_suffix("").as_posix() for path in folder.glob(f"{group}/**/*.yaml")
    )
    matching = fnmatch.filter(names, pattern)
    if not matching:
        raise ConfigError(f"{group}=glob({pattern}) matches none of: {', '.join(names) or 'no files'}")
    return f"{group}={','.join(matching)}"
