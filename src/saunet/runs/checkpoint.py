"""A trained model on disk: ``state_dict`` (keys ``depth.*`` and ``pose.*``) and ``saunet``, the plain `ModelRecord`.

It is read with ``weights_only=True``, and only registered components are ever built from it: reading runs nothing.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules import module as hooks
from torch.utils._python_dispatch import TorchDispatchMode

from saunet.errors import CheckpointError, ConfigError
from saunet.io.atomic import replacing
from saunet.io.plain import read_torch
from saunet.models.depth import DepthNet
from saunet.registry import instantiate
from saunet.runs.record import LIMIT_FACTOR, ModelRecord, Scale, limit_factor


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A checkpoint's content as read from disk, nothing built yet."""

    path: Path
    record: ModelRecord
    state: Mapping[str, Tensor]
    """All weights, with their prefixes."""
    epoch: int | None
    global_step: int | None
    rest: Mapping[str, Any] = field(default_factory=dict)
    """All else that the file holds: what a training needs to be resumed."""

    def weights(self, part: str) -> dict[str, Tensor]:
        """Return the weights of ``"depth"`` or ``"pose"`` without prefix, and without what ``torch.compile`` adds."""
        named = {key.replace("_orig_mod.", ""): value for key, value in self.state.items()}
        return {key[len(part) + 1 :]: value for key, value in named.items() if key.startswith(f"{part}.")}

    def networks(self) -> tuple[DepthNet, nn.Module | None]:
        """Build the recorded networks, depth and pose, and give them the file's weights.

        A file gets networks as large as the weights that it holds: a small one cannot ask for gigabytes.
        """
        held = sum(
            min(each.numel(), each.untyped_storage().nbytes() // each.element_size()) for each in self.state.values()
        )
        try:
            with _at_most(int((4 * held + _ROOM) * limit_factor())):
                depth, pose = build_networks(self.record)
            load_weights(depth, self.weights("depth"), "depth network")
            if pose is not None:
                load_weights(pose, self.weights("pose"), "pose network")
        except (CheckpointError, ConfigError) as error:
            raise CheckpointError(f"{self.path}: {error}") from error
        return depth, pose


_ROOM = 1 << 24
"""Numbers that a network may hold beyond those of its file: buffers that are not stored, and weights that are missing,
which `load_weights` names."""
_MODULE = 1000
"""Numbers that take as much memory as one module without any: a list of a hundred thousand layers is large too."""


class _Counted(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Refuses to make tensors of more numbers together than it was given, before memory is asked for."""

    def __init__(self, numbers: int) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.numbers = self.left = numbers

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Do without the guard against being compiled: it imports the whole compiler, seconds for each prediction."""
        return False

    def count(self, numbers: int) -> None:
        self.left -= numbers
        if self.left < 0:
            raise CheckpointError(
                f"the record asks for a network of more than {self.numbers:,} numbers, several times what the file "
                f"holds; it is damaged or was edited, or allow more with {LIMIT_FACTOR}"
            )

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if args and isinstance(args[0], list | tuple) and all(isinstance(side, int) for side in args[0]):
            self.count(math.prod(args[0]))  # a function whose first argument is a size creates a tensor
        return func(*args, **(kwargs or {}))


@contextlib.contextmanager
def _at_most(numbers: int) -> Iterator[None]:
    """Refuse a network that is being built as soon as it has more numbers and modules, before they fill memory."""
    counted = _Counted(numbers)
    handle = hooks.register_module_module_registration_hook(lambda *_: counted.count(_MODULE))
    try:
        with counted:
            yield
    finally:
        handle.remove()


def build_networks(record: ModelRecord, pretrained: bool = False) -> tuple[DepthNet, nn.Module | None]:
    """Build the networks that a record describes; the global random state is left as it was.

    With ``pretrained`` they start from the public weights that the record names, which may have to be fetched.
    Otherwise no file makes us fetch another: enough where a checkpoint's weights are loaded next.

    Raises:
        CheckpointError: if a component is not registered, or public weights are not available.
        ConfigError: if a component refuses its recorded parameters.
    """
    record.check_registered()

    def started(node: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in node.items() if pretrained or key != "weights"}

    with torch.random.fork_rng(devices=[]):
        try:
            encoder, decoder = instantiate(started(record.encoder)), instantiate({**record.decoder, "_partial_": True})
            depth = DepthNet(encoder, decoder, record.min_depth, record.max_depth)
            pose = instantiate(started(record.pose)) if record.pose is not None else None
        except (CheckpointError, ConfigError):
            raise
        except (TypeError, ValueError, RuntimeError) as reason:
            raise ConfigError(f"the architecture cannot be built from its record: {reason}") from reason
    return depth, pose


def load_weights(module: nn.Module, state: Mapping[str, Tensor], what: str) -> None:
    """Give ``module`` all weights of ``state``, or change nothing and name the first of each that differs."""
    expected = module.state_dict()
    differences = []
    missing, extra = sorted(expected.keys() - state.keys()), sorted(state.keys() - expected.keys())
    if missing:
        differences.append(f"it lacks '{missing[0]}'{_more(missing)}")
    if extra:
        differences.append(f"it has '{extra[0]}'{_more(extra)}, which the model does not have")
    shapes = [key for key in expected if key in state and expected[key].shape != state[key].shape]
    if shapes:
        got, wanted = (tuple(tensors[shapes[0]].shape) for tensors in (state, expected))
        differences.append(f"'{shapes[0]}' is {got} but the model has {wanted}{_more(shapes)}")
    if differences:
        raise CheckpointError(f"checkpoint of another model, the {what} does not fit: {'; '.join(differences)}")
    module.load_state_dict(state, strict=True)


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint into memory, on the CPU, without running any code from it.

    Raises:
        CheckpointError: if the file is missing, is a folder, is broken, holds pickled objects, is no saunet checkpoint,
            was written by a newer saunet, or names a component that is not registered.
    """
    path = Path(path)
    content = _load_plain(path)
    content = content if isinstance(content, Mapping) else {}
    if "saunet" not in content or not isinstance(content.get("state_dict"), Mapping):
        raise CheckpointError(
            f"{path} is not a saunet checkpoint (no model record and weights); give a file written by saunet train"
        )
    try:
        record = ModelRecord.from_plain(content["saunet"])
        record.check_registered()
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    state = {str(key): value for key, value in content["state_dict"].items() if isinstance(value, Tensor)}
    rest = {str(key): value for key, value in content.items() if key != "state_dict"}
    return Checkpoint(path, record, state, content.get("epoch"), content.get("global_step"), rest)


def store_scale(path: str | Path, scale: Scale) -> None:
    """Write a measured factor to meters into a checkpoint; everything else in the file stays as it is."""
    read_checkpoint(path)
    content = _load_plain(Path(path))
    content["saunet"]["scale"] = asdict(scale)
    atomic_save(content, path)


def atomic_save(obj: Any, path: str | Path) -> None:
    """Save plain data and tensors, whole or not at all: if the system refuses, an older file stays as it was."""
    with replacing(path, CheckpointError) as temporary:
        try:
            with temporary.open("wb") as stream:
                torch.save(obj, stream)
        except RuntimeError as error:
            if isinstance(error.__context__, OSError):  # torch's writer hides the system's reason, such as a full disk
                raise error.__context__ from error
            raise


def _load_plain(path: Path) -> Any:
    if path.is_dir():
        found = sorted(each for level in ("", "*/", "*/checkpoints/") for each in path.glob(f"{level}*.ckpt"))
        such = f"such as {found[0]}" if found else "of which there is none"
        raise CheckpointError(f"{path} is a folder; give the checkpoint file in it, {such}")
    if not path.exists():
        raise CheckpointError(f"no checkpoint at {path}; check the path")
    return read_torch(path, "a checkpoint")


def _more(names: Sequence[str]) -> str:
    return f" (and {len(names) - 1} more)" if len(names) > 1 else ""
