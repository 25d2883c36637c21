"""Small pieces: files, functions and lists of parameters stay short, in the package, the tests and the programs."""

from __future__ import annotations

import ast
import io
import tokenize
from pathlib import Path

import pytest

import diffeo_calib

REPOSITORY = Path(diffeo_calib.__file__).parents[1]
MOST_LINES, MOST_CODE_LINES, MOST_PARAMETERS = 500, 40, 8

FILES = sorted(
    path
    for folder in ("diffeo_calib", "tests", "benchmarks", "scripts")
    for path in (REPOSITORY / folder).rglob("*.py")
)
Function = ast.FunctionDef | ast.AsyncFunctionDef


def lines_with_code(source: str) -> set[int]:
    """Lines that hold more than comments and blanks."""
    blank = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in blank:
            lines.update(range(token.start[0], token.end[0] + 1))
    return lines


def code_lines(function: Function, lines: set[int]) -> int:
    """Number of these lines that belong to a function, without its docstring."""
    own = lines & set(range(function.lineno, (function.end_lineno or 0) + 1))
    if ast.get_docstring(function) is not None:
        first = function.body[0]
        own -= set(range(first.lineno, (first.end_lineno or 0) + 1))
    return len(own)


def parameters(function: Function) -> int:
    """How many parameters a call can name, without self and cls."""
    names = [a.arg for a in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def may_have_many(function: Function, owner: str) -> bool:
    """Public names and commands: their parameters are what users can say."""
    public = {function.name, owner} & set(diffeo_calib.__all__)
    command = any("command" in ast.unparse(decorator) for decorator in function.decorator_list)
    return bool(public) or command


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_small_pieces(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    assert source.count("\n") <= MOST_LINES, "split the file by subject"
    tree, lines = ast.parse(source), lines_with_code(source)
    owners = {child: node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for child in node.body}
    for node in ast.walk(tree):
        if isinstance(node, Function):
            assert code_lines(node, lines) <= MOST_CODE_LINES, f"split {node.name}"
            many = parameters(node) > MOST_PARAMETERS
            assert not many or may_have_many(node, owners.get(node, "")), f"group the parameters of {node.name}"


def test_sizes_are_measured() -> None:
    source = 'def f(self, a, *, b):\n    """One\n    two."""\n    # three\n\n    return (\n        a\n    )\n'
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef)
    assert code_lines(function, lines_with_code(source)) == 4
    assert parameters(function) == 2
