"""``saunet components``: what there is, its options, and its size."""

from __future__ import annotations

import pytest

import saunet
from saunet.cli import app


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr("sys.argv", ["saunet"])
    app.main(["components", *arguments])


def test_every_component_is_listed_with_its_options(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch)
    text = capsys.readouterr().out
    for kind in ("encoder", "decoder", "attention", "pose", "objective", "data"):
        assert f"\n{kind} (" in f"\n{text}"
        assert all(f"\n  {name}\n" in text for name in saunet.available(kind))
    assert "choose: model/encoder=resnet18" in text
    assert "mlp_ratio: float = 3.0" in text  # a preset's own value


def test_sizes_are_counted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, "attention", "--count")
    title, *lines = capsys.readouterr().out.splitlines()
    assert title == "attention (5 registered, for 64 channels)"
    counts = dict(line.split() for line in lines if line)
    assert counts == {"cbam": "610", "eca": "3", "gct": "192", "none": "0", "se": "512"}
    run(monkeypatch, "decoder", "aunet", "--count")
    assert "0.30 M" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("encodr",), "did you mean 'encoder'"),
        (("encoder", "resnet19"), "did you mean 'resnet18'"),
        (("objective", "--count"), "--count is for networks"),
    ],
)
def test_mistakes_are_one_sentence(
    arguments: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run(monkeypatch, *arguments)
    said = capsys.readouterr().err
    assert said.startswith("saunet components: ")
    assert message in said
