"""What the pages print is true: commands compose or run, Python runs."""

from __future__ import annotations

import copy
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pages import PAGES, ROOT, blocks, commands, composed, lines, mistakes
from processes import python

import saunet
from saunet.cli import app, table
from saunet.cli.compose import register_configs
from saunet.cli.table import config_dir
from saunet.cli.words import read_words
from saunet.exporting import tool as exporting
from saunet.registry import REGISTRIES

NOT_CONFIGURED = {"components", "resume", "demo"}  # takes names, no configuration
NOT_INSTALLED = ("hydra/launcher", "hydra/sweeper", "hydra.launcher", "hydra.sweeper")  # plugins of the sweep extra


def _overrides(command: str) -> list[str]:
    """Return the overrides of a printed command: no dots for "and so on", one job of a sweep, no job word or file."""
    _, tool, *given = shlex.split(command)
    kept = [word for word in given if "=" in word and not word.startswith(NOT_INSTALLED)]
    if app.TOOLS[tool].options is not None:
        kept = read_words(kept, app.TOOLS[tool], table.read())[1]
    single = []
    for override in OverridesParser.create().parse_overrides(kept):
        if override.is_sweep_override():
            if override.is_choice_sweep():  # a glob or an interval has no first value to take
                single.append(f"{override.get_key_element()}={next(iter(override.sweep_string_iterator()))}")
        else:
            single.append(str(override.input_line))
    return single


def _compose(tool: str, overrides: list[str]) -> None:
    """Compose a tool's choices, once for all commands that share them, and set the values one by one."""
    groups = composed(tool).hydra.runtime.choices
    parsed = OverridesParser.create().parse_overrides(overrides)
    if any(each.is_delete() or (each.is_add() and "." not in each.key_or_group) for each in parsed):
        compose(tool, overrides=overrides, return_hydra_config=True)
        return
    cfg = copy.deepcopy(composed(tool, *sorted(each.input_line for each in parsed if each.key_or_group in groups)))
    for each in parsed:
        if each.key_or_group not in groups:
            OmegaConf.update(cfg, each.key_or_group, each.value(), force_add=each.is_add())


def test_every_printed_command_composes() -> None:
    """A key that was renamed, or never was, fails here."""
    register_configs()
    wrong = []
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        for page, command in dict.fromkeys(commands("", "bash")):
            tool = shlex.split(command)[1]
            if tool in NOT_CONFIGURED or "plugins=" in command:  # a component that the page itself writes
                continue
            try:
                _compose(tool, _overrides(command))
            except (HydraException, OmegaConfBaseException) as error:
                wrong.append(f"{page}: {command}: {error}")
    assert not wrong, "\n".join(wrong)


def test_help_and_pages_keep_each_kitti_in_one_place() -> None:
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    texts += [path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py")]
    places = {place for text in texts for place in re.findall(r"[/ \"]data/kitti[\w/]*", text)}
    known = {"data/kitti", "data/kitti/2011_09_26", "data/kitti_odometry", "data/kitti_360"}
    assert {place[1:].rstrip("/") for place in places} == known


def _python(page: str) -> str:
    """Return all Python blocks of a page as one program."""
    return "".join(block.text for block in blocks("python") if block.page == page)


def _scripts() -> dict[str, list[str]]:
    """Return each page's runnable blocks as one shell script; later Python blocks build on earlier ones."""
    scripts: dict[str, list[str]] = defaultdict(list)
    python: dict[str, str] = defaultdict(str)
    for block in blocks("bash", "python"):
        if block.kind == "bash":
            scripts[block.page].append(block.text)
        else:
            python[block.page] += block.text
            scripts[block.page].append(f"{shlex.quote(sys.executable)} - <<'END'\n{python[block.page]}\nEND\n")
    return scripts


SCRIPTS = _scripts()
QUICK = sorted(page for page in SCRIPTS if not any(block.page == page for block in blocks("bash")))


def _bash(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run(
        ["bash", "-c", f"set -eu\n{script}"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )


def _run(script: str, folder: Path) -> None:
    # The pages speak from a clone's root; the copy keeps the clone clean.
    (folder / "docs").symlink_to(ROOT / "docs")
    done = _bash(script, folder)
    assert done.returncode == 0, f"{script}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


@pytest.mark.parametrize("page", [page for page in QUICK if page != "README.md"])
def test_the_python_of_a_page_runs(page: str, tmp_path: Path) -> None:
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    done = python("-c", _python(page), cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in SCRIPTS if page not in QUICK])
def test_the_commands_of_a_page_run(page: str, tmp_path: Path) -> None:
    _run("\n".join(SCRIPTS[page]), tmp_path)


@pytest.mark.slow
def test_the_python_of_the_readme_runs(tmp_path: Path) -> None:
    """Its reader has a model and a picture by then, under the names that it says."""
    beforehand = (
        "saunet train experiment=smoke output_dir=smoke\n"
        "cp smoke/checkpoints/best.ckpt best.ckpt\n"
        "cp docs/images/demo.png road.png"
    )
    _run("\n".join([beforehand, *SCRIPTS["README.md"]]), tmp_path)


@pytest.mark.parametrize(("command", "answer"), mistakes("README.md"))
def test_the_mistakes_that_the_readme_shows_end_as_it_says(command: str, answer: str, tmp_path: Path) -> None:
    done = python("-m", *shlex.split(command), cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith(answer.removesuffix("..."))


OWN_DATA = re.compile(r"/data/|\$[A-Z]|\.\.\.|RUN|=(video|clips)|hydra/launcher")
"""What plain blocks say of data, runs and clusters that only a reader has."""
QUICKLY = "model=sau_net_nano data=synthetic_tiny data.workers=0 logger=none trainer=smoke trainer.max_epochs=1"
TRAININGS = [
    (page, command)
    for page, command in commands("")
    if command.startswith("saunet train") and not OWN_DATA.search(command)
]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "command"), TRAININGS, ids=lambda value: str(value)[:60])
def test_the_trainings_that_need_no_data_train(page: str, command: str, tmp_path: Path) -> None:
    """Two steps of a small model each, with the settings that the page prints and the plugin that it writes."""
    quickly = QUICKLY
    if plugin := re.search(r"plugins=\[(\w+\.py)\]", command):
        _run("\n".join(SCRIPTS[page]), tmp_path)  # what it reads, where the page makes that
        texts = [block.text for block in blocks("python") if block.page == page]
        until = max(place for place, text in enumerate(texts) if ".register(" in text)
        (tmp_path / plugin[1]).write_text("".join(texts[: until + 1]))
        quickly = " ".join(word for word in quickly.split() if f" {word.partition('=')[0]}=" not in command)
    done = _bash(f"{command} {quickly} trainer.limit_train_batches=2", tmp_path)
    assert done.returncode == 0, f"{page}: {command}\n{done.stderr[-4000:]}"


def test_the_benchmarks_have_the_options_that_pages_name() -> None:
    named = defaultdict(set)
    for page, line in lines("", "bash"):
        if line.startswith("python benchmarks/"):
            _, script, *options = shlex.split(line)
            named[script] |= {(page, option) for option in options if option.startswith("--")}
    assert named
    for script, options in named.items():
        source = (ROOT / script).read_text(encoding="utf-8")
        missing = [f"{page}: {option}" for page, option in options if f'"{option.partition("=")[0]}"' not in source]
        assert not missing, f"{script} has no {missing}"


def test_the_table_of_export_formats_is_that_of_the_tool() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (yes|no) \| `([\w.]+)`", (ROOT / "docs" / "deploy.md").read_text("utf-8"), re.M)
    made = {
        name: ("yes" if name in exporting.DEFAULT_FORMATS else "no", exporting.FILES[name])
        for name in exporting.FORMATS
    }
    assert {name: (default, file) for name, default, file in rows} == made


def test_every_page_is_on_the_site() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    missing = [page.name for page in PAGES if page.parent == ROOT / "docs" and page.name not in navigation]
    assert not missing


def _reference() -> dict[str, list[str]]:
    """Return the names that each page of the reference describes."""
    pages = sorted((ROOT / "docs" / "api").glob("*.md"))
    return {page.stem: re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE) for page in pages}


def test_the_reference_describes_what_is_public() -> None:
    """That is each exported name and each registered component, once; nothing that does not exist."""
    listed = [name for names in _reference().values() for name in names]
    assert len(listed) == len(set(listed))
    found = {name: pkgutil.resolve_name(name) for name in listed}
    exported = {f"saunet.{name}" for name in saunet.__all__ if name != "__version__"}
    assert not exported - set(found)
    components = {
        entry.target for registry in REGISTRIES.values() for entry in registry if entry.path.startswith("saunet.")
    }
    described = {thing for thing in found.values() if isinstance(thing, type)}
    assert not components - described


def test_links_of_the_site_stay_in_it() -> None:
    """The strict build of the site refuses others."""
    pages = (page for page in PAGES if page.parent.name == "docs")
    outside = [
        (p.name, link) for p in pages for link in re.findall(r"\]\((\.\./[^)]*)\)", p.read_text(encoding="utf-8"))
    ]
    assert outside == []


def test_links_to_code_lead_to_names_on_that_page() -> None:
    """The strict build of the site checks this too, but is not part of every test run."""
    links = [
        (page.name, *link)
        for page in PAGES
        for link in re.findall(r"\(api/(\w+)\.md#([\w.]+)\)", page.read_text(encoding="utf-8"))
    ]
    assert {name for page, _, name in links if page == "paper.md"}
    reference = _reference()
    wrong = [f"{page}: {name} is not on api/{api}.md" for page, api, name in links if name not in reference[api]]
    assert not wrong
