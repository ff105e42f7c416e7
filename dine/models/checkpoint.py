"""Weights on disk: safetensors with the facts needed to rebuild the module, no code on loading."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from dine import __version__
from dine.errors import CheckpointError, ConfigError, DataError
from dine.files import atomic_path
from dine.io import announced
from dine.models.backbones import BACKBONES, Backbone
from dine.registry import Registry

M = TypeVar("M", bound=nn.Module)

# What constructors raise that get arguments of other types, or sizes below nothing.
_MISFITS = (TypeError, ValueError, RuntimeError, OverflowError, KeyError, IndexError)

_FACTORIES = ("empty", "zeros", "ones", "full", "eye", "arange", "rand", "randn", "empty_strided")

BACKBONE_FORMAT = "dine-backbone"

WEIGHTS = Path(__file__).resolve().parents[1] / "weights"
"""Folder of what comes with the package: weights, and their priors and calibrations."""


def save_tensors(path: str | Path, tensors: dict[str, torch.Tensor], facts: dict[str, Any]) -> None:
    """Write tensors and JSON facts atomically; equal input gives equal bytes."""
    tensors = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
    # safetensors orders metadata at random, so all of it goes into a single entry.
    metadata = {"dine": json.dumps({"dine_version": __version__, **facts}, sort_keys=True)}
    with atomic_path(path) as temporary:
        safetensors.torch.save_file(tensors, temporary, metadata)


def load_tensors(path: str | Path, expected: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and facts of a file whose ``format`` must be ``expected``.

    Raises:
        CheckpointError: missing, damaged, or of another kind.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist; expected a {expected} file.")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {}).get("dine", "null"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except Exception as error:  # the library raises its own type and OSError, by fault
        raise CheckpointError(
            f"{path} is not a readable safetensors file ({error}); it may be truncated: delete it "
            "and make it again."
        ) from error
    found = facts.get("format") if isinstance(facts, dict) else None
    if found != expected:
        raise CheckpointError(f"{path} is of format {found!r}; expected {expected!r}.")
    return tensors, facts


def save_backbone(path: str | Path, backbone: Backbone, **facts: Any) -> None:
    """Write a backbone's weights with its name and constructor arguments."""
    save_tensors(
        path,
        backbone.state_dict(),
        {
            "format": BACKBONE_FORMAT,
            "backbone": backbone.registered_name,
            "arguments": backbone.arguments,
            **facts,
        },
    )


def load_backbone(path: str | Path) -> tuple[Backbone, dict[str, Any]]:
    """A backbone with its weights, and the facts stored beside them.

    Also reads the state dicts that the authors of Robust-DefReg and DefTransNet publish
    (``torch.save`` of a plain dict of tensors), told apart by content.

    Raises:
        CheckpointError: missing, damaged, or weights that do not fit the backbone.
    """
    path = Path(path)
    if path.is_file() and _is_torch_file(path):
        state, facts = _load_published(path)
    else:
        state, facts = load_tensors(path, BACKBONE_FORMAT)
    backbone = rebuilt(BACKBONES, Backbone, facts, ("backbone", "arguments"), state, path)
    return backbone, facts


def shipped_weights(kind: str) -> Path:
    """The pretrained weights that come with the package.

    Raises:
        ConfigError: there are none for this backbone.
    """
    path = WEIGHTS / f"{kind}.safetensors"
    if not path.is_file():
        shipped = sorted(found.stem for found in WEIGHTS.glob("*.safetensors"))
        names = " and ".join(name for name in shipped if "." not in name)
        raise ConfigError(
            f"There are no pretrained weights for the backbone {kind!r}, only for {names}; name a "
            "file of weights instead (--weights, `stage1.start`), or train from random ones."
        )
    return path


class _Budget(TorchDispatchMode):
    """Lets a constructor make tensors for so many weights, and not for a size that a file asks for.

    Some more than the weights themselves are needed while they get their first values.
    """

    def __init__(self, weights: int):
        super().__init__()
        self.left = 10 * weights + 1_000_000

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """No: to mark it as not to be compiled, PyTorch would import its compiler, for a second."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        if name in _FACTORIES:
            sizes = args[0] if isinstance(args[0], list | tuple) else args[:1]
            self.left -= math.prod(sizes) ** (2 if name == "eye" else 1)
            if self.left < 0:
                raise ValueError("its arguments ask for more weights than it holds")
        return func(*args, **(kwargs or {}))


def rebuilt(
    registry: Registry[M],
    base: type[M],
    facts: dict[str, Any],
    keys: tuple[str, str],
    state: dict[str, torch.Tensor],
    path: str | Path,
) -> M:
    """A module from a file: its class and arguments from the facts, its tensors from the state.

    Args:
        registry: of the classes.
        base: what the class must be.
        facts: of the file.
        keys: where they have the name of the class and its arguments.
        state: tensors of the file.
        path: of the file, for messages.

    Raises:
        CheckpointError: facts or tensors that do not make a module.
    """
    name, arguments = (facts.get(key) for key in keys)
    try:
        if not isinstance(arguments, dict):
            raise ConfigError(f"its arguments are {arguments!r}; expected names and values.")
        with _Budget(sum(value.numel() for value in state.values())):
            module = registry.named_in_file(name, base)(**arguments)
    except (ConfigError, *_MISFITS) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(
            f"{path} does not say how to build its {keys[0]} ({reason[:300]}); make it again."
        ) from error
    load_weights(module, state, path)
    return module


def load_weights(module: nn.Module, state: dict[str, torch.Tensor], path: str | Path) -> None:
    """Load a state dict strictly.

    Raises:
        CheckpointError: naming the first few keys or shapes that do not fit.
    """
    own = module.state_dict()
    faults = [f"{key} is missing" for key in own if key not in state]
    faults += [f"{key} is unknown" for key in state if key not in own]
    faults += [
        f"{key} has shape {tuple(state[key].shape)}, expected {tuple(own[key].shape)}"
        for key in own
        if key in state and state[key].shape != own[key].shape
    ]
    if faults:
        more = f" and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise CheckpointError(
            f"The weights in {path} do not fit {type(module).__name__}: "
            f"{', '.join(faults[:3])}{more}."
        )
    for key, value in state.items():
        if not torch.isfinite(value).all():
            raise CheckpointError(f"{path}: {key} holds NaN or infinite weights.")
    module.load_state_dict(state)


def _is_torch_file(path: Path) -> bool:
    with open(path, "rb") as stream:
        start = stream.read(4)
    return start[:2] in (b"PK", b"\x80\x02")  # a zip archive, or the older pickle stream


def _load_published(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    try:
        content = path.read_bytes()
        announced.check_pickled_sizes(path, content)
        # A stream in memory never takes room for more than it has.
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except DataError as error:
        raise CheckpointError(str(error)) from None
    except Exception as error:  # a damaged file fails in as many ways as there are readers
        raise CheckpointError(
            f"{path} is not a readable PyTorch state dict of plain tensors "
            f"({' '.join(str(error).split())[:300] or type(error).__name__})."
        ) from error
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise CheckpointError(f"{path} does not hold a state dict; expected a dict of tensors.")
    transformer = any(key.startswith("transform.") for key in state)
    name = "deftransnet" if transformer else "robust_defreg"
    return state, {"backbone": name, "arguments": {}, "published": True}
