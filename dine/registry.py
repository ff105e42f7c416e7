"""Classes picked by name in the configuration: a built-in name or an import path."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from dine.errors import ConfigError

T = TypeVar("T")


class Registry(Generic[T]):
    """Maps names such as ``"pca"`` or ``"my_package.priors:MyPrior"`` to classes."""

    def __init__(self, what: str, modules: Mapping[str, str] | None = None):
        """``modules`` of built-in names are imported where these are asked for, and not before."""
        self.what = what
        self._modules = dict(modules or {})
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
        return sorted({*self._classes, *self._modules})

    def named_in_file(self, name: Any, base: type[T]) -> type[T]:
        """The class that a file says it was made with: a built-in one, or an extension's.

        A file comes from anywhere, so it may not choose what is run: nothing of Python's own
        library is imported, and what is found must be a class of DINE's kind.

        Raises:
            ConfigError: neither, or not importable.
        """
        if not isinstance(name, str):
            raise ConfigError(f"The name of the {self.what} is {name!r}; expected text.")
        package = name.split(".")[0].split(":")[0]
        if name not in self.names() and package in sys.stdlib_module_names:
            raise ConfigError(f"{name!r} is no {self.what}.")
        cls = self.get(name)
        if not (isinstance(cls, type) and issubclass(cls, base)):
            raise ConfigError(f"{name!r} is no {self.what}.")
        return cls

    def get(self, name: str) -> type[T]:
        """The class called ``name``.

        Raises:
            ConfigError: neither a registered name nor an importable ``module:Class``.
        """
        if name not in self._classes and name in self._modules:
            importlib.import_module(self._modules[name])
        if name in self._classes:
            return self._classes[name]
        if ":" in name:
            module, _, attribute = name.partition(":")
            try:
                cls = getattr(importlib.import_module(module), attribute)
            except (ImportError, AttributeError, TypeError, ValueError) as error:
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
