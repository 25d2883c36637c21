"""Packages whose names are loaded when they are first used (PEP 562)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pkgutil import iter_modules


def lazy_names(package: str, modules: Mapping[str, str]) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package.

    Args:
        package: its name. modules: module within it -> names that the module defines, as words. Its folders need none.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}
    own = sys.modules[package]
    folders = {found.name for found in iter_modules(own.__path__) if found.ispkg}

    def load(name: str) -> object:
        if name in module_of:
            value = getattr(__import__(f"{package}.{module_of[name]}", fromlist=[name]), name)  # or the module itself
        elif name in folders:
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(own, name, value)
        return value

    def listed() -> list[str]:
        """Without what the package itself imports."""
        return sorted({*(name for name in vars(own) if name.startswith("__")), *own.__all__, *module_of, *folders})

    return load, listed
