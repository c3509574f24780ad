"""Many small tasks over processes or a cluster, with a progress bar and a clean end in any case."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import cv2
import torch

from saunet.errors import ConfigError, DataError
from saunet.io.progress import bar

Item = TypeVar("Item")
Result = TypeVar("Result")
OnError = Literal["raise", "skip"]
_MOST_TASKS = 20_000
"""Tasks of a job without ``together``: a scheduler spends a millisecond and some kilobytes on each."""
_PATIENCE = 30
"""Seconds in which a scheduler has to answer."""


@dataclass(frozen=True, slots=True)
class Done:
    """The result of preparing depth maps."""

    made: int
    """Frames worked on now."""
    before: int
    """Frames that were finished before."""
    without: int | None
    """Frames that lack a scan; None where none is needed."""
    failures: tuple[str, ...]
    """One sentence for each frame that was skipped because a file is broken."""

    def __str__(self) -> str:
        scans = "" if self.without is None else f" {self.without} have no scan,"
        return f"{self.made} frames made, {self.before} existed already,{scans} {len(self.failures)} skipped"


@dataclass(frozen=True, slots=True)
class Workers:
    """The workers: processes of this machine (0: this process), or a Dask cluster."""

    processes: int = 0
    scheduler: str | None = None
    """Address of the cluster's scheduler."""


HERE = Workers()


class Work(Generic[Item, Result]):
    """The function for each item; it is sent to every process once, so items can be small.

    With ``on_error="skip"`` an item's `DataError` becomes a sentence in ``failures``.
    """

    def __init__(
        self, function: Callable[[Item], Result], workers: Workers = HERE, on_error: OnError = "raise"
    ) -> None:
        self.function, self.workers, self.on_error = function, workers, on_error
        self.failures: list[str] = []

    def run(
        self, items: Sequence[Item], title: str, together: Callable[[Item], Hashable] | None = None
    ) -> Iterator[tuple[Item, Result]]:
        """Yield each item with its result, in the order of completion.

        Items with equal ``together`` are processed one after the other by the same worker.
        """
        bundles: dict[Hashable, list[Item]] = {}
        for place, item in enumerate(items):
            key = place // (1 + len(items) // _MOST_TASKS) if together is None else together(item)
            bundles.setdefault(key, []).append(item)
        with bar() as shown:
            task = shown.add_task(title, total=len(items))
            for item, outcome in self._outcomes(list(bundles.values())):
                shown.advance(task)
                if isinstance(outcome, DataError):
                    if self.on_error == "raise":
                        raise outcome
                    self.failures.append(str(outcome))
                else:
                    yield item, outcome

    def _outcomes(self, bundles: Sequence[list[Item]]) -> Iterator[tuple[Item, Result | DataError]]:
        if self.workers.scheduler is not None:
            yield from self._on_cluster(bundles, self.workers.scheduler)
            return
        if self.workers.processes == 0 or sum(map(len, bundles)) < 2:
            for item in itertools.chain(*bundles):
                yield item, _attempt(self.function, item)
            return
        # Fresh processes, not forks: forking a process in which libraries have started threads can hang.
        count, context = min(self.workers.processes, len(bundles)), multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, context, _begin, (self.function,))
        try:
            waiting = {pool.submit(_work, bundle): bundle for bundle in bundles}
            for future in as_completed(list(waiting)):
                yield from zip(waiting.pop(future), future.result(), strict=True)
        except BrokenProcessPool as reason:
            raise DataError(
                f"one of the {count} processes was killed, most likely because memory ran out; run again with fewer "
                "workers"
            ) from reason
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _on_cluster(self, bundles: Sequence[list[Item]], address: str) -> Iterator[tuple[Item, Result | DataError]]:
        """Use a cluster; tasks of a lost worker are repeated by another, up to three times."""
        try:
            import distributed
        except ModuleNotFoundError as reason:
            raise ConfigError("executor=dask needs Dask; install it: pip install 'saunet[dask]'") from reason
        try:
            client = distributed.Client(address, timeout=_PATIENCE)
        except (OSError, ValueError, TypeError) as reason:
            raise ConfigError(f"no Dask scheduler answers at {address}; start one, or check scheduler") from reason
        with client:
            # Made by a task, not scattered: what was scattered to a worker is gone with it.
            function = client.submit(pickle.loads, pickle.dumps(self.function), pure=False)
            futures = client.map(_work_with, bundles, function=function, pure=False)
            waiting = dict(zip(futures, bundles, strict=True))
            try:
                for future in distributed.as_completed(futures):
                    yield from zip(waiting.pop(future), future.result(), strict=True)
            except distributed.KilledWorker as reason:
                raise DataError(
                    "several workers were lost on the same task, most likely because memory ran out; give each "
                    "more, or start fewer per machine"
                ) from reason
            except (distributed.CancelledError, distributed.comm.CommClosedError) as reason:
                raise DataError(f"the scheduler at {address} was lost; start it, and run this again") from reason
            except ImportError as reason:
                raise ConfigError(
                    f"a worker cannot import saunet ({reason}); install the same version there"
                ) from reason


_function: Callable[[Any], Any] | None = None


def _begin(function: Callable[[Any], Any]) -> None:
    """Make a process ready: one thread, deaf to Ctrl-C (its parent listens), and gone when its parent is gone."""
    global _function
    _function = function
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(bundle: list[Any]) -> list[Any]:
    assert _function is not None  # _begin ran first
    return [_attempt(_function, item) for item in bundle]


def _work_with(bundle: list[Any], function: Callable[[Any], Any]) -> list[Any]:
    """Work in a thread of a cluster's worker."""
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    return [_attempt(function, item) for item in bundle]


def _attempt(function: Callable[[Item], Result], item: Item) -> Result | DataError:
    try:
        return function(item)
    except DataError as error:
        return error
