"""Branches of the package that ask of what kind some rows are: counted in the syntax tree.

A branch is the test of an `if`, a ternary, a `while` or a filter of a comprehension, or a truth value that is a factor,
as in ``text * bool(x)``. It asks for a kind if one of the values that decide it

* is ``isinstance`` with a table: `Measurements`, `Readings` or `Observations`;
* is compared with the name of a kind, such as "image";
* is an attribute, or a name, of what rows of some kinds alone have: ``data.sockets``, ``model.lever``, ``session``.

The values that decide a test are found through `not`, `and`, `or`, comparisons, indices, ``len``, ``bool``, ``int``,
``any`` and ``all``. Files of a set of devices, in which kinds may differ, are not looked at.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOMS = ("calibration", "kinematics", "reports", "cli/commands")
OF_DEVICES = ("calibration/placing/readings.py", "calibration/placing/sessions.py", "calibration/placing/sockets.py")
TABLES = {"Measurements", "Readings", "Observations"}
KINDS = {"position", "pose", "socket", "mixture", "distance", "displacement", "height", "image"}
NAMES = {"sockets", "socket", "session", "sessions", "readings", "lever", "payload", "board"}
ATTRIBUTES = {
    *(NAMES | {"poses", "frames", "places", "socket_numbers", "camera_on_tool", "session_names"}),
    *("without_device", "ball", "workspace"),
}
THROUGH = {"len", "bool", "int", "float"}


def branches(root: Path) -> dict[str, list[int]]:
    """Lines of the branches on a kind, by file, of the package in ``root``."""
    found = {}
    for path in (path for room in ROOMS for path in sorted((root / room).rglob("*.py"))):
        name = path.relative_to(root).as_posix()
        lines = [] if name in OF_DEVICES else lines_of(path.read_text(encoding="utf-8"))
        found |= {name: lines} if lines else {}
    return found


def lines_of(source: str) -> list[int]:
    """Lines of the branches on a kind in a file."""
    return sorted(test.lineno for test in _tests(ast.parse(source)) if any(map(_asks, _deciding(test))))


def _tests(tree: ast.AST) -> Iterator[ast.expr]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.If, ast.IfExp, ast.While)):
            yield node.test
        elif isinstance(node, ast.comprehension):
            yield from node.ifs
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            yield from (side for side in (node.left, node.right) if _is_truth(side))


def _is_truth(node: ast.expr) -> bool:
    called = isinstance(node, ast.Call) and ast.unparse(node.func) == "bool"
    return called or isinstance(node, (ast.Compare, ast.BoolOp))


def _deciding(node: ast.expr) -> Iterator[ast.expr]:
    """The values that decide a test, and the comparisons on the way to them."""
    inner: list[ast.expr] = []
    if isinstance(node, ast.BoolOp):
        inner = node.values
    elif isinstance(node, ast.UnaryOp):
        inner = [node.operand]
    elif isinstance(node, ast.Compare):
        yield node
        inner = [node.left, *node.comparators]
    elif isinstance(node, ast.Subscript):
        inner = [node.value]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ("any", "all"):
        inner = [node.func.value]
    elif isinstance(node, ast.Call) and ast.unparse(node.func) in THROUGH:
        inner = node.args
    else:
        yield node
    for one in inner:
        yield from _deciding(one)


def _asks(node: ast.expr) -> bool:
    if isinstance(node, ast.Call):
        named = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
        return ast.unparse(node.func) == "isinstance" and bool(named & TABLES)
    if isinstance(node, ast.Compare):
        constants = [one for side in (node.left, *node.comparators) for one in ast.walk(side)]
        return any(
            isinstance(one, ast.Constant) and isinstance(one.value, str) and one.value in KINDS for one in constants
        )
    if isinstance(node, ast.Attribute):
        return node.attr in ATTRIBUTES
    return isinstance(node, ast.Name) and node.id in NAMES
