"""Depth networks of other systems, read as ours: names and shapes in their files decide what to build; no code is run.

Supported are Monodepth2 and models stored like it (ManyDepth's single-frame networks, Lite-Mono), SC-Depth, slowtv's
benchmark and packnet-sfm. Each reader below states what to build and, for each of our names, where that file keeps it.
Depth equals that of their own code. A pose network is used if it predicts the same motion as ours.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from saunet.errors import CheckpointError, ConfigError
from saunet.io.plain import StandIn, read_torch
from saunet.registry import Spec
from saunet.runs.checkpoint import Checkpoint, build_networks
from saunet.runs.record import ModelRecord, Scale

log = logging.getLogger(__name__)

State = dict[str, Tensor]
_Rules = Sequence[tuple[str, str | Callable[[re.Match[str]], str]]]
"""Patterns in our names and what replaces them, one after the other: the result is the name in the file."""

FAR = 1e9
"""Depth at sigmoid 0 of systems in which that is infinite."""
_SIZE = (192, 640)
"""Height and width of networks whose files do not say it: the usual ones on KITTI."""
_STEREO = Scale(5.4, "stereo training: Monodepth2's baseline of 0.1 stands for KITTI's 0.54 m")
_TABLES = (".pth", ".pt", ".ckpt", ".tar", ".bin")
_OWN_BUSINESS = re.compile(r"(^|[.:])(fc\.(weight|bias)|num_batches_tracked|total_ops|total_params)$")
"""Entries that no depth network needs: classifiers, counters, and what profilers leave behind."""
_POSE_HEAD = {"squeeze": 0, "conv1": 1, "conv2": 2, "project": 3}


@dataclass(frozen=True)
class _Model:
    system: str
    encoder: Spec
    decoder: Spec
    names: _Rules
    pose: Spec | None = None
    min_depth: float = 0.1
    max_depth: float = 100.0
    size: tuple[int, int] | None = None
    scale: Scale | None = None
    left: tuple[str, ...] = ()
    """Parts that are not taken, in words."""
    unread: tuple[str, ...] = ()
    """Beginnings of the names of their entries."""


def read_foreign(path: Path) -> Checkpoint | None:
    """Read a file or folder of another system; None if it belongs to no known system.

    Raises:
        CheckpointError: if it belongs to a known system but is incomplete, damaged, or a network that saunet does not
            have.
    """
    if path.is_dir():
        found = _folder(path)
        return _checkpoint(path, *found) if found else None
    if path.suffix.lower() not in _TABLES:
        return None
    content = read_torch(path, "a checkpoint", stand_ins=True)
    if not isinstance(content, Mapping) or "saunet" in content:
        return None
    state = _tensors(content["state_dict"] if isinstance(content.get("state_dict"), Mapping) else content)
    if _has(state, "depth_net.decoder.upconvs0."):
        return _checkpoint(path, _sc_depth(state, content), state)
    if _has(state, "nets.depth."):
        return _checkpoint(path, _slowtv(path, state, content), state)
    if _has(state, "model.depth_net."):
        return _checkpoint(path, _packnet_sfm(path, state, content), state)
    if path.name in _HALVES or _has(state, "decoder.0.conv.conv.") or _has(state, "encoder.layer1."):
        raise CheckpointError(f"{path} is one part of a model in several files; give its folder, {path.parent}")
    if any(re.match(r"(layer1\.0|features\.\d|patch_embed|conv_stem|stem)\b", name) for name in state):
        raise CheckpointError(
            f"{path} has an image encoder but no depth network; start a training from it with "
            f"model.encoder.weights={path}"
        )
    return None


_HALVES = tuple(f"{part}.pth" for part in ("encoder", "depth", "pose_encoder", "pose", "mono_encoder", "mono_depth"))


def _folder(path: Path) -> tuple[_Model, State] | None:
    """Read Monodepth2's layout, a file each part; their names are put in front of those of the entries."""
    prefix = "mono_" if (path / "mono_encoder.pth").is_file() else ""
    files = [f"{prefix}encoder.pth", f"{prefix}depth.pth"]
    missing = [name for name in files if not (path / name).is_file()]
    if len(missing) == 2:
        return None
    if missing:
        other = next(name for name in files if name not in missing)
        raise CheckpointError(f"{path} has {other} but no {missing[0]}, which belongs to it; copy that too")
    facts, state = dict[str, Any](), State()
    sizes = ["encoder.pth"] if prefix and (path / "encoder.pth").is_file() else []
    for name in (*sizes, *files):
        content = read_torch(path / name, "a file of weights", stand_ins=True)
        content = content if isinstance(content, Mapping) else {}
        facts |= {key: value for key, value in content.items() if isinstance(value, int)}
        state |= {f"{name}:{key}": value for key, value in _tensors(content).items() if name in files}
    pose, names, left = _folder_pose(path, state)
    if prefix and sizes:
        left = (*left, "the network that sees several frames (encoder.pth, depth.pth)")
    encoder, decoder = f"{files[0]}:", f"{files[1]}:"
    if not _has(state, f"{decoder}decoder.0.conv.conv."):
        raise CheckpointError(f"{path / files[1]} is not a decoder that saunet has: {_kind(state, decoder)}")
    if _has(state, f"{encoder}encoder.layer1.0.conv1."):
        system = "ManyDepth (single frame)" if prefix else "Monodepth2"
        names = [(r"^depth\.encoder\.", f"{encoder}encoder."), *_decoder_names(f"{decoder}decoder.", 5), *names]
        spec, parts = _unet(state, f"{decoder}decoder.", 5), _resnet(state, f"{encoder}encoder.")
        model = _Model(system, Spec.of("encoder", "resnet18", **parts), spec, names, pose, left=left)
    elif _has(state, f"{encoder}downsample_layers.0.0.conv."):
        model = _lite_mono(state, encoder, decoder, facts, [*names], pose, left)
    else:
        raise CheckpointError(f"{path / files[0]} is not an encoder that saunet has: {_kind(state, encoder)}")
    height, width = facts.get("height"), facts.get("width")
    size = (height, width) if height and width else None
    scale = _STEREO if facts.get("use_stereo") else None
    return _Model(**{**vars(model), "size": size, "scale": scale}), state


def _folder_pose(path: Path, state: State) -> tuple[Spec | None, _Rules, tuple[str, ...]]:
    """Add a pose network's entries to ``state`` where it is one for pairs of frames, as ours are."""
    files = [name for name in ("pose_encoder.pth", "pose.pth") if (path / name).is_file()]
    if not files:
        return None, (), ()
    found: State = {}
    for name in files:
        entries = _tensors(read_torch(path / name, "a file of weights", stand_ins=True))
        found |= {f"{name}:{key}": value for key, value in entries.items()}
    first, joined = found.get("pose_encoder.pth:encoder.conv1.weight"), found.get("pose.pth:net.1.weight")
    if first is None or joined is None:
        why = "its two files are pose_encoder.pth and pose.pth with a ResNet for pairs of frames"
        if _has(found, "pose.pth:pose_conv."):
            why = "its PoseCNN expects unnormalized images, ours normalized ones"
    elif first.shape[1:2] != (6,) or joined.shape[1:2] != (256,):
        why = "it does not get pairs of frames in temporal order"
    else:
        state |= found
        parts = _resnet(found, "pose_encoder.pth:encoder.")
        names: _Rules = [(r"^pose\.encoder\.", "pose_encoder.pth:encoder."), _pose_head("pose.pth:net.{}.")]
        return Spec.of("pose", "resnet18", **parts), names, ()
    return None, (), (f"the pose network ({', '.join(files)}): {why}",)


def _lite_mono(
    state: State,
    encoder: str,
    decoder: str,
    facts: Mapping[str, int],
    names: list[Any],
    pose: Spec | None,
    left: tuple[str, ...],
) -> _Model:
    dims = [_outputs(state, f"{encoder}{name}0.conv.weight") for name in ("stem2.", *_DOWN)]
    depths = [_count(state, rf"{re.escape(encoder)}stages\.{stage}\.(\d+)\.") for stage in range(3)]
    # The dilation rates are not in the file; Lite-Mono's code takes them from the size of the training.
    wide = facts.get("width") == 1024 and dims[0] != 64
    rates: dict[str, Any] = {"rates": [1, 2, 5], "last_rates": [2, 4, 10]} if wide else {}
    spec = Spec.of("encoder", "lite_mono", dims=dims, depths=depths, **rates)

    def norm(found: re.Match[str]) -> str:
        dilated = int(found[2]) < depths[int(found[1])] - 1
        return f"stages.{found[1]}.{found[2]}.{'bn1' if dilated else 'norm'}."

    names += [
        (r"^depth\.encoder\.", encoder),
        (r":stem\.[036]\.", lambda found: f":downsample_layers.0.{int(found[0][6]) // 3}.conv."),
        (r":stem\.[147]\.", lambda found: f":downsample_layers.0.{int(found[0][6]) // 3}.bn_gelu.bn."),
        (r":reductions\.0\.", ":stem2.0.conv."),
        (r":reductions\.([12])\.", r":downsample_layers.\1.0.conv."),
        (r"stages\.(\d+)\.(\d+)\.norm\.", norm),
        (r"\.depthwise\.", ".ddwconv.conv."),
        (r"\.expand\.", ".pwconv1."),
        (r"\.reduce\.", ".pwconv2."),
        (r"\.scale$", ".gamma"),
        (r"\.position\.project\.", ".pos_embd.token_projection."),
        (r"\.norm_attention\.", ".norm_xca."),
        (r"\.scale_attention$", ".gamma_xca"),
        (r"\.attention\.", ".xca."),
        *_decoder_names(f"{decoder}decoder.", 3),
    ]
    heads = range(max(1, _count(state, rf"{re.escape(decoder)}decoder\.(\d+)\.") - 6))
    unused = tuple(  # a normalization that Lite-Mono declares in each dilated block and never uses
        f"{encoder}stages.{stage}.{block}.norm." for stage in range(3) for block in range(depths[stage] - 1)
    )
    decoders = Spec.of("decoder", "lite_mono", scales=list(heads))
    return _Model("Lite-Mono", spec, decoders, names, pose, left=left, unread=unused)


_DOWN = ("downsample_layers.1.", "downsample_layers.2.")


def _sc_depth(state: State, content: Mapping[str, Any]) -> _Model:
    names: _Rules = [
        (r"^depth\.encoder\.", "depth_net.encoder.encoder."),
        (r"^depth\.decoder\.before\.(\d+)\.0\.", r"depth_net.decoder.upconvs0.\1.conv.conv."),
        (r"^depth\.decoder\.after\.(\d+)\.0\.", r"depth_net.decoder.upconvs1.\1.conv.conv."),
        (r"^depth\.decoder\.heads\.(\d+)\.conv\.", r"depth_net.decoder.dispconvs.\1.conv."),
    ]
    channels = [_outputs(state, f"depth_net.decoder.upconvs0.{4 - level}.conv.conv.weight") for level in range(5)]
    scales = list(range(max(1, _count(state, r"depth_net\.decoder\.dispconvs\.(\d+)\."))))
    sizes = {"kitti": (256, 832), "ddad": (384, 640), "nyu": (256, 320), "tum": (256, 320), "bonn": (256, 320)}
    others = sorted({name.partition(".")[0] for name in state if not name.startswith("depth_net.")})
    return _Model(
        "SC-Depth",
        Spec.of("encoder", "resnet18", **_resnet(state, "depth_net.encoder.encoder.")),
        Spec.of("decoder", "unet", channels=channels, scales=scales, upsampling="bilinear"),
        names,
        min_depth=1 / 10.01,  # disparity is 10 sigmoid + 0.01
        size=sizes.get(str(_setting(content, "hyper_parameters", "hparams", "dataset_name"))),
        left=(f"{', '.join(others)} (their motions are Euler angles, ours axis-angle)",) if others else (),
        unread=tuple(f"{name}." for name in others),
    )


def _slowtv(path: Path, state: State, content: Mapping[str, Any]) -> _Model:
    config = _setting(content, "hyper_parameters", "cfg")
    depth = "nets.depth.decoders.disp.decoder."
    if not _has(state, f"{depth}0.conv."):
        kind = _setting(config, "net", "depth", "dec_name") or "unknown"
        raise CheckpointError(f"{path} has slowtv's decoder '{kind}', which saunet does not have; it has 'monodepth'")
    names: list[Any] = [
        (r"^depth\.decoder\.before\.(\d+)\.0\.", lambda found: f"{depth}{2 * int(found[1])}.conv."),
        (r"^depth\.decoder\.after\.(\d+)\.0\.", lambda found: f"{depth}{2 * int(found[1]) + 1}.conv."),
        (r"^depth\.decoder\.heads\.(\d+)\.conv\.", lambda found: f"{depth}{10 + int(found[1])}."),
    ]
    if _is_resnet(state, "nets.depth.encoder."):
        parts = _resnet(state, "nets.depth.encoder.")
        encoder = Spec.of("encoder", "resnet18", **parts, normalization="imagenet")
        names.append((r"^depth\.encoder\.", "nets.depth.encoder."))
    else:
        kind = _setting(config, "net", "depth", "enc_name")
        if not isinstance(kind, str):
            raise CheckpointError(f"{path} does not name the timm network of its encoder (net.depth.enc_name)")
        encoder = Spec.of("encoder", "timm", model=kind)
        names.append((r"^depth\.encoder\.network\.", "nets.depth.encoder."))
    pose, left = None, []
    forward = _setting(config, "trainer", "always_fwd_pose") is not False
    if forward and _is_resnet(state, "nets.pose.encoder.") and f"{_SLOWTV_POSE}2.weight" in state:
        pose = Spec.of("pose", "resnet18", **_resnet(state, "nets.pose.encoder."), normalization="imagenet")
        names.append((r"^pose\.encoder\.", "nets.pose.encoder."))
        ends = {"conv1": "0.0", "conv2": "1.0", "project": "2"}
        names.append((r"^pose\.head\.squeeze\.", "nets.pose.squeeze.0."))
        names.append((r"^pose\.head\.(\w+)\.", lambda found: f"{_SLOWTV_POSE}{ends[found[1]]}."))
    kept = ["nets.depth.encoder.", depth, *(("nets.pose.encoder.", "nets.pose.squeeze.", _SLOWTV_POSE) if pose else ())]
    unread = sorted({_front(name) for name in state if not name.startswith(tuple(kept))})
    if unread:
        left.append(", ".join(unread))
    if _outputs(state, f"{depth}10.weight") > 1:
        left.append("disparity of two virtual stereo views")
    if _setting(config, "net", "depth", "use_stereo_blend"):
        left.append("the blend with the mirrored image, which flip=true does")
    near, far = (_setting(config, "trainer", key) for key in ("min_depth", "max_depth"))
    limits = (1.0, FAR)  # disparity is the sigmoid itself
    if isinstance(near, int | float):
        limits = float(near), float(far) if isinstance(far, int | float) else FAR
    return _Model(
        "slowtv",
        encoder,
        _unet(state, depth, 5, conv=".conv.weight"),
        names,
        pose,
        *limits,
        size=_shape(_setting(config, "dataset")),
        left=tuple(left),
        unread=tuple(unread),
    )


_SLOWTV_POSE = "nets.pose.decoders.pose."


def _packnet_sfm(path: Path, state: State, content: Mapping[str, Any]) -> _Model:
    front = "model.depth_net."
    others = sorted({_front(name, 2) for name in state if not name.startswith(front)})
    left = (f"{', '.join(others)} (its motions are Euler angles, ours axis-angle)",) if others else ()
    size = _size(_setting(content, "config", "datasets", "augmentation", "image_shape"))
    more: dict[str, Any] = {"size": size, "left": left, "unread": tuple(f"{each}." for each in others)}
    if _has(state, f"{front}encoder.encoder.layer1.") and _has(state, f"{front}decoder.decoder.0.conv.conv."):
        names = [(r"^depth\.encoder\.", f"{front}encoder.encoder."), *_decoder_names(f"{front}decoder.decoder.", 5)]
        encoder = Spec.of("encoder", "resnet18", **_resnet(state, f"{front}encoder.encoder."))
        return _Model("packnet-sfm (DepthResNet)", encoder, _unet(state, f"{front}decoder.decoder.", 5), names, **more)
    if not _has(state, f"{front}pack1.conv3d."):
        raise CheckpointError(
            f"{path} is packnet-sfm's network with '{next(name for name in state if name.startswith(front))}', which "
            "saunet does not have; it has PackNet01 and DepthResNet"
        )
    channels = [_outputs(state, f"{front}conv{stage}.conv_base.weight") for stage in (1,)]
    channels += [_outputs(state, f"{front}conv{stage}.0.conv1.conv_base.weight") for stage in range(2, 6)]
    blocks = [_count(state, rf"{re.escape(front)}conv{stage}\.(\d+)\.") for stage in range(2, 6)]
    widths = [_outputs(state, f"{front}iconv{stage}.conv_base.weight") for stage in range(1, 6)]
    joined = state.get(f"{front}iconv5.conv_base.weight")
    if joined is not None and joined.shape[1:2] != (widths[4] + channels[3],):
        raise CheckpointError(
            f"{path} is PackNet01 version B, which adds skips; saunet's concatenates them as in version A"
        )
    dropped = _has(state, f"{front}conv2.0.conv3.0.")  # a dropout stands behind the shortcut
    names = [
        (r"^depth\.decoder\.heads\.(\d+)\.conv\.", lambda found: f"{front}disp{int(found[1]) + 1}_layer.conv1."),
        (r"\.conv\.(?=weight|bias)", ".conv_base."),
        (r"\.norm\.", ".normalize."),
        (r"\.shortcut\.", ".conv3.0." if dropped else ".conv3."),
        (r"\.reduce\.", ".conv."),
        (r"\.expand\.", ".conv3d."),
        (r"^depth\.encoder\.stem\.", f"{front}pre_calc."),
        (r"^depth\.encoder\.stages\.(\d+)\.", lambda found: f"{front}conv{int(found[1]) + 1}."),
        (r"^depth\.encoder\.packings\.(\d+)\.", lambda found: f"{front}pack{int(found[1]) + 1}."),
        (r"^depth\.decoder\.unpackings\.(\d+)\.", lambda found: f"{front}unpack{5 - int(found[1])}."),
        (r"^depth\.decoder\.joins\.(\d+)\.", lambda found: f"{front}iconv{5 - int(found[1])}."),
    ]
    encoder = Spec.of("encoder", "packnet", channels=channels, blocks=blocks)
    decoder = Spec.of("decoder", "packnet", channels=widths)
    # inverse depth is sigmoid / 0.5
    return _Model("PackNet", encoder, decoder, names, min_depth=0.5, max_depth=FAR, **more)


def _checkpoint(path: Path, model: _Model, state: State) -> Checkpoint:
    """Fetch every entry of our networks from the file, and account for what is left over."""
    height, width = model.size or _SIZE
    pose = model.pose.changed(offsets=[-1, 1]) if model.pose else None
    try:
        record = ModelRecord.from_plain(  # with its bounds: a file cannot ask for more than a record may
            ModelRecord(
                encoder=model.encoder.node,
                decoder=model.decoder.node,
                pose=pose.node if pose else None,
                min_depth=model.min_depth,
                max_depth=model.max_depth,
                height=height,
                width=width,
                scale=model.scale,
                data={"name": model.system},
            ).to_plain()
        )
        with torch.device("meta"):
            networks = build_networks(record)
    except (CheckpointError, ConfigError) as reason:
        raise CheckpointError(f"{path} looks like a model of {model.system}, but {reason}") from reason
    own = {
        f"{part}.{name}": value
        for part, network in zip(("depth", "pose"), networks, strict=True)
        for name, value in (network.state_dict() if network is not None else {}).items()
    }
    theirs = {name: _renamed(name, model.names) for name in own}
    found = {name: _first(name, state[theirs[name]], value) for name, value in own.items() if theirs[name] in state}
    for name, value in own.items():
        if name.endswith("num_batches_tracked") and name not in found:
            found[name] = torch.zeros_like(value, device="cpu")
    _check_complete(path, model, own, theirs, found, state)
    log.info("%s: read as a model of %s", path, model.system)
    left = [*model.left, *(() if model.size else (f"its input size, so {width}x{height} is assumed",))]
    if left:
        log.warning("%s: not taken from this model of %s: %s", path, model.system, "; ".join(left))
    return Checkpoint(path, record, found, None, None)


def _check_complete(
    path: Path,
    model: _Model,
    own: Mapping[str, Tensor],
    theirs: Mapping[str, str],
    found: Mapping[str, Tensor],
    state: State,
) -> None:
    missing = [theirs[name] for name in own if name not in found]
    shapes = [name for name in found if found[name].shape != own[name].shape]
    expected = {*theirs.values(), *(name for name in state if name.startswith(model.unread))}
    extra = [name for name in state if name not in expected and not _OWN_BUSINESS.search(name)]
    wrong = []
    if missing:
        wrong.append(f"it lacks '{missing[0]}'{_more(missing)}")
    if shapes:
        got, wanted = (tuple(tensors[shapes[0]].shape) for tensors in (found, own))
        wrong.append(f"'{theirs[shapes[0]]}' is {got} where {wanted} is needed{_more(shapes)}")
    if extra:
        wrong.append(f"'{extra[0]}'{_more(extra)} belongs to no part of it")
    if wrong:
        raise CheckpointError(
            f"{path} looks like a model of {model.system} but is incomplete: {'; '.join(wrong)}; copy it again"
        )


def _decoder_names(front: str, levels: int) -> _Rules:
    """Monodepth2's numbering: two convolutions a level, coarse to fine, and then the heads."""
    return [
        (r"^depth\.decoder\.before\.(\d+)\.0\.", lambda found: f"{front}{2 * int(found[1])}.conv.conv."),
        (r"^depth\.decoder\.after\.(\d+)\.0\.", lambda found: f"{front}{2 * int(found[1]) + 1}.conv.conv."),
        (r"^depth\.decoder\.heads\.(\d+)\.conv\.", lambda found: f"{front}{2 * levels + int(found[1])}.conv."),
    ]


def _pose_head(place: str) -> tuple[str, Callable[[re.Match[str]], str]]:
    return r"^pose\.head\.(\w+)\.", lambda found: place.format(_POSE_HEAD[found[1]])


def _unet(state: State, front: str, levels: int, conv: str = ".conv.conv.weight") -> Spec:
    channels = [_outputs(state, f"{front}{2 * (levels - 1 - level)}{conv}") for level in range(levels)]
    heads = _count(state, rf"{re.escape(front)}(\d+)\.") - 2 * levels
    return Spec.of("decoder", "unet", channels=channels, scales=list(range(max(1, heads))))


def _resnet(state: State, front: str) -> dict[str, Any]:
    blocks = [_count(state, rf"{re.escape(front)}layer{stage}\.(\d+)\.") for stage in range(1, 5)]
    return {"blocks": [max(1, count) for count in blocks], "bottleneck": f"{front}layer1.0.conv3.weight" in state}


def _is_resnet(state: State, front: str) -> bool:
    return f"{front}conv1.weight" in state and _has(state, f"{front}layer1.0.conv1.")


def _kind(state: State, front: str) -> str:
    """Say what an unknown part is."""
    names = [name.removeprefix(front) for name in state if name.startswith(front)]
    known = {
        r"(reduce_conv|layer0)\.": "ManyDepth's network for several frames; the single-frame one is mono_encoder.pth",
        r"(mhca_stages|patch_embed_stages)\.": "MPViT of MonoViT",
        r"convs\.(X_|f[1-4])": "the nested decoder of MonoViT and HR-Depth",
        r"encoder\.stage\d\.": "HRNet of DIFFNet",
    }
    for pattern, kind in known.items():
        if any(re.match(pattern, name) for name in names):
            return f"it is {kind}"
    return f"its first entry is '{names[0]}'" if names else "it has no weights"


def _tensors(content: object) -> State:
    entries = content.items() if isinstance(content, Mapping) else ()
    return {key.removeprefix("module."): value for key, value in entries if isinstance(value, Tensor)}


def _has(state: Collection[str], front: str) -> bool:
    return any(name.startswith(front) for name in state)


def _count(state: Collection[str], pattern: str) -> int:
    return len({found[1] for name in state if (found := re.match(pattern, name))})


def _outputs(state: State, name: str) -> int:
    """Return a convolution's number of outputs; 1 where it is missing, which is then said of the whole file."""
    return state[name].shape[0] if name in state and state[name].ndim > 1 else 1


def _first(name: str, value: Tensor, own: Tensor) -> Tensor:
    """Take the first outputs of a last layer that has more: Monodepth2 predicts a second motion and never uses it."""
    last = re.match(r"(pose\.head\.project|depth\.decoder\.heads\.\d+\.conv)\.", name)
    more = last and value.ndim == own.ndim and value.shape[1:] == own.shape[1:] and len(value) > len(own)
    return value[: len(own)].clone() if more else value


def _renamed(name: str, rules: _Rules) -> str:
    for pattern, replacement in rules:
        name = re.sub(pattern, replacement, name)
    return name


def _setting(content: object, *keys: str) -> Any:
    """Return a setting of another system's, through mappings and objects that are read as data; None without."""
    for key in keys:
        content = content.state if isinstance(content, StandIn) else content
        content = content.get(key) if isinstance(content, Mapping) else None
    return content


def _shape(datasets: object) -> tuple[int, int] | None:
    """Return the size of slowtv's validation images, of its first data set."""
    each = next(iter(datasets.values()), None) if isinstance(datasets, Mapping) else None
    return _size(_setting(each, "val", "shape") or _setting(each, "shape"))


def _size(value: object) -> tuple[int, int] | None:
    whole = isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(side, int) for side in value)
    return (value[0], value[1]) if whole else None  # type: ignore[index]


def _front(name: str, parts: int = 3) -> str:
    words = name.split(".")
    return ".".join(words[: 4 if words[2:3] == ["decoders"] else parts])


def _more(names: Sequence[str]) -> str:
    return f" (and {len(names) - 1} more)" if len(names) > 1 else ""
