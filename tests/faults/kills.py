"""Kill every tool that writes, again and again, and check what each kill leaves.

``python tests/faults/kills.py --kills 100 --seed 1`` prints how many kills there were and what was wrong. Tools run in
children that are forked from this process, which has imported saunet already: a kill costs the tool's own time only.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import gc
import importlib
import itertools
import json
import os
import pkgutil
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

import cv2
import numpy as np
import torch
from clip_tree import frames, make_clip
from prepare_tree import make_tree
from safetensors.torch import load_file
from tiny_checkpoint import write_checkpoint

import saunet
from saunet.cli import app, compose
from saunet.io.video import VideoReader, VideoWriter
from saunet.runs.checkpoint import read_checkpoint

CAMERA = "image_size: [128, 80]\nK: [100, 100, 63.5, 39.5]\nfps: 10\ncamera_height: 1.4\n"
NOISE = ("log", ".lock", ".log")
"""Ends of names of files that are appended to, or that only a living process has."""
TENSORBOARD = "tfevents"
"""In names of files that TensorBoard appends to, a new one for every start."""
PATIENCE = 300.0
"""Seconds that an undisturbed run may take."""


@dataclass(frozen=True)
class Job:
    """A tool to kill."""

    name: str
    words: tuple[str, ...]
    """Its command line, which also continues what a killed run left."""
    results: str
    """The folder that it writes into."""
    same: Callable[[Path], object]
    """What of a finished run equals that of a run that nobody killed."""
    share: float = 1.0
    """Of the kills that are asked for: less for tools that take long."""


@dataclass
class Tally:
    """What happened to one tool."""

    kills: int = 0
    by_kind: Counter[str] = field(default_factory=Counter)
    too_late: int = 0
    """Runs that ended before their moment came."""
    finished: int = 0
    """Undisturbed runs after kills."""
    partial_seen: int = 0
    """Kills that left a partial file."""
    wrong: list[str] = field(default_factory=list)


# ---------------------------------------------------------------------------------------------- children


def preload() -> None:
    """Import all that tools import when they are called, so that their children need not."""
    for module in pkgutil.walk_packages(saunet.__path__, "saunet."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    compose.register_configs()
    gc.freeze()  # or else the children's collector would write to, and so copy, all memory that they share


def start(words: Sequence[str], folder: Path, moment: int | None = None) -> int:
    """Run ``saunet WORDS`` in a child, which kills itself at a moment of writing if one is given; return its number."""
    pid = os.fork()
    if pid:
        return pid
    code = 99
    try:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.setsid()
        log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.chdir(folder)
        _count_moments(folder / "moments", moment)
        sys.argv = ["saunet"]
        app.main(list(words))
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
        if isinstance(stop.code, str):
            print(stop.code)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _count_moments(file: Path, moment: int | None) -> None:
    """Count the moments before a file's data are safe, before it gets its name and after; die at the given one."""
    me, count, sync, replace = os.getpid(), itertools.count(1), os.fsync, os.replace

    def passing() -> None:
        number = next(count)
        if os.getpid() == me:
            file.write_text(str(number))
            if number == moment:
                os.kill(me, signal.SIGKILL)

    def fsync(descriptor: int) -> None:
        passing()
        sync(descriptor)

    def replacing(source: Any, target: Any) -> None:
        passing()
        replace(source, target)
        passing()

    os.fsync, os.replace = fsync, replacing  # type: ignore[assignment]


def wait(pid: int, seconds: float = PATIENCE) -> int | None:
    """Return the exit code of a child, negative for a signal; None if it is still running then."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    return None


def kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def partials(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if ".partial" in path.name)


# ---------------------------------------------------------------------------------------------- what is whole


def check_whole(path: Path) -> None:
    """Raise if a file that has its name is not whole."""
    if path.suffix == ".ckpt":
        read_checkpoint(path).networks()
    elif path.suffix == ".json":
        json.loads(path.read_text())
    elif path.suffix == ".npy":
        np.load(path)
    elif path.suffix == ".safetensors":
        load_file(path)
    elif path.suffix in (".png", ".jpg"):
        data = path.read_bytes()
        end = b"IEND\xaeB`\x82" if path.suffix == ".png" else b"\xff\xd9"
        assert data.endswith(end), "cut off"
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) is not None
    elif path.suffix == ".mp4":
        assert sum(1 for _ in VideoReader(path)) == VideoReader(path).declared
    elif path.suffix == ".pt2":
        torch.export.load(path)
    elif path.suffix == ".onnx":
        import onnx

        onnx.checker.check_model(str(path))
    elif path.suffix == ".md":
        assert path.stat().st_size > 0


def named(folder: Path) -> set[str]:
    """Return the files that have their names."""
    return {
        re.sub(r"motion-\w+", "motion-KEY", str(path.relative_to(folder)))  # its key hangs on when frames were decoded
        for path in folder.rglob("*")
        if path.is_file()
        and ".partial" not in str(path)
        and not path.name.endswith(NOISE)
        and TENSORBOARD not in path.name
    }


def contents(*suffixes: str) -> Callable[[Path], object]:
    def read(folder: Path) -> object:
        return {name: (folder / name).read_bytes() for name in named(folder) if name.endswith(suffixes)}

    return read


def training(folder: Path) -> object:
    """Return the weights that a training ended with, and the losses that it logged."""
    checkpoint = read_checkpoint(folder / "checkpoints" / "last.ckpt")
    with (folder / "csv" / "metrics.csv").open() as file:
        losses = [(row["step"], row["train/loss"]) for row in csv.DictReader(file) if row.get("train/loss")]
    return checkpoint.global_step, {k: v.numpy().tobytes() for k, v in checkpoint.state.items()}, losses


def scores(folder: Path) -> object:
    return json.loads((folder / "metrics.json").read_text()).get("views")


# ---------------------------------------------------------------------------------------------- the tools


def jobs(data: Path) -> Iterator[Job]:
    video = (f"data.root={data / 'clips'}", f"data.frames_cache={data / 'measured'}", "data.fps=null")
    small = ("data.height=64", "data.width=96", "data.batch_size=2")
    yield Job(
        "train",
        (
            *("train", "experiment=smoke", "data=video", *video, *small, "data.workers=2", "data.val_share=0.2"),
            *("trainer.max_epochs=3", "trainer.limit_train_batches=2", "callbacks.last.every_n_steps=1"),
            *("model/encoder=lite_mono_tiny", "model/decoder=lite_mono", "model/pose=posecnn"),
            *("output_dir=out", "hydra.run.dir=out", "resume=auto"),
        ),
        "out",
        training,
        0.5,
    )
    yield Job(
        "predict",
        (
            *("predict", f"checkpoint={data / 'model.ckpt'}", f"input={data / 'clips' / 'a'}", "output=out"),
            *("outputs=[color,png16,npy,mp4]", "device=cpu"),
        ),
        "out",
        contents(".png", ".npy"),
    )
    yield Job(
        "predict video",
        (
            *("predict", f"checkpoint={data / 'model.ckpt'}", f"input={data / 'drive.mp4'}", "output=out"),
            *("outputs=[mp4,npy]", "device=cpu", "overwrite=true"),
        ),
        "out",
        contents(".npy"),
    )
    yield Job(
        "evaluate",
        (
            *("evaluate", f"checkpoint={data / 'model.ckpt'}", "data=video", *video, "data.workers=2", "device=cpu"),
            *("output_dir=out", "hydra.run.dir=out"),
        ),
        "out",
        scores,
    )
    for formats, share in (("safetensors", 1.0), ("program", 0.2)):
        yield Job(
            f"export {formats}",
            (
                *("export", f"checkpoint={data / 'model.ckpt'}", "output=out", f"formats=[{formats}]"),
                *("overwrite=true", "hydra.run.dir=hydra"),
            ),
            "out",
            contents(".safetensors", "config.json"),
            share,
        )
    yield Job(
        "prepare cache",
        ("prepare", "cache", "data=video", *video, "folder=out", "height=40", "width=64", "workers=0"),
        "out",
        contents(""),
    )
    yield Job(
        "prepare densify",
        ("prepare", "densify", f"root={data / 'raw'}", "folder=out", "workers=0"),
        "out",
        contents(""),
    )
    yield Job(
        "doctor on a video",
        (
            *("doctor", "data=video", f"data.root={data / 'drive.mp4'}", f"data.camera={data / 'clips/camera.yaml'}"),
            *("data.frames_cache=out", "hydra.run.dir=hydra"),
        ),
        "out",
        contents(".jpg"),
    )


def make_data(data: Path) -> None:
    """Write what the tools read."""
    for seed, name in enumerate(("a", "b")):
        pictures = [cv2.resize(picture, (128, 80)) for picture in frames(12, 6, seed)]
        make_clip(data / "clips", name, pictures, CAMERA)
    with VideoWriter(data / "drive.mp4", 10) as writer:
        for picture in frames(16, 6, 3):
            writer.write(cv2.resize(picture, (128, 80)))
    make_tree(data / "raw")
    write_checkpoint(data / "model.ckpt")


def undisturbed(job: Job, folder: Path, tally: Tally) -> float:
    """Let the tool finish; return how long that took."""
    before = time.monotonic()
    code = wait(start(job.words, folder))
    if code != 0:
        said = (folder / "log").read_text().strip().splitlines()[-3:]
        tally.wrong.append(f"{job.name}: an undisturbed run ended with {code}: {' | '.join(said)}")
    return time.monotonic() - before


def attack(job: Job, folder: Path, lasts: float, moments: int, dice: random.Random, tally: Tally) -> None:
    """Start the tool and kill it: at a random time, at a moment of writing, or while a partial file is there."""
    kind, results = dice.choice(("time", "moment", "partial")), folder / job.results
    moment = dice.randint(1, moments) if kind == "moment" else None
    pid = start(job.words, folder, moment)
    if kind == "moment":
        code = wait(pid)
        if code is None:
            kill(pid)
            tally.wrong.append(f"{job.name}: hangs")
    elif kind == "time":
        code = wait(pid, dice.uniform(0, lasts))
    else:
        code, passed, end = None, dice.randint(0, 4), time.monotonic() + PATIENCE
        while code is None and time.monotonic() < end:
            code = wait(pid, 0.004)
            if results.is_dir() and partials(results):
                if not passed:
                    break
                passed -= 1
    if code is None:
        kill(pid)
        code = -signal.SIGKILL
    if code == -signal.SIGKILL:
        tally.kills += 1
        tally.by_kind[kind] += 1
    else:
        tally.too_late += 1
        if code:
            said = (folder / "log").read_text().strip().splitlines()[-1:]
            tally.wrong.append(f"{job.name}: after a kill, the next run ended with {code}: {''.join(said)}")


def check(job: Job, results: Path, before: set[str], steps: int, tally: Tally) -> tuple[set[str], int]:
    """Check that nothing is lost and that what has its name is whole; return the files and the steps trained."""
    now = named(results) if results.is_dir() else set()
    tally.partial_seen += bool(results.is_dir() and partials(results))
    for name in sorted(now):
        try:
            check_whole(results / name)
        except FileNotFoundError:  # a worker of the killed run tidied up
            continue
        except Exception as error:
            tally.wrong.append(f"{job.name}: {name} is not whole: {type(error).__name__}: {error}")
    lost = before - now
    if lost and "overwrite=true" not in job.words:
        tally.wrong.append(f"{job.name}: lost {sorted(lost)}")
    last = results / "checkpoints" / "last.ckpt"
    trained = read_checkpoint(last).global_step or 0 if last.is_file() else 0
    if trained < steps:
        tally.wrong.append(f"{job.name}: last.ckpt went back from step {steps} to {trained}")
    return now, trained


def torture(job: Job, top: Path, kills: int, dice: random.Random, tally: Tally, most: int = 6) -> None:
    """Kill a tool so many times, in rounds that end with an undisturbed run, which has to end like one never killed."""
    whole = top / job.name / "whole"
    whole.mkdir(parents=True)
    undisturbed(job, whole, tally)
    moments = int((whole / "moments").read_text())
    lasts = undisturbed(job, _fresh(top / job.name / "timed"), tally)  # the first one warms caches up
    if tally.wrong:
        return
    wanted, files = job.same(whole / job.results), named(whole / job.results)
    for number in itertools.count():
        if tally.kills >= kills or tally.too_late > 3 * kills + 20:
            break
        folder = _fresh(top / job.name / str(number))
        results, seen, steps = folder / job.results, set[str](), 0
        for _ in range(min(dice.randint(1, most), kills - tally.kills)):
            attack(job, folder, lasts, moments, dice, tally)
            seen, steps = check(job, results, seen, steps, tally)
        undisturbed(job, folder, tally)
        tally.finished += 1
        check(job, results, seen, steps, tally)
        if left := partials(folder):
            tally.wrong.append(f"{job.name}: left behind: {left}")
        if named(results) != files:
            tally.wrong.append(f"{job.name}: other files: {sorted(named(results) ^ files)}")
        elif job.same(results) != wanted:
            tally.wrong.append(f"{job.name}: ended otherwise than a run that was not killed")
        if tally.wrong:
            print("\n".join(tally.wrong), file=sys.stderr, flush=True)
        else:
            shutil.rmtree(folder)


def _fresh(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20, help="of each tool, fewer of those that take long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=[""], nargs="+", help="tools whose names begin so")
    parser.add_argument("--keep", help="a folder for what is wrong; by default one that is removed")
    given = parser.parse_args(arguments)
    if given.keep:
        Path(given.keep).mkdir(parents=True, exist_ok=True)
    top = Path(tempfile.mkdtemp(dir=given.keep))
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))  # what was counted until then is printed
    preload()
    make_data(_fresh(top / "data"))
    wrong = 0
    for job in jobs(top / "data"):
        if not job.name.startswith(tuple(given.only)):
            continue
        begin, used = time.monotonic(), sum(os.times()[:4])
        tally = Tally()
        try:
            torture(job, top, round(given.kills * job.share), random.Random(f"{given.seed} {job.name}"), tally)
        finally:
            spent = {"seconds": round(time.monotonic() - begin), "of CPU": round(sum(os.times()[:4]) - used)}
            print(json.dumps({"tool": job.name, **spent, **vars(tally)}), flush=True)
        wrong += len(tally.wrong)
    if given.keep is None:
        shutil.rmtree(top, ignore_errors=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
