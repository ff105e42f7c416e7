"""Packages that come only with an extra of this one, such as ``dine-registration[workflow]``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from dine.errors import ConfigError

EXTRA_OF = {
    "lightning_fabric": "parallel",
    "matplotlib": "workflow",
    "pandas": "workflow",
    "requests": "workflow",
    "rustcpd": "classical",
    "skfem": "simulation",
    "sklearn": "workflow",
    "zuko": "workflow",
}


def missing(module: str, what: str = "This") -> ConfigError:
    """The error that tells how to get a module that an extra brings, and ``what`` needs it."""
    return ConfigError(
        f"{what} needs the package {module}, which is not installed: pip install "
        f'"dine-registration[{EXTRA_OF[module]}]".'
    )


@contextlib.contextmanager
def extras_needed() -> Iterator[None]:
    """Around imports of what an extra brings, or around whatever may import it.

    Raises:
        ConfigError: it is not installed. Other failures of imports pass through.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in EXTRA_OF:
            raise
        raise missing(error.name) from error
