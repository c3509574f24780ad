"""What a run says by printing, which its log keeps too."""

from __future__ import annotations

import logging
import sys

PRINTED = logging.getLogger("saunet.printed")
"""Takes what stands on the terminal already: the log of a run listens to it, and the terminal does not."""
PRINTED.setLevel(logging.INFO)
PRINTED.propagate = False


def say(text: str, *, error: bool = False) -> None:
    """Print a line to standard output, or to standard error at once, and keep it in the log of the run."""
    print(text, file=sys.stderr if error else sys.stdout, flush=error)
    PRINTED.info(text)
