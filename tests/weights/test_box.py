"""Models that come with saunet: packed from a checkpoint, found by name, and the same model to every tool."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file

import saunet
from saunet.errors import CheckpointError, ConfigError, DataError
from saunet.exporting import box
from saunet.exporting.box import Rounding, pack
from saunet.runs.checkpoint import atomic_save, build_networks, read_checkpoint
from saunet.runs.record import ModelRecord, Scale
from saunet.weights import locate as locating
from saunet.weights.files import read_model
from saunet.weights.locate import BOX, locate, shipped

Node = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def checkpoint(node: Node, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny model whose depth varies over the image, as an untrained one's hardly does."""
    torch.manual_seed(0)
    encoder = {**node("encoder", "resnet18"), "blocks": [1, 1, 1, 1]}
    decoder = {**node("decoder", "unet"), "channels": [8] * 5}
    record = ModelRecord(
        encoder,
        decoder,
        node("pose", "posecnn"),
        0.5,
        80.0,
        64,
        96,
        scale=Scale(1.0, "rendered depth"),
        data={"name": "rendered", "root": "/secret/place"},
    )
    depth, pose = build_networks(record)
    assert pose is not None
    with torch.no_grad():
        depth.decoder.heads[0].conv.weight.mul_(20)
    path = tmp_path_factory.mktemp("run") / "best.ckpt"
    state = torch.nn.ModuleDict({"depth": depth, "pose": pose}).state_dict()
    atomic_save({"state_dict": state, "saunet": record.to_plain()}, path)
    return path


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    y, x = np.mgrid[0:50, 0:90]
    cv2.imwrite(str(tmp_path / "road.png"), np.stack([x * 2, y * 5, 255 - x], -1).astype(np.uint8))
    return tmp_path / "road.png"


@pytest.fixture
def street(checkpoint: Path, picture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rounding:
    """The tiny model as the shipped one."""
    monkeypatch.setattr(locating, "BOX", tmp_path / "box")
    return pack(checkpoint, tmp_path / "box" / "street", images=picture, command="saunet train experiment=street")


def depth_of(source: Any, image: Path) -> NDArray[np.float32]:
    return saunet.load(source).predict(image).depth  # type: ignore[no-any-return]


def test_rounding_is_what_the_reader_sees(street: Rounding, checkpoint: Path, picture: Path, tmp_path: Path) -> None:
    before, after = depth_of(checkpoint, picture), depth_of("street", picture)
    assert before.max() > 1.2 * before.min()
    change = np.abs(after - before) / before
    assert 0 < change.max() <= street.depth_max < 0.01
    assert change.mean() <= street.depth_mean < 1e-3
    assert street.images == 3
    assert street.motion is not None
    assert 0 < street.motion < 0.01
    folder = tmp_path / "box" / "street"
    sizes = [(folder / name).stat().st_size / 1e6 for name in ("model.safetensors", "pose.safetensors")]
    assert street.megabytes == pytest.approx(sizes, abs=0.005)
    assert sum(sizes) < 0.55 * checkpoint.stat().st_size / 1e6


def test_what_is_rounded(street: Rounding, checkpoint: Path, tmp_path: Path) -> None:
    original = read_checkpoint(checkpoint).state
    packed = {}
    for name, part in (("model.safetensors", "depth."), ("pose.safetensors", "pose.")):
        tensors = load_file(tmp_path / "box" / "street" / name)
        assert all(key.startswith(part) for key in tensors)
        packed |= tensors
    assert packed.keys() == original.keys()
    for key, value in packed.items():
        assert value.dtype == (torch.float16 if value.ndim > 1 else original[key].dtype)
        assert torch.equal(value, original[key].to(value.dtype))


def test_motion_change_by_hand() -> None:
    angle, moved = 0.1, torch.eye(4)
    moved[:2, :2] = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved[:3, 3] = torch.tensor([0.0, 0.3, 0.4])
    assert box._size(moved).item() == pytest.approx(0.5 + angle, abs=1e-6)
    assert box._size(torch.eye(4)).item() == 0


def test_the_same_model_by_name_everywhere(street: Rounding, picture: Path, tmp_path: Path) -> None:
    assert saunet.available("weights") == shipped() == ["street"]
    expected = saunet.load(tmp_path / "box" / "street").fingerprint
    assert saunet.load("street").fingerprint == saunet.load().fingerprint == expected
    depth, pose = read_model("street").networks()
    assert pose is not None
    assert all(value.dtype in (torch.float32, torch.int64) for value in depth.state_dict().values())
    prediction = saunet.load().predict(picture)
    assert prediction.depth.shape == (50, 90)
    assert "m" in prediction.unit


def test_record_and_card(street: Rounding, tmp_path: Path) -> None:
    folder = tmp_path / "box" / "street"
    config, card = (folder / "config.json").read_text(), (folder / "README.md").read_text()
    for text in (config, card):
        assert "rendered" in text
        assert "secret" not in text
    assert json.loads(config)["height"] == 64
    for words in ("# street", "saunet train experiment=street", str(street), 'saunet.load("street")', "Not evaluated"):
        assert words in card


def test_results_of_evaluations_are_on_the_card(checkpoint: Path, tmp_path: Path) -> None:
    for index in (1, 2):
        (tmp_path / f"{index}").mkdir()
        row = {"predictor": "model", "protocol": f"protocol{index}", "abs_rel": 0.1234 * index, "images": 7}
        (tmp_path / f"{index}" / "metrics.json").write_text(json.dumps({"results": [row]}))
    pack(checkpoint, tmp_path / "street", evaluations=[tmp_path / "1", tmp_path / "2"])
    card = (tmp_path / "street" / "README.md").read_text()
    assert "| model | protocol1 | 0.123 |" in card
    assert "| model | protocol2 | 0.247 |" in card
    with pytest.raises(DataError, match="evaluation"):
        pack(checkpoint, tmp_path / "other", evaluations=[tmp_path])
    assert not (tmp_path / "other").exists()


def test_a_local_thing_of_that_name_is_written_as_a_path(
    street: Rounding, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here" / "street").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    assert locate("street") == tmp_path / "box" / "street"
    assert locate("./street") == locate(Path("street")) == Path("street")


def test_without_a_shipped_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locating, "BOX", tmp_path)
    assert saunet.available("weights") == []
    for load in (saunet.load, lambda: read_model("street")):
        with pytest.raises(CheckpointError, match=r"no model 'street' comes with this installation .* checkpoint="):
            load()


def test_refused(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "street"
    pack(checkpoint, folder)
    before = (folder / "model.safetensors").read_bytes()
    with pytest.raises(ConfigError, match=r"already has config\.json"):
        pack(checkpoint, folder)
    with pytest.raises(ConfigError, match="contains the model itself"):
        pack(folder, folder, overwrite=True)
    pack(checkpoint, folder, overwrite=True)
    assert (folder / "model.safetensors").read_bytes() == before
    monkeypatch.setattr(box, "DEPTH_TOLERANCE", 1e-9)
    with pytest.raises(CheckpointError, match=r"half precision changes the depth of .* nothing is written"):
        pack(checkpoint, folder, overwrite=True)
    assert (folder / "model.safetensors").read_bytes() == before


def test_a_weight_beyond_half_precision_is_named(checkpoint: Path, tmp_path: Path) -> None:
    content = torch.load(checkpoint, weights_only=True)
    content["state_dict"]["pose.layers.0.weight"][0, 0, 0, 0] = 1e5
    atomic_save(content, tmp_path / "x.ckpt")
    with pytest.raises(CheckpointError, match=r"'pose\.layers\.0\.weight' reaches 1e\+05"):
        pack(tmp_path / "x.ckpt", tmp_path / "street")


def test_a_damaged_pose_file(street: Rounding, tmp_path: Path) -> None:
    path = tmp_path / "box" / "street" / "pose.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CheckpointError, match=r"pose\.safetensors is damaged or truncated"):
        saunet.load("street")
    path.unlink()
    with pytest.raises(CheckpointError, match="pose network does not fit"):
        saunet.load("street")


def test_script(checkpoint: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(checkpoint), str(tmp_path / "street"), "--images", str(picture), "--command", "make it"]
    box.main(arguments)
    assert "half precision changes depth by at most" in capsys.readouterr().out
    assert "make it" in (tmp_path / "street" / "README.md").read_text()
    with pytest.raises(SystemExit, match=r"^saunet\.exporting\.box: .* already"):
        box.main(arguments)


@pytest.mark.parametrize("name", shipped())
def test_shipped_models(name: str) -> None:
    """What really comes with this version: small, whole, described, and its origin credited."""
    folder, model = BOX / name, read_model(name)
    assert (folder / "model.safetensors").stat().st_size <= 10 * 2**20
    assert "## How it was made" in (folder / "README.md").read_text()
    height, width = model.record.height, model.record.width
    depth = saunet.load(name).predict(np.full((height, width, 3), 128, np.uint8)).depth
    assert depth.shape == (height, width)
    assert np.isfinite(depth).all()
    notice = Path(__file__).parents[2] / "NOTICE"
    if "EfficientNetLite" in json.dumps(model.record.to_plain()):
        assert "EfficientNet-Lite" in notice.read_text()
