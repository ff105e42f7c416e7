"""Classes picked by name in the configuration: a built-in name or an import path."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Generic, TypeVar

from dine.errors import ConfigError

T = TypeVar("T")


class Registry(Generic[T]):
    """Maps names such as ``"pca"`` or ``"my_package.priors:MyPrior"`` to classes."""

    def __init__(self, what: str):
        self.what = what
        self._classes: dict[str, type[T]] = {}

    def register(self, name: str) -> Callable[[type[T]], type[T]]:
        """Class decorator that makes a class known under ``name``."""

        def add(cls: type[T]) -> type[T]:
            self._classes[name] = cls
            cls.registered_name = name
            return cls

        return add

    def names(self) -> list[str]:
        """The built-in names, sorted."""
        return sorted(self._classes)

    def get(self, name: str) -> type[T]:
        """The class called ``name``.

        Raises:
            ConfigError: neither a registered name nor an importable ``module:Class``.
        """
        if name in self._classes:
            return self._classes[name]
        if ":" in name:
            module, _, attribute = name.partition(":")
            try:
                cls = getattr(importlib.import_module(module), attribute)
            except (ImportError, AttributeError) as error:
                raise ConfigError(
                    f"The {self.what} {name!r} could not be imported ({error}); expected "
                    "'package.module:Class' on the Python path."
                ) from error
            # Weights and priors remember the name they were made under.
            if "registered_name" not in vars(cls):
                cls.registered_name = name
            return cls
        raise ConfigError(
            f"Unknown {self.what} {name!r}; expected one of {', '.join(self.names())} or an import "
            "path 'package.module:Class'."
        )
