"""Non-rigid registration of soft-tissue point clouds with learned deformation priors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from dine.registration.model import load_model
    from dine.registration.register import register
    from dine.registration.types import RegistrationResult

__all__ = ["RegistrationResult", "__version__", "load_model", "register"]


def __getattr__(name: str) -> Any:
    # The command line asks for the version alone, and torch takes a while to import.
    if name in ("RegistrationResult", "load_model", "register"):
        from dine.registration import register as module

        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
