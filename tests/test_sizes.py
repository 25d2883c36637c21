"""Small pieces: files, functions and lists of parameters stay short, in the package, the tests and the programs.

And a package that only shrinks: its lines and those of each of its folders are held at the numbers of sizes.json.
"""

import ast
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import diffeo_calib

REPOSITORY = Path(diffeo_calib.__file__).parents[1]
MOST_LINES, MOST_CODE_LINES, MOST_PARAMETERS = 500, 60, 8
SIZES = Path(__file__).with_name("sizes.json")
"""Name of each folder of the package, "root" and "total" -> its lines at most."""

FOLDERS = "diffeo_calib", "tests", "benchmarks", "scripts"
FILES = sorted(path for folder in FOLDERS for path in (REPOSITORY / folder).rglob("*.py"))
Function = ast.FunctionDef | ast.AsyncFunctionDef


def code_lines(function: Function, source: str) -> int:
    """Number of lines that hold more than comments and blanks, without the docstring."""
    lines, first = source.split("\n"), function.body[0]
    own = set(range(function.lineno, (function.end_lineno or 0) + 1))
    if ast.get_docstring(function) is not None:
        own -= set(range(first.lineno, (first.end_lineno or 0) + 1))
    return sum(not lines[number - 1].strip().startswith("#") for number in own if lines[number - 1].strip())


def parameters(function: Function) -> int:
    """How many parameters a call can name, without self and cls."""
    names = [a.arg for a in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def may_have_many(function: Function, owner: str) -> bool:
    """Public names and commands: their parameters are what users can say."""
    public = {function.name, owner} & set(vars(diffeo_calib)["__all__"])
    command = any("command" in ast.unparse(decorator) for decorator in function.decorator_list)
    return bool(public) or command


def functions(node: ast.AST, owner: str = "") -> Iterator[tuple[Function, str]]:
    """Every function, and the class that it is a method of; expressions, which hold none, are not looked at."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Function):
            yield child, owner
        if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)):
            yield from functions(child, child.name if isinstance(child, ast.ClassDef) else "")


def too_big(path: Path, source: str) -> Iterator[str]:
    """What is too long in a file, and which functions have too many parameters."""
    if source.count("\n") > MOST_LINES:
        yield f"{path}: {source.count(chr(10))} lines: split the file by subject"
    for node, owner in functions(ast.parse(source)):
        place = f"{path}, line {node.lineno}"
        if code_lines(node, source) > MOST_CODE_LINES:
            yield f"{place}: {code_lines(node, source)} lines of code: split {node.name}"
        if parameters(node) > MOST_PARAMETERS and not may_have_many(node, owner):
            yield f"{place}: group the parameters of {node.name}"


def test_small_pieces() -> None:
    assert len(FILES) > 300
    sources = {path.relative_to(REPOSITORY): path.read_text(encoding="utf-8") for path in FILES}
    found = [text for path, source in sources.items() for text in too_big(path, source)]
    assert not found, "\n".join(found)


VAGUE, MOST_USES = ("found", "known", "one", "own", "seen", "told"), 150
"""Words that say nothing of what a name holds, and how often the package may use each as one."""


def test_names_say_what_they_hold() -> None:
    package = Path(diffeo_calib.__file__).parent
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in FILES if package in path.parents]
    kinds = {ast.Name: "id", ast.Attribute: "attr", ast.arg: "arg", ast.keyword: "arg", ast.FunctionDef: "name"}
    nodes = [node for tree in trees for node in ast.walk(tree) if type(node) in kinds]
    uses = Counter(getattr(node, kinds[type(node)]) for node in nodes)
    assert {word: uses[word] for word in VAGUE if uses[word] > MOST_USES} == {}


def lines_of_package() -> dict[str, int]:
    """Name of each folder of the package, "root" and "total" -> its lines."""
    found: Counter[str] = Counter()
    for path in Path(diffeo_calib.__file__).parent.rglob("*.py"):
        parts = path.relative_to(Path(diffeo_calib.__file__).parent).parts
        lines = path.read_text(encoding="utf-8").count("\n")
        found.update({"total": lines, parts[0] if len(parts) > 1 else "root": lines})
    return dict(found)


def grown(found: dict[str, int], held: dict[str, int]) -> list[str]:
    """Sentences about rooms with more lines than are recorded; a new one, which is not, may have what others lost."""
    return [
        f"{room}: {lines} lines, at most {held[room]}" for room, lines in found.items() if lines > held.get(room, lines)
    ]


def test_lines_only_fall() -> None:
    found = grown(lines_of_package(), json.loads(SIZES.read_text(encoding="utf-8")))
    advice = "delete as much as you add; `python tests/test_sizes.py` records lower numbers and new folders"
    assert not found, "\n".join([*found, advice])


if __name__ == "__main__":
    held = json.loads(SIZES.read_text(encoding="utf-8")) if SIZES.exists() else {}
    lowered = {room: min(lines, held.get(room, lines)) for room, lines in sorted(lines_of_package().items())}
    SIZES.write_text(json.dumps(lowered, indent=1) + "\n", encoding="utf-8")
