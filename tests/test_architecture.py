"""The architecture, as a table and as a test: a file imports only from floors below its own."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import diffeo_calib

# From the ground up. A folder is one floor: its files may import each other, but not in a circle.
FLOORS = (
    ("errors", "one exception family, one message grammar"),
    ("checks", "arrays that come from outside: shape, finiteness, sign"),
    ("threads", "threads of NumPy and SciPy, which get in the way of torch's"),
    ("student", "noise with heavy tails: Student's t by reweighting"),
    ("rotations", "rotations by named conventions, poses as three points"),
    ("spaces", "lines, circles and their products"),
    ("profiles", "radial functions of kernels, with derivatives"),
    ("reductions", "the one door to kernel sums: dense, tiled, keops"),
    ("kernels", "kernels: profile + space + matrix; sums, stacks"),
    ("flows", "geodesics, their adjoint, integrators, transport"),
    ("robots", "chains, DH, URDF, error twists"),
    ("measurements", "measured pairs: validation, subsets, splits"),
    ("csv_files", "columns of numbers out of CSV files"),
    ("layouts", "units and columns of such files"),
    ("tables", "measurements in CSV files, in any unit"),
    ("noise", "covariance of the measurements"),
    ("nominal", "the nominal kinematics as any smooth map with parameters"),
    ("deformed", "what every formulation of k1 has in common"),
    ("deformation", "the exact model k1 = psi o k0 o phi^-1 and its linearisation"),
    ("deformed_map", "a fitted k1, whatever the formulation: call, jacobian, inverse"),
    ("eulerian", "the paper's own discretisation, at fixed points"),
    ("regression", "the linearised model conditioned on its data"),
    ("model", "calibrated kinematics: call, jacobian, predict"),
    ("evaluation", "errors of a model on measurements"),
    ("calibration", "where kernels and robots meet: problems and solvers"),
    ("storage", "model files"),
    ("plots", "figures"),
    ("paper_figures", "the figures of the paper's section 5"),
    ("console", "what the command line shows"),
    ("cli_options", "options of the command line, what they mean together"),
    ("cli", "the command line, the only one that prints"),
)
# A robot does not know what a kernel is, although kernels lie below it.
STRANGERS = {"robots": {"profiles", "reductions", "kernels", "flows"}}

NOT_ON_IMPORT = ("pykeops", "torchdiffeq", "matplotlib", "lxml")
MOST_PUBLIC_NAMES = 30

PACKAGE = Path(diffeo_calib.__file__).parent
LEVEL = {name: level for level, (name, _) in enumerate(FLOORS)}


def module_name(path: Path) -> str:
    """``flows/transport.py`` -> ``diffeo_calib.flows.transport``; a folder's ``__init__.py`` -> the folder."""
    parts = [PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text(encoding="utf-8"), str(path)) for name, path in SOURCES.items()}


def floor(module: str) -> str:
    """``diffeo_calib.flows.transport`` -> ``flows``; the package itself -> ``""``."""
    return [*module.split("."), ""][1]


def imported_modules(module: str, tree: ast.Module, known: set[str]) -> Iterator[tuple[str, int]]:
    """Yield (module of this package, line) for every import, wherever in the file it stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            source = absolute(module, node, known)
            submodules = [f"{source}.{alias.name}" for alias in node.names]
            names = [name if name in known else source for name in submodules]
        else:
            continue
        yield from ((name, node.lineno) for name in names if name.split(".")[0] == PACKAGE.name)


def absolute(module: str, node: ast.ImportFrom, known: set[str]) -> str:
    """Resolve ``from ..errors import X``."""
    if not node.level:
        return node.module or ""
    is_folder = any(name.startswith(module + ".") for name in known)
    parts = module.split(".")
    base = parts[: len(parts) - node.level + is_folder]
    return ".".join([*base, node.module] if node.module else base)


def floor_mistakes(module: str, imports: list[tuple[str, int]]) -> list[str]:
    own = floor(module)
    mistakes = []
    for other, line in imports:
        theirs = floor(other)
        if not theirs:
            mistakes.append(f"line {line}: imports from the package itself: import from the file that defines it")
        elif theirs != own and LEVEL.get(theirs, 0) >= LEVEL.get(own, len(FLOORS)):
            mistakes.append(f"line {line}: '{own}' imports '{theirs}', which is a floor above it")
        elif theirs in STRANGERS.get(own, set()):
            mistakes.append(f"line {line}: '{own}' must know nothing of '{theirs}'")
    return mistakes


def find_cycle(graph: dict[str, set[str]]) -> list[str]:
    """Return the modules of one import cycle, or nothing."""
    done: set[str] = set()

    def visit(module: str, path: list[str]) -> list[str]:
        if module in path:
            return [*path[path.index(module) :], module]
        if module not in done:
            for other in sorted(graph.get(module, ())):
                cycle = visit(other, [*path, module])
                if cycle:
                    return cycle
            done.add(module)
        return []

    return next((cycle for cycle in (visit(module, []) for module in sorted(graph)) if cycle), [])


IMPORTS = {name: list(imported_modules(name, tree, set(SOURCES))) for name, tree in TREES.items()}
MODULES = [name for name in SOURCES if floor(name)]


@pytest.mark.parametrize("module", MODULES)
def test_every_file_has_a_floor(module: str) -> None:
    assert floor(module) in LEVEL, f"add '{floor(module)}' to FLOORS, at its place"


@pytest.mark.parametrize("module", MODULES)
def test_imports_only_from_floors_below(module: str) -> None:
    assert floor_mistakes(module, IMPORTS[module]) == []


def test_no_import_cycles() -> None:
    graph = {module: {other for other, _ in imports} for module, imports in IMPORTS.items()}
    assert find_cycle(graph) == []


@pytest.mark.parametrize("module", SOURCES)
def test_says_what_it_is(module: str) -> None:
    assert ast.get_docstring(TREES[module]), "begin the file with a docstring"


@pytest.mark.parametrize("module", SOURCES)
def test_does_not_print(module: str) -> None:
    calls = [node for node in ast.walk(TREES[module]) if isinstance(node, ast.Call)]
    prints = [call.lineno for call in calls if isinstance(call.func, ast.Name) and call.func.id == "print"]
    assert floor(module) == "cli" or prints == [], "only cli.py prints: report through a callback or a result"


@pytest.mark.parametrize("module", SOURCES)
def test_raises_instead_of_asserting(module: str) -> None:
    asserts = [node.lineno for node in ast.walk(TREES[module]) if isinstance(node, ast.Assert)]
    assert asserts == [], "`python -O` removes assert: raise an error of diffeo_calib.errors"


def test_import_is_light() -> None:
    code = f"import sys, diffeo_calib; print(*[name for name in {NOT_ON_IMPORT} if name in sys.modules])"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=PACKAGE.parent, timeout=120)
    assert result.stdout.split() == [], "import these inside the function that needs them"


def test_few_public_names() -> None:
    names = getattr(diffeo_calib, "__all__", [])
    assert len(names) <= MOST_PUBLIC_NAMES
    assert len(set(names)) == len(names)
    assert [name for name in names if not hasattr(diffeo_calib, name)] == []


# --- the checks above find what they are made for ---------------------------------------------------

EXAMPLE = """
import torch, diffeo_calib.errors
from diffeo_calib import checks, Gaussian
from . import integrate
from .integrate import RK4
from ..kernels import VonMises
def later():
    from diffeo_calib.robots.chain import Chain
"""


def test_imports_are_found_and_resolved() -> None:
    root = PACKAGE.name
    known = {f"{root}.{name}" for name in ("checks", "flows", "flows.integrate", "flows.transport", "kernels")} | {root}
    tree = ast.parse(EXAMPLE)
    expected = ["errors", "checks", "", "flows.integrate", "flows.integrate", "kernels", "robots.chain"]
    for module, source in ((f"{root}.flows.transport", tree), (f"{root}.flows", tree)):
        found = [name for name, _ in imported_modules(module, source, known)]
        assert found == [f"{root}.{name}".rstrip(".") for name in expected]


@pytest.mark.parametrize(
    ("module", "other", "allowed"),
    [
        ("kernels", "spaces", True),
        ("flows.transport", "flows.integrate", True),
        ("calibration.tangent", "model", True),
        ("spaces", "kernels", False),
        ("kernels", "robots.chain", False),
        ("flows.transport", "robots.chain", False),
        ("robots.chain", "kernels", False),
        ("robots.chain", "reductions", False),
        ("robots.chain", "flows.integrate", False),
        ("model", "calibration.tangent", False),
        ("cli", "", False),
    ],
)
def test_floors_are_enforced(module: str, other: str, allowed: bool) -> None:
    root = PACKAGE.name
    assert (floor_mistakes(f"{root}.{module}", [(f"{root}.{other}".rstrip("."), 1)]) == []) is allowed


def test_cycles_are_found() -> None:
    assert find_cycle({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert find_cycle({"a": {"b"}, "b": {"c", "d"}, "c": set(), "d": {"b"}}) == ["b", "d", "b"]
