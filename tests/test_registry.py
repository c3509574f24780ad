"""The registry: declared once, reachable by name, with errors that help."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

import saunet
from saunet.cli.compose import structured
from saunet.errors import ConfigError, checked
from saunet.registry import REGISTRIES, Registry, Spec, encoders, find, instantiate, terms


class Widget:
    """A thing with sizes.

    More text that is not the summary.
    """

    def __init__(self, dim: int = 96, depths: Sequence[int] = (2, 2), name: str = "w") -> None:
        self.dim, self.depths, self.name = dim, tuple(depths), name


@pytest.fixture
def widgets() -> Registry:
    registry = Registry("widget", "widget", "saunet.geometry")
    registry.register("wide", dim=128)(Widget)
    registry.register("plain")(Widget)
    return registry


def test_build_uses_preset_then_keywords(widgets: Registry) -> None:
    assert widgets.build("wide").dim == 128
    assert widgets.build("wide", dim=3).dim == 3
    assert widgets.build("plain").dim == 96


def test_partial_waits_for_the_rest(widgets: Registry) -> None:
    assert widgets.partial("wide", name="x")(depths=(1,)).depths == (1,)


def test_names_and_summary(widgets: Registry) -> None:
    assert widgets.names() == ["plain", "wide"]
    assert widgets.node("wide").summary == "A thing with sizes."


def test_registering_twice_is_an_error(widgets: Registry) -> None:
    with pytest.raises(ConfigError, match="widget 'wide' is already registered by"):
        widgets.register("wide")(Widget)


def test_unknown_preset_key_is_an_error(widgets: Registry) -> None:
    with pytest.raises(TypeError, match="preset key 'dimm' is not a parameter of Widget"):
        widgets.register("broken", dimm=3)(Widget)


def test_unknown_name_suggests_the_nearest(widgets: Registry) -> None:
    with pytest.raises(ConfigError, match=r"unknown widget 'wid'; did you mean 'wide'"):
        widgets.build("wid")
    with pytest.raises(ConfigError, match="unknown widget 'zzz'; available: plain, wide"):
        widgets.build("zzz")


def test_unknown_parameter_suggests_the_nearest(widgets: Registry) -> None:
    with pytest.raises(ConfigError, match="widget 'wide' has no parameter 'dephts'; did you mean 'depths'"):
        widgets.build("wide", dephts=(1,))


def test_what_a_component_needs_is_asked_for() -> None:
    with pytest.raises(ConfigError, match=r"decoder 'aunet' cannot be built without features=.*the encoder's features"):
        saunet.build("decoder", "aunet")
    with pytest.raises(ConfigError, match=r"attention 'eca' cannot be built without channels=\.\.\."):
        saunet.build("attention", "eca")


def test_unknown_kind() -> None:
    with pytest.raises(ConfigError, match="unknown kind 'encodr'; did you mean 'encoder'"):
        saunet.build("encodr", "resnet18")


@pytest.mark.parametrize("signature", ["args", "kwargs", "bare"])
def test_a_signature_without_names_and_types_is_refused(signature: str) -> None:
    registry = Registry("widget", None, "saunet.geometry")
    functions: dict[str, Any] = {
        "args": lambda *args: None,
        "kwargs": lambda **kwargs: None,
        "bare": lambda dim: None,
    }
    with pytest.raises(TypeError, match=r"each is a config key|has no annotation"):
        registry.register("x")(functions[signature])


def test_what_the_caller_always_gives_needs_no_annotation() -> None:
    registry = Registry("widget", None, "saunet.geometry", late=("clip",))
    registry.register("x")(lambda clip: ["of", clip])
    assert registry.build("x", clip=3) == ["of", 3]
    with pytest.raises(TypeError, match="'dim' has no annotation"):
        registry.register("y")(lambda clip, dim: None)


def test_instantiate_builds_nested_registered_components() -> None:
    node = OmegaConf.to_container(OmegaConf.structured(structured(encoders.node("resnet18"))))
    assert type(instantiate(node)) is encoders.entry("resnet18").target
    assert type(instantiate({"inner": [node]})["inner"][0]) is encoders.entry("resnet18").target


def test_instantiate_refuses_what_is_not_registered() -> None:
    with pytest.raises(ConfigError, match=r"'os\.system' is not a registered component"):
        instantiate({"_target_": "os.system", "command": "true"})


def test_instantiate_refuses_unknown_keys() -> None:
    node = OmegaConf.to_container(OmegaConf.structured(structured(encoders.node("resnet18"))))
    assert isinstance(node, dict)
    with pytest.raises(ConfigError, match="'ResNet' has no parameter 'depht'"):
        instantiate({**node, "depht": 3})


@pytest.mark.parametrize("kind", sorted(REGISTRIES))
def test_every_component_has_a_summary_and_a_pickling_class(kind: str) -> None:
    entries = list(REGISTRIES[kind])
    assert entries, f"no {kind} is registered"
    for entry in entries:
        assert REGISTRIES[kind].node(entry.name).summary.endswith("."), (
            f"{kind} {entry.name}: first docstring line must be a sentence"
        )
        assert pickle.loads(pickle.dumps(entry.target)) is entry.target


def test_a_whole_model_is_built_by_name() -> None:
    model = saunet.build("model", "sau_net_tiny").eval()
    assert "sau_net_tiny" in saunet.available("model")
    with torch.no_grad():
        depth = model(torch.rand(1, 3, 32, 64)).depth
    assert [tuple(each.shape[-2:]) for each in depth] == [(32, 64), (16, 32), (8, 16), (4, 8)]
    assert type(model.depth.encoder) is encoders.entry("stratified_tiny").target
    light = saunet.build("model", "sau_net_nano", encoder=Spec.of("encoder", "resnet18", frames=1), pose=None)
    assert type(light.depth.encoder) is encoders.entry("resnet18").target
    assert light.pose is None
    with pytest.raises(ConfigError, match="unknown model 'sau_nett'; did you mean 'sau_net'"):
        saunet.build("model", "sau_nett")


def test_a_spec_is_built_later_with_changes() -> None:
    spec = Spec.of("encoder", "resnet18", weights=None)
    assert spec.get("weights", "unset") is None
    assert "frames" in spec.parameters
    assert spec.changed(frames=2).build().features == spec.build().features
    with pytest.raises(ConfigError, match="did you mean 'weights'"):
        Spec.of("encoder", "resnet18", wieghts=None)


def test_a_component_that_moved_to_another_module_is_found() -> None:
    moved = find("saunet.losses.terms.of_another_day.Photometric")
    assert moved is not None
    assert moved.target is terms.entry("photometric").target
    assert find("saunet.losses.terms.of_another_day.Monet") is None
    assert find("elsewhere.Photometric") is None


def test_what_is_no_spec_is_told_how_one_is_written() -> None:
    @checked
    def take(data: Spec) -> Spec:
        return data

    with pytest.raises(ConfigError, match=r"data is 'video' \(str\); it must be Spec, such as saunet\.Spec\.of\("):
        take("video")  # type: ignore[arg-type]
