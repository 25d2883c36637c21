"""The options of all commands: their types and values by default; help.md says what they mean. Imports nothing slow.

A group of options is a frozen dataclass: a command with a field of this type has all of its options. The field
`joint_length` is the option --joint-length.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args, get_origin, get_type_hints

import typer
from typing_extensions import dataclass_transform

from diffeo_calib.common.errors import InputError

HELP = Path(__file__).with_name("help.md")
SHORT = {"output": "-o", "count": "-n"}
LARGEST_SEED = 2**63 - 1
"""As in common/checks.py, which loads torch."""
DRAWN = 3000
CORNERS = "corners="
"""Begin of --reading for images of a board."""

Length = Literal["m", "mm", "cm", "inch"]
"""As in measurements/table_format.py, which loads torch."""
Angle = Literal["rad", "deg"]
Frame = Literal["base", "measuring"]
Free = Literal["both", "base", "marker"]
"""Parts of the set-up that may have moved."""
ToolFrom = Literal["tip", "measured"]
Convention = Literal["standard", "craig"]
Text, Texts, File = str | None, list[str] | None, Path | None
Written, Output = Annotated[Path | None, "write"], Annotated[Path, "write"]
"""Files that a command writes, beside those that it reads, those that may come later, and folders that it makes."""
Seed = Annotated[int, {"min": 0, "max": LARGEST_SEED}]


class Option(NamedTuple):
    """An option or an argument, as typer takes it.

    Args:
        field: its field. hint, default: of its value; MISSING where it is required. names: as typed, none of an
            argument. shown: in messages. file: what happens to a file: "read", "write", "appended" (may come later) or
            "folder" (is made). how: help and limits.
    """

    field: str
    hint: Any
    default: Any
    names: tuple[str, ...]
    shown: str
    file: str
    how: dict[str, Any]


@cache
def pages() -> dict[str, tuple[str, dict[str, str]]]:
    """Section of help.md -> its text, and field -> its entry."""
    found = {}
    for section in HELP.read_text(encoding="utf-8").split("\n# ")[1:]:
        name, _, body = section.partition("\n")
        text, *entries = re.split("^(?=[-*] )", body, flags=re.MULTILINE)
        found[name] = text.strip(), {re.split("[ :]", entry)[1]: " ".join(entry.split()) for entry in entries}
    return found


def options_in(group: Any) -> Iterator[Option]:
    """The options of a group, or of a command, and of the groups in it."""
    section = group.__name__.removesuffix("Options").lower()
    texts = pages()["shared"][1] | pages().get(section, ("", {}))[1]
    hints = get_type_hints(group, include_extras=True)
    for field in fields(group):
        hint, *more = get_args(hint) if get_origin(hint := hints[field.name]) is Annotated else (hint,)
        if is_dataclass(hint):
            yield from options_in(hint)
            continue
        head, _, text = texts[field.name].partition(": ")
        mark, _, *named = head.split(" ")
        long = f"--{field.name.replace('_', '-')}"
        names = () if mark == "*" else tuple(filter(None, (SHORT.get(field.name), long)))
        file = next((one for one in more if isinstance(one, str)), "read")
        how = {"help": text, "metavar": named[0] if named else None}
        how |= next((one for one in more if isinstance(one, dict)), {})
        yield Option(field.name, hint, field.default, names, named[0] if mark == "*" else names[0], file, how)


def has(hint: Any, part: Any) -> bool:
    """Whether a type, or a part of it, is this one."""
    return part in {hint, get_origin(hint)} or any(has(one, part) for one in get_args(hint))


def check_together(
    group: Any, given: Mapping[str, Any], needs: Mapping[str, str], beside: Mapping[str, str] | None = None
) -> None:
    """Refuse options of a group without those, separated by spaces, of which each needs one, or beside others."""
    typed = {one.shown for one in options_in(group) if given[one.field] not in (None, [], one.default)}
    for option, others in needs.items():
        if option in typed and not any(other in typed for other in others.split()):
            what = f"{option} without {' or '.join(others.split())}"
            raise InputError.of(what, fix="name this too, or leave the option out")
    for option, others in (beside or {}).items():
        for other in others.split():
            if option in typed and other in typed:
                raise InputError.of(f"{option} beside {other}", fix="leave one of them out")


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Options:
    """A group of options."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)


class Command(Options):
    """The options of a command; its work is ``run`` of the module of its name in ``commands``, which takes them.

    Attributes:
        needs: option -> those of which it needs one. beside: option -> those that it cannot stand beside.
    """

    needs: ClassVar[dict[str, str]] = {}
    beside: ClassVar[dict[str, str]] = {}

    def check(self) -> None:
        """Refuse options that cannot be meant."""

    @property
    def more_files(self) -> dict[str, Path]:
        """Files that are written beside those that options name."""
        return {}


# --- groups -----------------------------------------------------------------------------------------------------------


class Units(Options):
    length: Length | None = None
    angle: Angle | None = None
    joint_length: Length | None = None
    joints: Text = None
    robot_pose: Text = None
    sep: Text = None
    decimal: Text = None


class Places(Options):
    places: File = None
    by: Text = None


class Rows(Places):
    position: Texts = None
    socket: Text = None
    distance: Texts = None
    distance_std: float | None = None
    reading: Texts = None
    marker: Text = None
    session: Text = None
    remounted: bool = False
    payload: Text = None
    time: Text = None
    temperature: Text = None
    rotation: Texts = None
    convention: Text = None
    rotation_angle: Angle | None = None
    lever: float | None = None
    camera_on_tool: bool = False
    std: Text = None
    rotation_std: Texts = None

    @property
    def named(self) -> bool:
        """Whether columns of some kind of rows are named."""
        return bool(self.position or self.socket or self.reading)

    @property
    def images(self) -> bool:
        """Whether rows are images of a printed board."""
        return any(text.startswith(CORNERS) for text in self.reading or ())


class Links(Options):
    base: Text = None
    tip: Texts = None
    load: Texts = None
    dh_convention: Convention | None = None


class Robot(Options):
    links: Links
    robot: File = None


class Targets(Options):
    position: Texts = None
    rotation: Texts = None
    convention: Text = None
    rotation_angle: Angle | None = None


class Candidates(Options):
    candidates: File = None
    draw: Annotated[int | None, {"min": 1}] = None
    range: Texts = None
    tracker: Text = None
    floor: float | None = None
    column: Text = None
    collisions: bool = False
    seed: Seed = 0


class ChangeTests(Options):
    marker_freedom: Literal["evidence", "same", "moved", "other"] = "evidence"
    seed: Seed = 0


# --- commands ---------------------------------------------------------------------------------------------------------


class FitOptions(Command):
    csv: Path
    robot: Robot
    units: Units
    output: Output
    rows: Rows
    holdout: Annotated[float, {"min": 0.0, "max": 0.9}] = 0.3
    seed: Seed = 0
    controls: Annotated[int | None, {"min": 10}] = None
    figure: Written = None
    report: Written = None
    note: str = ""
    scales_of: list[Path] | None = None
    duplicates: str = "error"


class CampaignOptions(Command):
    csv: Annotated[Path, "appended"]
    robot: Robot
    units: Units
    rows: Rows
    target: Text = None
    stdin: bool = False
    json_lines: bool = False
    once: bool = False
    candidates: File = None
    page: Text = None
    next: Annotated[int, {"min": 0}] = 1
    accepted: Written = None


class RecordOptions(Command):
    bag: Path
    seen: str
    output: Output
    joints: str = "/joint_states"
    still: Annotated[float, {"min": 1e-9}] = 1e-3
    shortest: Annotated[float, {"min": 0.01}] = 0.5
    offset: float | None = None


class EvaluateOptions(Command):
    model: Path
    csv: Path
    units: Units
    rows: Rows
    register: bool = False
    free: Free | None = None
    output: Written = None
    fail_above: Text = None
    residuals: Written = None
    needs = dict.fromkeys(("--free", "-o"), "--register")
    beside = dict.fromkeys(("--fail-above", "--residuals"), "--register")


class InitOptions(Command):
    csv: Path
    places: Places
    robot: File = None
    output: Output = Path("campaign.toml")
    force: bool = False


class ImagesOptions(Command):
    folders: list[Path]
    joints: Path
    board: str
    length: Length
    output: Output
    board_std: float = 1e-3
    overview: Written = None
    sep: str = ","
    decimal: str = "."


class PredictOptions(Command):
    model: Path
    csv: Path
    units: Units
    output: Output
    convention: Text = None
    rotation_angle: Angle | None = None
    payload: Text = None


class CorrectOptions(Command):
    model: Path
    program: Path
    units: Units
    output: Output
    targets: Targets
    tip: Texts = None
    tool: Texts = None
    tool_from: ToolFrom = "tip"
    frame: Frame = "base"
    limit: float | None = None
    rate: float | None = None
    payload_mass: float | None = None


class ExportOptions(Command):
    model: Path
    urdf: Written = None
    mjcf: Written = None
    dh: Written = None
    dh_convention: Convention = "standard"
    ur_kinematics: Written = None
    ur_hash: Text = None
    joint_offsets: Written = None
    correction_tables: Written = None
    with_tables: bool = False
    c: Written = None
    torch: Written = None
    onnx: Written = None
    field: Written = None
    grid: str = "5x5x5"
    camera: Annotated[Path | None, "folder"] = None
    tool: Text = None
    tool_from: ToolFrom = "tip"
    frame: Frame | None = None
    tip: Text = None
    robot: File = None
    payload_mass: float | None = None
    length: Length = "m"
    angle: Angle = "rad"
    needs = dict.fromkeys(("--tool", "--frame"), "--c --torch --onnx") | {
        "--with-tables": "--urdf --mjcf --dh --ur-kinematics",
        "--ur-hash": "--ur-kinematics",
        "--tip": "--c --dh",
    }

    @property
    def outputs(self) -> dict[str, Path]:
        """Option -> file to write, of those that are wanted."""
        files = {one.shown: getattr(self, one.field) for one in options_in(ExportOptions) if one.file != "read"}
        return {option: path for option, path in files.items() if path is not None}

    @property
    def more_files(self) -> dict[str, Path]:
        """The header of C."""
        return {} if self.c is None else {"--c (its header)": self.c.with_suffix(".h")}

    def check(self) -> None:
        """Refuse to write nothing."""
        if not self.outputs:
            files = ", ".join(one.shown for one in options_in(ExportOptions) if one.file != "read")
            raise typer.BadParameter(f"name at least one file to write: {files}")
        if self.with_tables and self.correction_tables is None:
            raise InputError.of("--with-tables without --correction-tables", fix="name both, or none")


class PlanOptions(Command):
    count: Annotated[int, {"min": 1}]
    units: Units
    output: Output
    cell: Candidates
    links: Links
    model: File = None
    robot: File = None
    marker: Texts = None
    target_poses: File = None
    measured: File = None
    free: Free | None = None
    sensor: Texts = None
    payload_mass: float | None = None
    needs = dict.fromkeys(("--payload-mass", "--free"), "MODEL")
    beside = dict.fromkeys(("--robot", "--base", "--tip", "--load", "--dh-convention", "--marker"), "MODEL")
    beside |= dict.fromkeys(("--draw", "--range", "--tracker", "--floor", "--column", "--collisions"), "--candidates")

    def check(self) -> None:
        """Refuse to plan for nothing."""
        if self.model is None and self.robot is None:
            raise InputError.of("what to plan for", expected="a MODEL, or --robot", got="neither")


class RecalibrateOptions(Command):
    old: Path
    csv: Path
    units: Units
    output: Output
    rows: Rows
    tests: ChangeTests
    drift: Literal["tested", "none"] = "tested"
    note: str = ""


class CompareOptions(Command):
    old: Path
    other: Path
    units: Units
    rows: Rows
    tests: ChangeTests


class ReportOptions(Command):
    model: Path
    output: Output
    units: Units
    rows: Rows
    data: File = None
    against: Texts = None
    tolerance: Text = None
    needs = dict.fromkeys(("--position", "--socket", "--reading", "--length", "--angle", "--against"), "--data")


class DemoOptions(Command):
    output: Annotated[Path, "folder"] = Path("demo_output")
    rows: Annotated[int, {"min": 20}] = 300
    seed: Seed = 0


COMMANDS = {own.__name__.removesuffix("Options").lower(): own for own in Command.__subclasses__()}
"""By name, in the order of the help."""
