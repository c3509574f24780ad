"""What a run says by printing, which its log keeps too."""

from __future__ import annotations

import logging

PRINTED = logging.getLogger("saunet.printed")
"""Takes what stands on the terminal already: the log of a run listens to it, and the terminal does not."""
PRINTED.setLevel(logging.INFO)
PRINTED.propagate = False


def say(text: str) -> None:
    """Print a line to standard output, and keep it in the log of the run."""
    print(text)
    PRINTED.info(text)
