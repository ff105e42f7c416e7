"""Weights on disk: safetensors with the facts needed to rebuild the module, no code on loading."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch import nn

from dine import __version__
from dine.errors import CheckpointError
from dine.files import atomic_path
from dine.models.backbones import BACKBONES, Backbone

BACKBONE_FORMAT = "dine-backbone"


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
    backbone = BACKBONES.get(facts["backbone"])(**facts["arguments"])
    load_state(backbone, state, path)
    return backbone, facts


def load_state(module: nn.Module, state: dict[str, torch.Tensor], path: str | Path) -> None:
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
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file fails in as many ways as there are readers
        raise CheckpointError(
            f"{path} is not a readable PyTorch state dict of plain tensors "
            f"({str(error).splitlines()[0]})."
        ) from error
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise CheckpointError(f"{path} does not hold a state dict; expected a dict of tensors.")
    transformer = any(key.startswith("transform.") for key in state)
    name = "deftransnet" if transformer else "robust_defreg"
    return state, {"backbone": name, "arguments": {}, "published": True}
