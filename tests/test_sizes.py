"""Small pieces: files, functions and lists of parameters stay short, in the package, the tests and the programs."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import diffeo_calib

REPOSITORY = Path(diffeo_calib.__file__).parents[1]
MOST_LINES, MOST_CODE_LINES, MOST_PARAMETERS = 500, 40, 8

FILES = sorted(
    path
    for folder in ("diffeo_calib", "tests", "benchmarks", "scripts")
    for path in (REPOSITORY / folder).rglob("*.py")
)
Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def lines_with_code(source: str) -> set[int]:
    """Lines that hold more than comments and blanks."""
    blank = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in blank:
            lines.update(range(token.start[0], token.end[0] + 1))
    return lines


def code_lines(function: Function, source: str) -> int:
    """Number of lines with code that belong to a function, without its docstring; at most those that it spans."""
    last = function.end_lineno or 0
    if last - function.lineno < MOST_CODE_LINES:
        return last - function.lineno + 1
    own = lines_with_code(source) & set(range(function.lineno, last + 1))
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


def too_big(path: Path, source: str) -> Iterator[str]:
    """What is too long in a file, and which functions have too many parameters."""
    if source.count("\n") > MOST_LINES:
        yield f"{path}: {source.count(chr(10))} lines: split the file by subject"
    tree = ast.parse(source)
    owners = {child: node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for child in node.body}
    for node in ast.walk(tree):
        if isinstance(node, Function):
            place = f"{path}, line {node.lineno}"
            if code_lines(node, source) > MOST_CODE_LINES:
                yield f"{place}: {code_lines(node, source)} lines of code: split {node.name}"
            if parameters(node) > MOST_PARAMETERS and not may_have_many(node, owners.get(node, "")):
                yield f"{place}: group the parameters of {node.name}"


def test_small_pieces() -> None:
    assert len(FILES) > 500
    sources = {path.relative_to(REPOSITORY): path.read_text(encoding="utf-8") for path in FILES}
    found = [text for path, source in sources.items() for text in too_big(path, source)]
    assert not found, "\n".join(found)


def test_sizes_are_measured() -> None:
    longer = MOST_CODE_LINES * "    # four\n"
    source = f'def f(self, a, *, b):\n    """One\n    two."""\n{longer}\n    return (\n        a\n    )\n'
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef)
    assert code_lines(function, source) == 4
    assert parameters(function) == 2


def test_big_pieces_are_found() -> None:
    names = ", ".join("abcdefghi")
    long = f"def f({names}):\n" + MOST_CODE_LINES * "    a = b\n" + MOST_LINES * "\n"
    found = [text.partition(": ")[2] for text in too_big(Path("f.py"), long)]
    assert found == ["541 lines: split the file by subject", "41 lines of code: split f", "group the parameters of f"]
    assert not list(too_big(Path("f.py"), f"class Problem:\n    def __init__(self, {names}):\n        pass\n"))
