"""Every job of the project, each in its own environment: ``nox -s demo``, ``nox -s tests``, ``nox -l`` lists all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import nox

nox.options.sessions = ["tests", "lint", "types"]
nox.options.reuse_existing_virtualenvs = True
nox.options.default_venv_backend = "venv"
ROOT = Path(__file__).parent


def install(session: nox.Session, *packages: str) -> None:
    """Install with the tested pins; PyTorch first, so that nothing else chooses its build."""
    constraints = ["-c", str(ROOT / "constraints.txt")]
    pin = next(line for line in (ROOT / "constraints.txt").read_text().splitlines() if line.startswith("torch=="))
    session.install(*constraints, pin)
    session.install(*constraints, *packages)


@nox.session
def demo(session: nox.Session) -> None:
    """Train, evaluate, and draw depth on the built-in synthetic drive (five to ten minutes on two cores)."""
    install(session, "-e", ".[weights]")
    session.run("python", "-m", "saunet", "demo", *session.posargs)


@nox.session
def tests(session: nox.Session) -> None:
    """Run the test suite (without the slow and gpu tests), a process a core; torch shares no core between tests."""
    install(session, "-e", ".[dev]")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    session.run(
        "pytest",
        "-n",
        str(min(cores, 8)),
        "--dist",
        "worksteal",
        *session.posargs,
        env={"OMP_NUM_THREADS": "1"},
    )


@nox.session
def slow(session: nox.Session) -> None:
    """Run the tests marked slow, those of the extra sweep's launchers and those in a browser among them."""
    install(session, "-e", ".[dev,sweep,browser,dask]")
    session.run("pytest", "-m", "slow and not gpu", *session.posargs)


@nox.session
def old_runtime(session: nox.Session) -> None:
    """Run exported files in onnxruntime 1.14, which needs Python 3.10 or older and NumPy 1."""
    install(session, "-e", ".[dev]")
    old = Path(session.create_tmp()).resolve() / "old"
    session.run("python3.10", "-m", "venv", str(old), external=True)
    session.run(str(old / "bin" / "pip"), "install", "onnxruntime==1.14.1", "numpy==1.26.4", external=True)
    tests = ("-m", "not gpu", "tests/exporting/test_old_runtime.py")
    session.run("pytest", *tests, *session.posargs, env={"SAUNET_OLD_RUNTIME": str(old / "bin" / "python")})


@nox.session
def first_hour(session: nox.Session) -> None:
    """Run the tutorials' commands as printed, in an environment that has the wheel and its own dependencies only."""
    install(session, "-e", ".[dev]")
    folder = Path(session.create_tmp()).resolve()
    session.run("python", "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), ".")
    session.run("python", "-m", "venv", "--clear", str(folder / "fresh"))
    pip = (str(folder / "fresh" / "bin" / "pip"), "install", "-q", "-c", str(ROOT / "constraints.txt"))
    pin = next(line for line in (ROOT / "constraints.txt").read_text().splitlines() if line.startswith("torch=="))
    session.run(*pip, pin, external=True)
    session.run(*pip, str(max(folder.glob("saunet-*.whl"), key=os.path.getmtime)), external=True)
    fresh = {"SAUNET_FIRST_HOUR": str(folder / "fresh" / "bin" / "python"), "OMP_NUM_THREADS": "1"}
    session.run("pytest", "-m", "not gpu", "tests/first_hour", *session.posargs, env=fresh)


@nox.session
def app(session: nox.Session) -> None:
    """Run the tests of ``saunet app``: Gradio wants older versions of some pinned packages, constraints-app.txt."""
    own = (ROOT / "constraints-app.txt").read_text().splitlines()
    names = {line.partition("==")[0] for line in own}
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    file = Path(session.create_tmp()).resolve() / "constraints.txt"
    file.write_text("\n".join([*own, *(line for line in pins if line.partition("==")[0] not in names)]))
    session.install("-c", str(file), next(line for line in pins if line.startswith("torch==")))
    session.install("-c", str(file), "-e", ".[dev,app,browser]")
    session.run("pytest", "-m", "not gpu", "tests/tools/app", *session.posargs)


@nox.session
def ddp(session: nox.Session) -> None:
    """Run the tests that start several processes."""
    install(session, "-e", ".[dev]")
    session.run("pytest", "-m", "ddp and not gpu", *session.posargs)


@nox.session
def timm(session: nox.Session) -> None:
    """Run the tests of encoders with timm, beside the newest PyTorch that its torchvision goes with."""
    session.install("torch==2.14.1", "torchvision==0.29.1")
    pins = [
        line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith(("torch", "triton"))
    ]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as others:
        others.write("\n".join(pins))
        others.flush()
        session.install("-c", others.name, "-e", ".[dev,timm]")
    session.run("pytest", "tests/models", "tests/weights", *session.posargs, env={"OMP_NUM_THREADS": "1"})


@nox.session
def lint(session: nox.Session) -> None:
    """Check style and formatting."""
    session.install("-c", str(ROOT / "constraints.txt"), "ruff")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")


@nox.session
def types(session: nox.Session) -> None:
    """Check types strictly."""
    install(session, "-e", ".[dev]")
    session.run("mypy", "src")


@nox.session
def wheel(session: nox.Session) -> None:
    """Build the wheel, install it in a clean environment and train from another folder."""
    with tempfile.TemporaryDirectory() as folder:
        session.run("python", "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ".")
        built = next(Path(folder).glob("saunet-*.whl"))
        install(session, "--force-reinstall", "--no-deps", str(built))
        install(session, str(built))
        session.chdir(folder)
        session.run("saunet", "train", "experiment=smoke")
        session.run("saunet", "components", "encoder")


@nox.session
def notebooks(session: nox.Session) -> None:
    """Execute the notebooks on synthetic data."""
    install(session, "-e", ".[dev]")
    # One thread: two that wait for each other by spinning come to a near halt where another job wants the cores too.
    session.run("python", "notebooks/execute.py", *session.posargs, env={"OMP_NUM_THREADS": "1"})


@nox.session
def docs(session: nox.Session) -> None:
    """Build the site strictly into ``.nox/site`` and run the commands and the Python that its pages print."""
    install(session, "-e", ".[dev,docs]")
    session.run("mkdocs", "build", "--strict", env={"NO_MKDOCS_2_WARNING": "1"})
    session.run("pytest", "-m", "not gpu", "tests/docs", *session.posargs)
