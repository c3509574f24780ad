"""Ctrl-C that waits for the end of a frame, so that all results of a recording hold the same frames, whole."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def interrupt_noted(wanted: bool = True) -> Iterator[Callable[[], bool]]:
    """Note the first Ctrl-C of the block instead of raising; a second one raises as ever.

    Raised in the middle of writing a frame, it would leave nobody knowing whether the frame is in the file. Where
    Ctrl-C is ignored or another program handles it, and outside of the main thread, everything stays as it is.

    Args:
        wanted: False changes nothing.

    Yields:
        A function that tells whether Ctrl-C was pressed.
    """
    usual = signal.default_int_handler
    main = threading.current_thread() is threading.main_thread()
    if not wanted or not main or signal.getsignal(signal.SIGINT) is not usual:
        yield lambda: False
        return
    noted: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, usual)
        noted.append(number)

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(noted)
    finally:
        signal.signal(signal.SIGINT, usual)
