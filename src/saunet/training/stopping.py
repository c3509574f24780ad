"""Orderly ends: a run that is asked to stop saves first, and one that loses a process reports it and ends."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
import time
from pathlib import Path
from subprocess import Popen
from types import FrameType
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from torch import distributed

from saunet.errors import SaunetError, positive
from saunet.io.said import PRINTED, say
from saunet.runs.folder import Stopped, first_process, mark_lost, read
from saunet.weights.locate import run_of

LAST = "last.ckpt"


def way_on(folder: str | Path) -> str:
    """Return how to resume a run with this checkpoint folder, as the end of a sentence."""
    last = Path(folder) / LAST
    if not last.is_file():
        return "no checkpoint was written yet, so start again"
    run = run_of(last)
    if run is not None and read(run).get("overrides"):  # started from a command line
        return f"resume with saunet resume {shlex.quote(str(run))}"
    return f"resume with resume={last}"


class GracefulStop(Callback):
    """On SIGTERM, SIGHUP, Ctrl-C, or a batch system's SIGUSR1: finish the step, save ``last.ckpt``, end with a message.

    All processes of a run stop after the same step, whichever of them was asked. A second Ctrl-C ends at once. A
    validation that is running or due is finished first, and so is an epoch after its last step: a training with no step
    left is then complete, and ends that way.

    Args:
        folder: Where ``last.ckpt`` is saved.
        every_n_steps: Steps between exchanges among several processes; they also exchange at the end of an epoch.
    """

    def __init__(self, folder: str, every_n_steps: int = 4) -> None:
        self.folder = Path(folder)
        self.every_n_steps = int(positive("every_n_steps", every_n_steps))
        self.received: int | None = None
        self._process = os.getpid()
        self._agreed = 0  # the signal for which all processes stop
        self._saved = self._went_on = self._noted = False
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Handle signals instead of the trainer, which would stop between two steps without saving."""
        if threading.current_thread() is not threading.main_thread():
            return
        wanted = [signal.SIGTERM, signal.SIGINT]
        if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # set by nohup
            wanted.append(signal.SIGHUP)
        if "SLURM_JOB_ID" in os.environ and hasattr(signal, "SIGUSR1"):
            wanted.append(signal.SIGUSR1)
        self._before = {number: signal.signal(number, self._receive) for number in wanted}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save if any process was asked to stop, at a step where no accumulated gradient is lost."""
        if (batch_idx + 1) % trainer.accumulate_grad_batches and not trainer.is_last_batch:
            return
        number = self._agreed or self.received or 0
        if self.received and not self._noted:  # not in the handler, which may interrupt a line of the log
            self._noted = True
            PRINTED.info(_answer(self.received))
        if trainer.world_size > 1 and not self._agreed:
            if trainer.global_step % self.every_n_steps and not trainer.is_last_batch:
                return
            asked = torch.tensor(number, device=pl_module.device)
            distributed.all_reduce(asked, distributed.ReduceOp.MAX)
            number = int(asked)
        self._agreed = number
        if number:  # before a validation that is due too: the sender of the signal may not wait for its end
            self._save(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the validation's results with the next step or at the end of the epoch."""
        if self._agreed and not self._went_on:  # once: there may be a validation after every step
            self._saved, self._went_on = False, True

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save with everything that belongs to the epoch."""
        if self._agreed:
            self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        trainer.save_checkpoint(self.folder / LAST, weights_only=False)
        self._saved = True

    def _stop(self, trainer: Trainer, *_: Any, **__: Any) -> None:
        """Stop before another step or epoch, once the last step is logged."""
        if not self._saved:
            return
        self._restore()
        number = self._agreed
        name = signal.Signals(number).name
        message = f"stopped by {name} after step {trainer.global_step}, everything is saved; {way_on(self.folder)}"
        # If one process starts the others, it treats their nonzero exit as a crash.
        raise Stopped(message, 128 + number if trainer.is_global_zero else 0)

    on_train_batch_start = on_train_epoch_start = _stop

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._process:  # a loader's process that has just been forked, and not yet its own handler
            return
        if self.received == signal.SIGINT == number:
            raise KeyboardInterrupt
        self.received = number
        if not first_process():  # a terminal and SLURM ask all processes of a run: one of them answers
            return
        try:
            print(f"\n{_answer(number)}", file=sys.stderr, flush=True)
        except OSError:  # the terminal is gone: writing there, as the bar does, must not fail before saving
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in (1, 2):
                os.dup2(nowhere, stream)

    def _restore(self, *_: Any, **__: Any) -> None:
        """Stop handling signals."""
        before, self._before = self._before, {}
        for number, handler in before.items():
            signal.signal(number, handler)

    on_train_end = on_exception = _restore


def _answer(number: int) -> str:
    return f"{signal.Signals(number).name}: finishing the step, then saving"


class ProcessWatch(Callback):
    """End the whole run with one sentence when one of its processes dies, instead of waiting for it for ever.

    For runs whose processes the trainer starts (``trainer=ddp``); torchrun and SLURM watch over theirs themselves.
    Torchrun's own watch cannot replace this one: it starts the processes itself, gives the others 30 s after a SIGTERM
    that a process inside a collective call cannot handle, and leaves ``run.json`` at "running". Lightning's watch kills
    all processes, this one included, without a message.

    Args:
        folder: The run's folder, to note the end in its record.
        checkpoints: Where ``last.ckpt`` is.
    """

    def __init__(self, folder: str, checkpoints: str) -> None:
        self.folder, self.checkpoints = Path(folder), Path(checkpoints)
        self._thread: threading.Thread | None = None
        self._own_end = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Start watching: the first process watches its children, the children their parent."""
        started: list[Popen[bytes]] = list(getattr(trainer.strategy.launcher, "procs", None) or [])
        environment = getattr(trainer.strategy, "cluster_environment", None)
        if started:
            _silence_lightnings_watch()
            self._thread = threading.Thread(target=self._watch_children, args=(started,), daemon=True)
        elif isinstance(environment, LightningEnvironment) and int(os.environ.get("LOCAL_RANK", "0")) > 0:
            self._thread = threading.Thread(target=self._watch_parent, args=(os.getppid(),), daemon=True)
        if self._thread is not None:
            self._thread.start()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._own_end = True

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Let the watch report if the only error here is that another process is gone."""
        if isinstance(exception, SaunetError | SystemExit | KeyboardInterrupt):
            self._own_end = True
        elif self._thread is not None:
            self._thread.join(timeout=3)
            self._own_end = True

    def _watch_children(self, started: list[Popen[bytes]]) -> None:
        while not self._own_end:
            for rank, process in enumerate(started, start=1):
                code = process.poll()
                if code:
                    if code > 0 and self._ends_by_itself():
                        return
                    how = f"was killed (signal {-code})" if code < 0 else f"ended with code {code} (see its message)"
                    self._end(f"process {rank} of {len(started) + 1} {how}, so the run ends", started)
            time.sleep(0.2)

    def _ends_by_itself(self) -> bool:
        """Wait a moment: the cause of another process's end may be ending this one too, with a better message."""
        time.sleep(1)
        return self._own_end

    def _watch_parent(self, parent: int) -> None:
        while not self._own_end:
            if os.getppid() != parent:
                self._end("the first process of the run is gone, so the run ends", [])
            time.sleep(0.2)

    def _end(self, reason: str, started: list[Popen[bytes]]) -> None:
        sentence = f"{reason}; {way_on(self.checkpoints)}"
        mark_lost(self.folder, sentence)
        print(file=sys.stderr)  # the progress bar may have left its line open
        say(f"saunet train: {sentence}", error=True)
        for process in started:
            process.kill()
        os._exit(1)  # the main thread is blocked in a collective call, where no exception can reach it


def _silence_lightnings_watch() -> None:
    """Keep Lightning's own watch from killing this process before it has reported why."""
    for thread in threading.enumerate():
        if thread.name == "child-process-observer":
            thread._child_processes = []  # type: ignore[attr-defined]
