"""Packages whose names are loaded when they are first used (PEP 562)."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules


def lazy_names(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package: what its file imports for type checkers alone.

    Those imports, ``from MODULE import NAME as NAME`` below ``if TYPE_CHECKING``, are the only list of its names. Its
    folders need none.
    """
    loaded = sys.modules[package]
    folders = {entry.name for entry in iter_modules(loaded.__path__) if entry.ispkg}
    module_of = dict(_imported(Path(loaded.__path__[0]) / "__init__.py"))

    def load(name: str) -> object:
        if name in folders:
            value = import_module(f"{package}.{name}")
        elif name in module_of:
            value = getattr(__import__(module_of[name], fromlist=[name]), name)  # or the module itself
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(loaded, name, value)
        return value

    def listed() -> list[str]:
        """Without what the package itself imports."""
        return sorted({*(name for name in vars(loaded) if name.startswith("__")), *module_of, *folders})

    return load, listed, sorted(name for name, module in module_of.items() if module.count(".") > 1)  # no folders


def _imported(file: Path) -> Iterator[tuple[str, str]]:
    """Names that a file imports for type checkers alone, and their modules."""
    for block in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            for node in block.body:
                if isinstance(node, ast.ImportFrom) and node.module is not None:
                    yield from ((alias.name, node.module) for alias in node.names)
