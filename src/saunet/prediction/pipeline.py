"""The one way of predicting: pictures in, one pass of the network, every result out, a few pictures in memory."""

from __future__ import annotations

import contextlib
import itertools
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from types import FrameType

from saunet.errors import DataError
from saunet.io.colormaps import RunningRange
from saunet.io.progress import bar
from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.sinks import Sink
from saunet.prediction.sources import Frame


@dataclass(slots=True)
class Counts:
    """How far a pass came."""

    frames: int = 0
    failures: list[str] = field(default_factory=list)
    """One sentence for each picture that could not be read."""


def run(
    predictor: ImagePredictor,
    frames: Iterable[Frame],
    sinks: Sequence[Sink],
    limits: RunningRange,
    *,
    batch_size: int,
    total: int | None,
    tolerant: bool,
    live: bool,
    progress: bool = True,
    check: Callable[[Counts], None] = lambda counts: None,
) -> Counts:
    """Predict every frame into every sink."""
    counts, left = Counts(), iter(frames)
    with contextlib.ExitStack() as stack:
        stopped = stack.enter_context(_interrupt_noted(live))
        for sink in sinks:
            stack.enter_context(sink)
        shown = stack.enter_context(bar(progress))
        task = shown.add_task("predicting", total=total)
        try:
            while not stopped() and (batch := list(itertools.islice(left, batch_size))):
                pictures, kept = [], []
                for frame in batch:
                    try:
                        pictures.append(frame.read())
                        kept.append(frame)
                    except DataError as error:
                        if not tolerant:
                            raise
                        counts.failures.append(str(error))
                for frame, result in zip(kept, predictor.predict_batch(pictures), strict=True):
                    now = limits.update(result.disparity)
                    for sink in sinks:
                        sink.add(frame, result, now)
                    counts.frames += 1
                shown.advance(task, len(batch))
            if stopped() and counts.frames == 0:
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            if not live or stopped() or counts.frames == 0:
                raise
        check(counts)
    return counts


@contextlib.contextmanager
def _interrupt_noted(wanted: bool) -> Iterator[Callable[[], bool]]:
    """Note the first Ctrl-C of the block instead of raising; a second one raises as ever.

    Raised in the middle of writing a frame, it would leave nobody knowing whether the frame is in the file. Where
    Ctrl-C is ignored or another program handles it, and outside of the main thread, everything stays as it is.
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
