"""What the package refuses and what it warns about, each with its sentence, read from the source.

    python benchmarks/robustness/sentences.py > benchmarks/robustness/SENTENCES.md

Parts in braces are filled in when the sentence is made.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).parents[2] / "diffeo_calib"
TITLES = {
    "measurements": "Tables of measurements",
    "robots": "Descriptions of robots",
    "calibration": "Calibration",
    "kinematics": "Calibrated models",
    "interop": "Files of models and exports",
    "cli": "Command line",
    "fitting": "Fits of any smooth map",
}
"""Folders of the list, in its order; the others check the arguments of Python functions."""


class Sentence(NamedTuple):
    """A sentence of the package: where it is made, whether it refuses or warns, and its text."""

    folder: str
    kind: str
    text: str


def sentences() -> Iterator[Sentence]:
    """All sentences of the folders in :data:`TITLES`."""
    for folder in TITLES:
        for path in sorted((PACKAGE / folder).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
                assigned = sorted(_assignments(function), key=lambda one: one[0])
                for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
                    kind = _kind(call)
                    if kind and call.args:
                        names = {name: value for line, name, value in assigned if line < call.lineno}
                        yield Sentence(folder, kind, _text(call, names))


def _kind(call: ast.Call) -> str:
    """ "refused", "warned", or nothing for other calls."""
    function = call.func
    if isinstance(function, ast.Attribute) and function.attr == "of" and ast.unparse(function.value).endswith("Error"):
        return "refused"
    return "warned" if isinstance(function, ast.Name) and function.id == "sentence" else ""


def _assignments(function: ast.FunctionDef) -> Iterator[tuple[int, str, ast.expr]]:
    """Line, name and value of every assignment."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value = node.targets[0], node.value
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=False))
            for name, one in pairs:
                if isinstance(name, ast.Name):
                    yield node.lineno, name.id, one


def _text(call: ast.Call, names: dict[str, ast.expr]) -> str:
    """The whole sentence, as common/errors.py puts it together."""
    given = {keyword.arg: _words(keyword.value, names) for keyword in call.keywords}
    parts = [f"{name} {given[name]}" for name in ("expected", "got") if name in given]
    text = _words(call.args[0], names) + (": " + ", ".join(parts) if parts else "")
    return f"{text}; {given['fix']}." if given.get("fix") else f"{text}."


def _words(value: ast.expr, names: dict[str, ast.expr]) -> str:
    """The text of an expression; what is not known before is in braces."""
    if isinstance(value, ast.Name) and value.id in names:
        return _words(names[value.id], {name: one for name, one in names.items() if name != value.id})
    if isinstance(value, ast.Constant):
        return str(value.value)
    if isinstance(value, ast.JoinedStr):
        return "".join(_words(part, names) for part in value.values)
    if isinstance(value, ast.FormattedValue):
        return "{" + ast.unparse(value.value) + "}"
    if isinstance(value, ast.BinOp) and isinstance(value.op, ast.Add):
        return _words(value.left, names) + _words(value.right, names)
    return "{" + ast.unparse(value) + "}"


def main() -> None:
    """Print the list."""
    found = sorted(set(sentences()), key=lambda one: (list(TITLES).index(one.folder), one.kind, one.text))
    lines = ["# What is refused and what is warned about", "", (__doc__ or "").partition("\n")[0], ""]
    folder = ""
    for one in found:
        if one.folder != folder:
            folder = one.folder
            lines += ["", f"## {TITLES[folder]}", "", "| | sentence |", "|---|---|"]
        lines.append(f"| {one.kind} | {one.text.replace('|', ' or ')} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
