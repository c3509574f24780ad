"""From a command line to a tool's options: types, text, lists, paths, and what is said of mistakes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import pytest
from echo_tool import ECHOED, EchoOptions
from processes import python

from saunet.cli import app, table
from saunet.cli.table import Tool
from saunet.cli.words import read_words
from saunet.errors import ConfigError

ECHO = Tool(
    "echo",
    "return what was given",
    ("echo road.png",),
    "input",
    options="echo_tool:EchoOptions",
    function="echo_tool:echo",
)
Said = Callable[..., tuple[int, str, str]]


@pytest.fixture
def echo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Said]:
    """Run ``saunet echo``: ``code, out, err = echo("count=4")``; its options are the last of `ECHOED`."""
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "echo.yaml").write_text(
        "defaults:\n  - echo_schema\n  - data: null\n  - override hydra/job_logging: terminal\n  - _self_\n"
        "output_dir: ${hydra:runtime.output_dir}\n"
    )
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr(sys, "argv", ["saunet"])
    monkeypatch.setenv("XDG_CACHE_HOME", str(CACHE))
    ECHOED.clear()

    def run(*words: str) -> tuple[int, str, str]:
        code = 0
        try:
            app.main(["echo", f"--config-dir={tmp_path / 'conf'}", *words])
        except SystemExit as stop:
            code = int(stop.code or 0)
        said = capsys.readouterr()
        return code, said.out, said.err

    with mock.patch.dict(app.TOOLS, {"echo": ECHO}):
        yield run


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    global CACHE
    CACHE = tmp_path_factory.mktemp("cache")


CACHE = Path()


def _given(echo: Said, *words: str) -> EchoOptions:
    code, _, err = echo(*words)
    assert code == 0, err
    return ECHOED[-1]


@pytest.mark.parametrize(
    "text",
    [
        "2024_05_01",
        "0001",
        "1e5",
        "true",
        "road.png",
        "/data/a b/c.png",
        "a=b.png",
        "x,y.png",
        "[1].png",
        "a(1).png",
        "#1.png",
        "{a}.png",
        "it's.png",
        'say "x".png',
        "C:\\data\\x.png",
        "tail\\",
        "12:30",
        "ünï.png",
    ],
)
def test_text_stays_what_was_typed(echo: Said, text: str) -> None:
    assert _given(echo, f"input={text}").input == text
    assert _given(echo, f"output_dir={text}").output_dir == text


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("names=one", ("one",)),
        ("names=[one]", ("one",)),
        ("names=one,two", ("one", "two")),
        ("names=[2024_05_01,0001]", ("2024_05_01", "0001")),
        ("names=['a,b', c d]", ("a,b", "c d")),
        ("names=[]", ()),
    ],
)
def test_one_value_is_a_list_of_one_and_names_stay(echo: Said, word: str, names: tuple[str, ...]) -> None:
    assert _given(echo, word).names == names


def test_names_in_a_yaml_file_stay_what_was_typed(echo: Said, tmp_path: Path) -> None:
    (tmp_path / "conf" / "mine.yaml").write_text(
        "defaults: [echo, _self_]\noutput_dir: 2024_05_01\ninput: 0001\nnames: [0001, 1e5, 12:30, yes, 2024_05_01]\n"
        "numbers: [1_000, 1e-4]\ncount: 0x10\nflag: yes\nextra: {factor: 1_000}\ndata: null\n"
        "inner: {factor: 1e-3, note: 007}\n"
    )
    options = _given(echo, "--config-name=mine")
    assert (options.output_dir, options.input) == ("2024_05_01", "0001")
    assert options.names == ("0001", "1e5", "12:30", "yes", "2024_05_01")
    assert options.numbers == (1000.0, 1e-4)
    assert (options.count, options.flag, options.extra) == (16, True, {"factor": 1000})
    assert (options.inner.factor, options.inner.note) == (1e-3, "007")


def test_names_of_a_component_in_a_yaml_file_stay_what_was_typed(echo: Said, tmp_path: Path) -> None:
    (tmp_path / "conf" / "data").mkdir()
    (tmp_path / "conf" / "data" / "mine.yaml").write_text("defaults: [video]\nroot: 2024_05_01\nval_clips: [0001]\n")
    data = _given(echo, "data=mine").data
    assert data is not None
    assert (data.get("root"), data.get("val_clips")) == ("2024_05_01", ["0001"])


def test_a_folder_or_video_given_as_data_is_read_as_video(echo: Said) -> None:
    Path("clips").mkdir()
    Path("drive.mp4").touch()
    for path in ("clips", "drive.mp4", "/nowhere/at/all", "./2024_05_01/a=b"):
        data = _given(echo, f"data={path}").data
        assert data is not None
        assert (data.name, data.get("root")) == ("video", path)
    Path("synthetic").mkdir()  # a data module's name is the data module
    data = _given(echo, "data=synthetic").data
    assert data is not None
    assert data.name == "synthetic"


def test_types_nesting_and_components(echo: Said) -> None:
    options = _given(echo, "numbers=3", "flag=true", "inner.factor=2", "data=synthetic_tiny", "data.workers=0")
    assert options.numbers == (3.0,)
    assert options.flag is True
    assert options.inner.factor == 2.0
    assert options.data is not None
    assert options.data.name == "synthetic_tiny"
    assert options.data.get("workers") == 0
    assert _given(echo, "input=null").input is None


def test_plain_words_are_the_input(echo: Said, tmp_path: Path) -> None:
    assert _given(echo, "road.png").input == "road.png"
    Path("a=b.png").touch()
    assert _given(echo, "a=b.png").input == "a=b.png"
    assert "given twice" in echo("road.png", "input=x")[2]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("coutn=3", ("unknown key 'coutn'", "did you mean 'count'?", "allowed:")),
        ("inner.facotr=3", ("inner.facotr", "did you mean 'factor'?")),
        ("+typo.key=3", ("unknown key 'typo'", "allowed:")),
        ("+dta.root=x", ("unknown key 'dta'", "did you mean 'data'?")),
        ("data=synthetic +data.wrokers=3", ("unknown key 'data.wrokers'", "did you mean 'data.workers'?")),
        ("data=synthetic data.wrokers=3", ("unknown key 'data.wrokers'", "did you mean 'workers'?")),
        ("data=sinthetic", ("unknown data 'sinthetic'", "did you mean 'synthetic'?")),
        ("count=many", ("count is 'many'; it must be int",)),
        ("count=1,2", ("count=1,2: a comma means a sweep", "needs --multirun (-m)\n")),
        ("data=synthetic,kitti", ("data=synthetic,kitti: a comma means a sweep", "needs --multirun (-m)\n")),
        ("count=-1", ("count is -1; it must be at least 0",)),
        ("--count 3", ("no option --count", "count=3")),
        ("--count=3", ("no option --count=3", "written without dashes: count=3")),
        ("a b", ("'b' is not KEY=VALUE",)),
        ("count=[", ("count=[", "quotes")),
        ("+count=4", ("leave out the plus sign: count=...",)),
        ("plugins=[nowhere]", ("no module 'nowhere'",)),
    ],
)
def test_a_mistake_is_one_sentence(echo: Said, words: str, expected: tuple[str, ...]) -> None:
    code, out, err = echo(*words.split(" "))
    assert code == 1
    assert out == ""
    assert err.startswith("saunet echo: ")
    assert err.count("\n") == 1
    for each in expected:
        assert each in err
    assert list(Path().iterdir()) == []


def test_what_may_be_a_list_or_text_says_how_they_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        app.main(["predict", "road.png", "camera=707,707,601,183"])
    said = capsys.readouterr().err
    for each in ("needs --multirun (-m)", "camera=[707,707,601,183]", "\"camera='707,707,601,183'\""):
        assert each in said


def test_a_model_behind_the_input_is_told_its_key() -> None:
    with pytest.raises(ConfigError, match=r"'runs/first' is not KEY=VALUE; .* write checkpoint=runs/first"):
        read_words(["road.png", "runs/first"], app.TOOLS["predict"], table.read())


def test_an_address_is_an_input_whatever_is_in_it(echo: Said) -> None:
    for address in ("rtsp://me:a,b@10.0.0.5:554/cam=1", "http://10.0.0.5/video?fps=25&size=1"):
        code, _, err = echo(address)
        assert code == 0, err
        assert ECHOED[-1].input == address


def test_a_sweep_keeps_text_and_writes_its_plan(echo: Said) -> None:
    code, out, err = echo("-m", "input=0001,2024_05_01", "names=a,b", "hydra.sweep.dir=sweep")
    assert code == 0, err
    assert [(each.input, each.names) for each in ECHOED] == [
        ("0001", ("a",)),
        ("0001", ("b",)),
        ("2024_05_01", ("a",)),
        ("2024_05_01", ("b",)),
    ]
    assert "4 jobs finished" in out
    assert "HYDRA" not in out + err
    assert "saunet echo: job 2: input='2024_05_01',names=[a]" in err
    assert "\"input='0001'\"" in Path("sweep/sweep.json").read_text()


def test_a_sweep_over_choices_knows_the_keys_that_they_bring(echo: Said) -> None:
    code, out, err = echo("-m", "data=kitti,kitti_odometry", "data.root=/data", "hydra.sweep.dir=sweep")
    assert code == 0, err
    assert [each.data and (each.data.name, each.data.get("root")) for each in ECHOED] == [
        ("kitti", "/data"),
        ("kitti_odometry", "/data"),
    ]
    assert "2 jobs finished" in out
    code, _, err = echo("-m", "data=kitti,kitti_odometry", "data.rot=/data", "hydra.sweep.dir=other")
    assert code == 1
    assert "unknown key 'data.rot'; did you mean 'root'" in err
    assert not Path("other").exists()


def test_a_failed_job_is_named_and_costs_no_other(echo: Said) -> None:
    code, _, err = echo("-m", "count=-1,2", "hydra.sweep.dir=sweep")
    assert code == 1
    assert [each.count for each in ECHOED] == [2]
    assert "job 0 (count=-1) failed: count is -1" in err


def test_nothing_is_written_by_the_command_line_itself(echo: Said) -> None:
    assert _given(echo).count == 3
    assert list(Path().iterdir()) == []


def test_help_says_what_each_key_is(echo: Said) -> None:
    _, out, _ = echo("--help")
    for each in ("input: str (not set)  A file.", "inner.factor: float = 1.0  How much.", "mode: a|b = a", "data=NAME"):
        assert each in out
    _, out, _ = echo("data=synthetic_tiny", "--help")
    assert "data.workers: int" in out


def test_help_of_a_training_lists_the_experiments_with_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    app.main(["train", "--help"])
    lines = capsys.readouterr().out.splitlines()
    for group in ("experiment", "loss", "sweep"):
        start = next(number for number, line in enumerate(lines) if line.startswith(f"{group}=NAME"))
        listed = dict(line.split(maxsplit=1) for line in lines[start + 1 : lines.index("", start)])
        folder = table.config_dir() / group
        assert set(listed) == {path.relative_to(folder).as_posix()[:-5] for path in folder.rglob("*.yaml")}
        assert all(told.endswith((".", "?")) for told in listed.values())
    app.main(["evaluate", "--help"])
    assert "experiment=" not in capsys.readouterr().out


def test_help_shows_the_values_that_a_command_has(capsys: pytest.CaptureFixture[str]) -> None:
    app.main(["train", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    for each in ("trainer.max_epochs: Optional[int] = 80", "trainer.log_every_n_steps: Optional[int] = 10"):
        assert each in said  # of our YAML files; Lightning's own are null
    assert re.search(r"trainer.gradient_clip_val: Union\[[a-zA-Z, ]+\] \(Lightning's default\)", said)
    assert "resume: str (not set)" in said
    assert "null" not in said
    app.main(["demo", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "trainer.max_steps: int = 100" in said
    assert "data.height: int = 128" in said
    assert "model=NAME (now street)" in said


def test_the_first_word_is_a_tool(capsys: pytest.CaptureFixture[str]) -> None:
    app.main(["--help"])
    out = capsys.readouterr().out
    assert all(name in out for name in app.TOOLS)
    with pytest.raises(SystemExit, match="did you mean 'train'"):
        app.main(["trian"])


def test_completion(echo: Said, capsys: pytest.CaptureFixture[str]) -> None:
    def completed(line: str) -> list[str]:
        app.main(["--complete", line])
        return capsys.readouterr().out.split()

    assert "echo" in completed("saunet ec")
    assert completed("saunet echo cou") == ["count="]
    assert completed("saunet echo mode=") == ["mode=a", "mode=b"]
    assert completed("saunet echo inner.fa") == ["inner.factor="]
    assert "data=synthetic_tiny" in completed("saunet echo data=syn")
    assert "data.workers=" in completed("saunet echo data=synthetic data.wo")
    Path("road.png").touch()
    assert completed("saunet echo input=ro") == ["input=road.png"]
    assert (
        "complete"
        in subprocess.run(
            [sys.executable, "-m", "saunet", "--completion", "bash"], capture_output=True, text=True, check=True
        ).stdout
    )


@pytest.mark.parametrize("words", [["--help"], ["components"], ["doctor", "--help"]])
def test_a_reader_that_has_seen_enough_ends_a_tool_quietly(words: list[str]) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "saunet", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stdout is not None
        run.stdout.close()  # as `| head -0`
        _, said = run.communicate()
    assert (run.returncode, said) == (141, "")


def test_a_key_of_the_data_is_suggested_by_its_short_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        app.main(["doctor", "workers=2"])
    assert "did you mean 'data.workers'?" in capsys.readouterr().err
    assert read_words(["batch=2"], table.TOOLS["doctor"], table.read())[1] == ["data.batch_size=2"]


def test_resume_is_listed_and_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    app.main(["--help"])
    assert "$ saunet resume outputs/" in capsys.readouterr().out
    app.main(["resume", "--help"])
    assert "usage: saunet resume RUN" in capsys.readouterr().out


@pytest.mark.parametrize("tool", ["train", "doctor", "evaluate", "report"])
def test_help_says_where_results_go(tool: str, capsys: pytest.CaptureFixture[str]) -> None:
    app.main([tool, "--help"])
    said = capsys.readouterr().out
    assert f" = outputs/{'NAME' if tool == 'train' else tool}/DATE_TIME" in said


def test_loader_processes_that_end_with_the_group_make_no_failure_of_a_stop(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def alarm(*_: object) -> None:  # as torch's loader has it
        raise RuntimeError("DataLoader worker is killed by signal: Terminated")

    def work(*_: object) -> int:
        signal.signal(signal.SIGCHLD, alarm)
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        finally:
            os.kill(os.getpid(), signal.SIGCHLD)
            time.sleep(0.1)
        return 0

    monkeypatch.setattr(app, "_run", work)
    before = [signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGCHLD)]
    try:
        with pytest.raises(SystemExit) as stop:
            app.run("train", [])
    finally:
        signal.signal(signal.SIGTERM, before[0])
        assert signal.signal(signal.SIGCHLD, before[1]) == alarm  # as it was
    assert stop.value.code == 128 + signal.SIGTERM
    assert "saunet train: stopped by SIGTERM" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_ends_any_tool_with_a_word(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    number, tidied = signal.Signals[name], list[bool]()

    def work(*_: object) -> int:
        try:
            os.kill(os.getpid(), number)
            time.sleep(10)
        finally:
            tidied.append(True)
        return 0

    monkeypatch.setattr(app, "_run", work)
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as stop:
            app.run("prepare", ["cache"])
    finally:
        assert signal.signal(number, before) == signal.SIG_DFL
    assert stop.value.code == 128 + number
    assert f"saunet prepare: stopped by {name}" in capsys.readouterr().err
    assert tidied


@pytest.mark.parametrize(("name", "word"), [("SIGINT", "interrupted"), ("SIGTERM", "stopped by SIGTERM")])
def test_a_signal_during_the_imports_ends_the_process_at_once(name: str, word: str, tmp_path: Path) -> None:
    """An exception there leaves half a torch, which prints figures of its cache at the exit."""
    (tmp_path / "slow.py").write_text(
        "import atexit, os, signal\n"
        "atexit.register(print, 'FakeTensor cache stats')\n"
        f"os.kill(os.getpid(), signal.{name})\n"
        "print('still here')\n"
    )
    code = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell job ignores it\n"
        "from saunet.cli import app\n"
        "app.run('doctor', ['plugins=[slow.py]'])"
    )
    result = python("-c", code, cwd=tmp_path)
    assert result.returncode == 128 + signal.Signals[name]
    assert result.stderr.strip() == f"saunet doctor: {word}"
    assert not result.stdout


def test_keys_of_sources_that_changed_since_their_import_are_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    table._read.cache_clear()
    monkeypatch.setattr(table, "_IMPORTED", 0)
    assert "predict" in table.read().tools
    assert not list(tmp_path.rglob("keys-*"))
    table._read.cache_clear()
    monkeypatch.setattr(table, "_IMPORTED", time.time_ns())
    table.read()
    assert list(tmp_path.rglob("keys-*.json"))
    table._read.cache_clear()
