"""Non-rigid registration of soft-tissue point clouds with learned deformation priors."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from dine.errors import (
        CheckpointError,
        ConfigError,
        DataError,
        DineError,
        DownloadError,
        StorageError,
    )
    from dine.geometry.surface import Surface
    from dine.io.readers import read_surface
    from dine.io.writers import write_moved
    from dine.priors.shape_model import ShapeModel
    from dine.registration.model import load_model
    from dine.registration.population import shape_model
    from dine.registration.register import register
    from dine.registration.saved import load_result
    from dine.registration.types import Model, RegistrationResult, Trust

# The command line asks for the version alone, and torch takes a while to import.
_HOMES = {
    "errors": (
        "CheckpointError",
        "ConfigError",
        "DataError",
        "DineError",
        "DownloadError",
        "StorageError",
    ),
    "geometry.surface": ("Surface",),
    "io.readers": ("read_surface",),
    "io.writers": ("write_moved",),
    "priors.shape_model": ("ShapeModel",),
    "registration.model": ("load_model",),
    "registration.population": ("shape_model",),
    "registration.register": ("register",),
    "registration.saved": ("load_result",),
    "registration.types": ("Model", "RegistrationResult", "Trust"),
}

__all__ = [
    "CheckpointError",
    "ConfigError",
    "DataError",
    "DineError",
    "DownloadError",
    "Model",
    "RegistrationResult",
    "ShapeModel",
    "StorageError",
    "Surface",
    "Trust",
    "__version__",
    "load_model",
    "load_result",
    "read_surface",
    "register",
    "shape_model",
    "write_moved",
]


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
