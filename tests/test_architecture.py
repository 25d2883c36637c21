"""The architecture, as a table and as a test: a folder imports only from folders above it in the table.

The story in four lines: mathematics without robots | robots and tables without kernels | where they meet | faces.
"""

import ast
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import diffeo_calib

# From the ground up: a folder may import from those before it in this table, and from itself, but not in a circle.
# A folder's own parts are listed where they have an order of their own.
FLOORS = (
    ("common", "errors, checks of input, threads, device"),
    ("runtime", "calibrated models as plain arrays, evaluated by NumPy alone"),
    # mathematics, no robot
    ("kernels.spaces", "lines, circles and their products"),
    ("kernels.profiles", "radial functions of kernels, with derivatives"),
    ("kernels.reductions", "kernel sums: formulas, backends"),
    ("kernels", "kernels: profile + space + matrix; sums, stacks"),
    ("flows", "geodesics, their adjoint, integrators"),
    ("maps", "nominal maps, deformations, linearisation, noise"),
    ("regression", "the linearised model conditioned on its data: one Gaussian process; weights of rows"),
    ("fitting", "problems, solvers, fits of any smooth map"),
    # robots and tables, no kernel
    ("robots", "chains, DH, URDF, geometric errors, gravity sag"),
    ("cameras", "lenses, boards, images"),
    ("measurements", "rows, whatever measured them; CSV files"),
    ("sensors", "devices of readings: what they see, where they are"),
    # where they meet
    ("kinematics", "a robot's kinematics as maps: nominal, calibrated; errors on measurements"),
    ("paper", "the paper's own formulation"),
    ("process", "scales of the fields, evidence of unknowns"),
    ("calibration.identification", "registration, geometric errors, joint offsets"),
    ("calibration.scales", "kernel scales by marginal likelihood, leave-one-out"),
    ("calibration.diagnostics", "measurements that cannot be right"),
    ("calibration", "the calibration of a robot"),
    ("calibration.planning", "poses to measure"),
    ("campaign", "rows judged as they come"),
    # faces
    ("interop", "model files"),
    ("reports", "analysis, plots, HTML pages"),
    ("cli", "the command line, the only folder that prints"),
)
MATHEMATICS = ("kernels", "flows", "maps", "regression", "fitting")
ROBOTS = ("robots", "cameras", "measurements")
STRANGERS: dict[str, tuple[str, ...]] = {**dict.fromkeys(MATHEMATICS, ROBOTS), **dict.fromkeys(ROBOTS, MATHEMATICS)}
"""Folders that must not know each other, whatever their order."""
EXCEPTIONS = {
    ("fitting.fit", "paper.eulerian"): 'fit(formulation="eulerian") reaches up, inside a function',
    ("kinematics.calibrated", "calibration.recalibration.register"): "so does `model.registered`, a verb of new rows",
}
IN_THE_ROOT = {"__init__.py", "__main__.py", "py.typed"}

MOST_PUBLIC_NAMES = 53

PACKAGE = Path(diffeo_calib.__file__).parent
LEVEL = {name: level for level, (name, _) in enumerate(FLOORS)}


def module_name(path: Path) -> str:
    """``flows/geodesic.py`` -> ``diffeo_calib.flows.geodesic``; a folder's ``__init__.py`` -> the folder."""
    parts = [PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def trees() -> dict[str, ast.Module]:
    return {name: ast.parse(path.read_text(encoding="utf-8"), str(path)) for name, path in SOURCES.items()}


def floor(module: str) -> str:
    """``diffeo_calib.kernels.reductions.tiled`` -> ``kernels.reductions``; the package itself -> ``""``."""
    parts = module.split(".")[1:]
    for length in range(len(parts), 0, -1):
        if ".".join(parts[:length]) in LEVEL:
            return ".".join(parts[:length])
    return ""


def room(module: str) -> str:
    """``diffeo_calib.flows.geodesic`` -> ``flows``."""
    return [*module.split("."), ""][1]


def imported_modules(tree: ast.Module, known: set[str]) -> Iterator[tuple[str, int]]:
    """Yield (module of this package, line) for every import, wherever in the file it stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            submodules = [f"{source}.{alias.name}" for alias in node.names]
            names = [name if name in known else source for name in submodules]
        else:
            continue
        yield from ((name, node.lineno) for name in names if name.split(".")[0] == PACKAGE.name)


def floor_mistakes(module: str, imports: list[tuple[str, int]]) -> list[str]:
    own, mistakes = floor(module), []
    for other, line in imports:
        theirs = floor(other)
        if (module.partition(".")[2], other.partition(".")[2]) in EXCEPTIONS:
            continue
        if not theirs:
            mistakes.append(f"line {line}: imports from the package itself: import from the file that defines it")
        elif theirs != own and LEVEL.get(theirs, 0) >= LEVEL.get(own, len(FLOORS)):
            mistakes.append(f"line {line}: '{own}' imports '{theirs}', which stands below it in the table")
        elif room(other) in STRANGERS.get(room(module), ()):
            mistakes.append(f"line {line}: '{own}' must know nothing of '{theirs}'")
    return mistakes


@cache
def imports() -> dict[str, list[tuple[str, int]]]:
    return {name: list(imported_modules(tree, set(SOURCES))) for name, tree in trees().items()}


MODULES = [name for name in SOURCES if floor(name)]


def test_every_folder_has_its_place_and_every_exception_is_needed() -> None:
    rooms = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert rooms == {name.split(".")[0] for name in LEVEL}
    assert {path.name for path in PACKAGE.iterdir() if path.is_file()} == IN_THE_ROOT
    for module, other in EXCEPTIONS:
        assert f"{PACKAGE.name}.{other}" in [name for name, _ in imports()[f"{PACKAGE.name}.{module}"]]


def test_imports_only_from_floors_below_and_in_no_circle() -> None:
    found = [f"{module}, {text}" for module in MODULES for text in floor_mistakes(module, imports()[module])]
    assert not found, "\n".join(found)
    graph = {module: {other for other, _ in found} for module, found in imports().items()}
    for module, other in EXCEPTIONS:  # inside functions
        graph[f"{PACKAGE.name}.{module}"].discard(f"{PACKAGE.name}.{other}")
    TopologicalSorter(graph).prepare()  # raises where modules import each other in a circle


def habits(module: str, tree: ast.Module) -> Iterator[str]:
    if not ast.get_docstring(tree):
        yield f"{module}: begin the file with a docstring"
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "print" and floor(module) != "cli":
            yield f"{module}, line {node.lineno}: only cli/ prints: report through a callback or a result"
        if isinstance(node, ast.ImportFrom) and node.level:
            yield f"{module}, line {node.lineno}: import by the full name"
        if isinstance(node, ast.Assert):
            yield f"{module}, line {node.lineno}: `python -O` removes assert: raise an error of common.errors"


def test_says_what_it_is_and_neither_prints_nor_asserts() -> None:
    assert len(trees()) > 100
    found = [text for module, tree in trees().items() for text in habits(module, tree)]
    assert not found, "\n".join(found)


def test_files_of_tests_and_public_names() -> None:
    names = Counter(path.name for path in (PACKAGE.parent / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []
    names = getattr(diffeo_calib, "__all__", [])
    assert len(names) <= MOST_PUBLIC_NAMES
    assert len(set(names)) == len(names)
    assert [name for name in names if not hasattr(diffeo_calib, name)] == []


WRONG_ARROWS = {"maps.nominal": "robots.geometry", "robots.chain": "kernels.base", "cli.main": ""}
WRONG_ARROWS |= {"kinematics.nominal": "calibration.calibrate", "fitting.problem": "paper.eulerian"}
"""A module -> one that it must not import."""


def test_mistakes_are_found() -> None:
    root = PACKAGE.name
    for module, other in WRONG_ARROWS.items():
        assert floor_mistakes(f"{root}.{module}", [(f"{root}.{other}".rstrip("."), 1)]), (module, other)
    asking = """
if isinstance(data, (Readings, str)): pass
x = 1 if data.sockets is None else 2
y = [row for row in rows if not row.poses]
z = "text" * bool(data.session)
while part.kind == "image" and x: pass
if len(data.session_names) > 1: pass
w = "a" * (lever is not None)
if bool((data.places < 0).any()): pass
if int(data.socket[row]) != 3: pass
"""
    assert lines_of(asking) == [2, 3, 4, 5, 6, 7, 8, 9, 10]
    lines = "torch.zeros(3)", "torch.eye(2, dtype=float, device=cpu)", "torch.Tensor(3)", "torch.Generator(cpu)"
    found = [text.partition(":")[0] for text in undecided(ast.parse("\n".join([*lines, "torch.Generator()"])))]
    assert found == ["line 1", "line 1", "line 3", "line 3", "line 5"]


# --- no branch on the kind of the rows ------------------------------------------------------------------------------
#
# A test, or a truth value that is a factor, must not be ``isinstance`` with a table, a comparison with the name of a
# kind, or an attribute of what rows of some kinds alone have. What differs between kinds belongs into the file of its
# sensor or of its set of devices.

ROOMS = ("calibration", "kinematics", "reports", "cli/commands")
OF_DEVICES = ("calibration/placing/readings.py", "calibration/placing/placement.py")
TABLES = {"Measurements", "Readings", "Observations"}
KINDS = {"position", "pose", "socket", "mixture", "distance", "displacement", "height", "image"}
NAMES = {"sockets", "socket", "session", "sessions", "readings", "lever", "payload", "board"}
ATTRIBUTES = NAMES | {"poses", "frames", "places", "socket_numbers", "camera_on_tool", "session_names"}
ATTRIBUTES |= {"without_device", "ball", "workspace"}
THROUGH = {"len", "bool", "int", "float"}


def lines_of(source: str) -> list[int]:
    return sorted(test.lineno for test in _tests(ast.parse(source)) if _asks(test))


def _tests(tree: ast.AST) -> Iterator[ast.expr]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.If, ast.IfExp, ast.While)):
            yield node.test
        elif isinstance(node, ast.comprehension):
            yield from node.ifs
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            truths = (side for side in (node.left, node.right) if isinstance(side, (ast.Compare, ast.BoolOp, ast.Call)))
            yield from (side for side in truths if not isinstance(side, ast.Call) or ast.unparse(side.func) == "bool")


def _asks(node: ast.AST) -> bool:
    """Whether a value that decides a test is one of those."""
    inner = list(ast.iter_child_nodes(node))
    if isinstance(node, (ast.Attribute, ast.Name)):
        return node.attr in ATTRIBUTES if isinstance(node, ast.Attribute) else node.id in NAMES
    if isinstance(node, ast.Constant):
        return str(node.value) in KINDS
    if isinstance(node, ast.Subscript):
        inner = [node.value]
    elif isinstance(node, (ast.Set, ast.NamedExpr)):
        inner = [one for one in inner if isinstance(one, ast.Constant)]
    elif isinstance(node, ast.Call):
        called = ast.unparse(node.func)
        if called == "isinstance":
            return bool({one.id for one in ast.walk(node) if isinstance(one, ast.Name)} & TABLES)
        through = isinstance(node.func, ast.Attribute) and node.func.attr in ("any", "all")
        inner = [node.func.value] if through else node.args if called in THROUGH else []  # pyright: ignore
    return any(map(_asks, inner))


def test_no_branches_on_a_kind() -> None:
    paths = [path for room in ROOMS for path in sorted((PACKAGE / room).rglob("*.py"))]
    names = {path.relative_to(PACKAGE).as_posix(): lines_of(path.read_text(encoding="utf-8")) for path in paths}
    assert {name: lines for name, lines in names.items() if lines and name not in OF_DEVICES} == {}


# --- every tensor states its device and its kind of numbers ----------------------------------------------------------
#
# The package is the same under any default device and type of torch.

NUMBERED = {"arange", "randint", "randperm", "tril_indices", "triu_indices", "Generator"}
"""Their kind of numbers does not follow the default type; that of `arange` follows its arguments."""
FACTORIES = NUMBERED | {
    *("as_tensor", "asarray", "empty", "empty_strided", "eye", "full", "hamming_window", "hann_window", "linspace"),
    *("logspace", "normal", "ones", "rand", "randn", "scalar_tensor", "sparse_coo_tensor", "tensor", "zeros"),
}
"""Functions of torch whose result lies on the default device, unless it is stated."""
OLD = {"Tensor", "FloatTensor", "DoubleTensor", "LongTensor", "BoolTensor", "set_default_device", "set_default_dtype"}
"""Constructors that cannot state it, and global switches."""


def undecided(tree: ast.Module) -> Iterator[str]:
    """Calls in a program that leave the device or the kind of numbers to a default."""
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        owner, name = node.func.value, node.func.attr
        if not (isinstance(owner, ast.Name) and owner.id == "torch" and name in FACTORIES | OLD):
            continue
        stated = {keyword.arg for keyword in node.keywords}
        if name == "Generator" and node.args:
            stated.add("device")
        for option in ("device",) if name in NUMBERED else ("device", "dtype"):
            if name in OLD or option not in stated:
                yield f"line {node.lineno}: torch.{name} without {option}"


def test_every_tensor_states_its_device_and_its_kind() -> None:
    found = [f"{module}, {text}" for module, tree in trees().items() for text in undecided(tree)]
    assert not found, "\n".join(found)
