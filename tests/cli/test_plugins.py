"""Components of the user's own: a file beside the work trains, evaluates and is asked for by name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from processes import python

from saunet import plugins
from saunet.errors import ConfigError
from saunet.registry import Registry

MINE = '''
"""An encoder of my own."""

from torch import Tensor, nn

from saunet.registry import encoders
from saunet.types import FeatureSpec


@encoders.register("mine")
class Mine(nn.Module):
    """Four strided convolutions.

    Args:
        width: Channels.
    """

    def __init__(self, width: int = 8) -> None:
        super().__init__()
        self.features = tuple(FeatureSpec(width, 2**level) for level in (1, 2, 3, 4))
        self.size_divisor = 16
        self.stages = nn.ModuleList(nn.Conv2d(3 if level == 0 else width, width, 3, 2, 1) for level in range(4))

    def forward(self, image: Tensor) -> list[Tensor]:
        """Return features at 1/2 to 1/16."""
        features = []
        for stage in self.stages:
            image = stage(image).relu()
            features.append(image)
        return features
'''
OUTPUT = '''
"""An output of my own."""

from pathlib import Path

from saunet.prediction.sinks import ClipInfo, Sink
from saunet.registry import outputs


@outputs.register("lines")
class Lines(Sink):
    """A line per frame."""

    def __init__(self, clip: ClipInfo) -> None:
        self.paths, self.lines = (Path(f"{clip.stem}lines.txt"),), []

    def session(self):
        yield
        self.paths[0].write_text("".join(self.lines))

    def add(self, frame, result, limits) -> None:
        self.lines.append(f"{frame.stem} {result.depth.shape}\\n")


@outputs.register("no_sink")
def no_sink(clip: ClipInfo) -> ClipInfo:
    """Nothing that takes predictions."""
    return clip
'''
QUICK = ("experiment=smoke", "model/encoder=mine", "model.encoder.width=4", "model/decoder=unet", "model/pose=posecnn")


def _saunet(*words: str, folder: Path, code: int = 0) -> str:
    done = python("-m", "saunet", *words, cwd=folder)
    assert done.returncode == code, done.stderr[-3000:]
    return done.stdout + done.stderr


def test_an_encoder_in_a_file_trains_evaluates_and_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "my_parts.py").write_text(MINE)
    _saunet("train", "plugins=[my_parts]", *QUICK, "hydra.run.dir=run", folder=tmp_path)
    evaluate = ("evaluate", "run", "data=synthetic_tiny", "data.workers=0", "baselines=false")
    said = _saunet(*evaluate, folder=tmp_path, code=1)
    assert "plugins=[my_parts]" in said
    assert "plugins=[path/to/my_parts.py]" in said
    assert "model" in _saunet(*evaluate, "plugins=my_parts.py", folder=tmp_path)


def test_only_a_module_that_can_be_a_file_is_offered_as_one() -> None:
    said = plugins.asked_for("a.Encoder", ["my_parts", "package.parts"])
    assert "plugins=[my_parts,package.parts]" in said
    assert "plugins=[path/to/my_parts.py,package.parts]" in said
    assert "path/to" not in plugins.asked_for("package.parts.Encoder")
    assert "plugins=[package.parts]" in plugins.asked_for("package.parts.Encoder")


def test_an_output_in_a_file_is_written_by_predict(tmp_path: Path) -> None:
    (tmp_path / "my_outputs.py").write_text(OUTPUT)
    cv2.imwrite(str(tmp_path / "road.png"), np.full((48, 96, 3), 99, np.uint8))
    predict = ("predict", "road.png", "output=out", "plugins=[my_outputs]", "runtime=torch")
    said = _saunet(*predict, "outputs=[lines,npy]", folder=tmp_path)
    assert "out/road_lines.txt" in said
    assert (tmp_path / "out" / "road_lines.txt").read_text() == "road (48, 96)\n"
    assert (tmp_path / "out" / "road_depth.npy").is_file()
    assert "did you mean 'lines'" in _saunet(*predict, "outputs=[line]", folder=tmp_path, code=1)
    assert "the output 'no_sink' is a ClipInfo" in _saunet(*predict, "outputs=[no_sink]", folder=tmp_path, code=1)


def test_help_and_unknown_names_know_it(tmp_path: Path) -> None:
    (tmp_path / "my_parts.py").write_text(MINE)
    said = _saunet("train", "plugins=[my_parts]", *QUICK, "--help", folder=tmp_path)
    assert "model.encoder.width: int = 4  Channels." in said
    assert "unknown model/encoder 'mine'" in _saunet("train", *QUICK, folder=tmp_path, code=1)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("1 / 0\n", "cannot be imported: ZeroDivisionError"),
        (None, "no file at"),
    ],
)
def test_a_plugin_that_fails_is_one_sentence(tmp_path: Path, content: str | None, words: str) -> None:
    file = tmp_path / "broken_plugin.py"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ConfigError, match=words):
        plugins.load([str(file)])


def test_a_file_named_like_another_module_is_refused(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("")
    with pytest.raises(ConfigError, match=r"the name of .*json\.py is taken by"):
        plugins.load([str(tmp_path / "json.py")])


def of_mine() -> None:
    """A component."""


@pytest.mark.parametrize("mine_first", [True, False])
def test_a_taken_name_asks_to_rename_the_users_class(mine_first: bool) -> None:
    registry = Registry("widget", None, "saunet.geometry")
    first, second = (of_mine, plugins.loaded) if mine_first else (plugins.loaded, of_mine)
    registry.register("x")(first)
    message = r"'x' is already registered by saunet\.plugins\.loaded; give \S*of_mine another name"
    with pytest.raises(ConfigError, match=message):
        registry.register("x")(second)


def test_a_plugin_that_takes_a_name_of_saunet_is_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "my_parts.py").write_text(MINE.replace('"mine"', '"resnet18"'))
    said = _saunet("train", "plugins=[my_parts]", "--help", folder=tmp_path, code=1)
    assert "give my_parts.Mine another name" in said


def test_components_lists_it(tmp_path: Path) -> None:
    (tmp_path / "my_parts.py").write_text(MINE)
    said = _saunet("components", "encoder", "mine", "plugins=[my_parts.py]", folder=tmp_path)
    assert "choose: model/encoder=mine" in said
    assert "width: int = 8  Channels." in said
    assert "plugins: list[str] = []" in _saunet("train", "--help", folder=tmp_path)
