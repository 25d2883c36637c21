"""From the options of a command, or of that which made a model, to the table that they describe. Imports torch."""

from __future__ import annotations

import shlex
from collections.abc import Container, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import typer
from torch import Tensor

from diffeo_calib.cameras.files import read_camera
from diffeo_calib.cli.console import say
from diffeo_calib.cli.main import add_to_command_line
from diffeo_calib.cli.options import CORNERS, Rows, Targets, Units, has
from diffeo_calib.common.errors import InputError, MeasurementError, few, sentence, shown, warn_user
from diffeo_calib.common.files import PROGRAM
from diffeo_calib.measurements.csv.cells import number
from diffeo_calib.measurements.csv.columns import PoseColumns
from diffeo_calib.measurements.csv.files import read_observations
from diffeo_calib.measurements.csv.joined import HeldFile, joined_file
from diffeo_calib.measurements.csv.lines import CsvLines, read_cells
from diffeo_calib.measurements.csv.sensors import ImageColumns, ReadingColumns, SocketColumns, columns_of
from diffeo_calib.measurements.poses import by_frame
from diffeo_calib.measurements.table_format import BESIDE, LEVER, SPHERICAL, TableFormat
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.kinds import known_kinds
from diffeo_calib.sensors.range import UNKNOWN_ZERO_M

POSE_JOINTS = 6
Given = TypeVar("Given", bound=Units)


def table_format(units: Units) -> TableFormat:
    """The format of a table of points; the separator may be a tab written as \\t or tab.

    InputError for a unit that is neither typed nor kept with the model.
    """
    length, angle, pose = units.length, units.angle, units.robot_pose
    if angle is None and pose is not None and "=" not in pose:
        angle = "deg"  # commanded places have no angles: it is that of what is printed
    if length is None or angle is None:
        missing = " and ".join(f"--{name}" for name in ("length", "angle") if getattr(units, name) is None)
        fix = "state the units of the table; a model that `fit` made knows those of its own"
        raise InputError.of(f"{missing} missing", fix=fix)
    sep = "," if units.sep is None else "\t" if units.sep in ("\\t", "tab") else units.sep
    decimal, joints = "." if units.decimal is None else units.decimal, _split_names(units.joints or "")
    if units.robot_pose is not None and units.joints is not None:
        fix = "name the columns of the pose, or those of the joints"
        raise InputError.of("--joints beside --robot-pose", expected="one of them", got="both", fix=fix)
    columns = PoseColumns.of(units.robot_pose) if units.robot_pose is not None else joints if any(joints) else ()
    return TableFormat(length, angle, sep, decimal, joint_length=units.joint_length, joints=columns)


def with_rows(table: TableFormat, rows: Rows) -> TableFormat:
    """Add the columns that options name, but for readings; lever in the unit of length."""
    Rows.check_together(vars(rows))
    as_typed = "convention", "rotation_angle", "remounted", "session", "marker", *BESIDE
    places = [_place(text) for text in rows.position or ()]
    if len(ways := dict.fromkeys(way for way, _ in places)) > 1:
        got, fix = " and ".join(way or "x, y and z" for way in ways), "convert those of one device"
        raise InputError.of("--position", expected="places that are all written in one way", got=got, fix=fix)
    return replace(
        table,
        **{name: getattr(rows, name) for name in as_typed},
        position=[_split_names(columns) for _, columns in places] or None,
        spherical=next(iter(ways), None),
        rotation=_names_of_each(rows.rotation),
        lever=LEVER if rows.lever is None else rows.lever / table.per_metre,
        camera_on_tool=rows.camera_on_tool and not rows.images,
        std=None if rows.std is None else _split_names(rows.std),
        rotation_std=_names_of_each(rows.rotation_std),
        sockets=None if rows.socket is None else socket_columns(rows.socket, rows, table),
    )


def measured_table(csv: Path, rows: Rows, duplicates: str = "keep") -> MeasuredTable:
    """The table that options describe, joined of two files if these do; exact repeats are kept by default."""
    if not rows.named:
        text = "name the position columns, or those of --socket or --reading"
        raise typer.BadParameter(text, param_hint="--position")
    table, names = table_format(rows), list[str]()
    csv = with_places(csv, rows, table)
    if isinstance(csv, HeldFile):
        say(csv.sentence)
    if csv.is_file() and any(_number(text.partition("=")[2]) is not None for text in rows.reading or ()):
        with suppress(MeasurementError):  # rows may come later
            names = CsvLines(csv, table.sep).header
    return MeasuredTable(csv, described(rows, names), duplicates)


def described(rows: Rows, names: Sequence[str] = ()) -> TableFormat:
    """The format of a table that options describe; ``names`` of its columns, as of :func:`readings_columns`."""
    table = with_rows(table_format(rows), rows)
    return replace(table, readings=readings_columns(rows.reading or (), rows, names))


def with_places(csv: Path, rows: Rows, table: TableFormat) -> Path:
    """The table, joined with that of the measured places if there is one."""
    if rows.places is None or rows.by is None:
        return csv
    return joined_file(csv, rows.places, rows.by, table.sep, table.decimal, several=rows.marker is not None)


# --- as at the fit ------------------------------------------------------------------------------------------------


def as_at_the_fit(command: str, given: Given, csv: Path | None = None) -> Given:
    """Options of a later command, completed by those of the command line that made its model; typed ones win.

    Columns are taken over unless --position, --socket or --reading are typed, and units, marks and names of joints
    unless both --length and --angle are. Marks are then those of the fit too if the file has more columns with them.
    command: that made the model, or the options of its table alone; empty where neither is known. csv: the file.
    """
    wanted, marker = given.left_open(), given.marker if isinstance(given, Rows) else None
    wanted -= {name for name, value in vars(given).items() if value}
    if csv is not None and csv.is_file() and not given.sep and "sep" not in wanted:
        wanted |= _marks_of_fit(command, given, csv)
    try:
        stored = shlex.split(command) if wanted or marker else []
        if marker is not None and "=" not in marker:
            order = _stated(stored, {"marker"}).get("marker", ("", []))[0].partition("=")[1:]
            given = replace(given, marker=marker + "".join(order))
            add_to_command_line(["--marker", marker + "".join(order)])
        stated = _stated(stored, wanted)
    except (ValueError, IndexError) as error:  # of a file that was edited
        fix = "name the columns (--position, --socket, --reading), --length and --angle"
        raise InputError.of("the options that the model was fitted with", got=shown(str(error)), fix=fix) from error
    pose = given.robot_pose
    program = _stated(shlex.split(command), {"robot_pose"}).get("robot_pose", ("", []))[0] if PROGRAM in command else ""
    if PROGRAM in program and pose in (None, program.partition("=")[0]):  # of other names: places
        fix = f"type it again, a model file starts no program: --robot-pose {program}"
        raise InputError.of("--robot-pose", expected="the function that the model was fitted with", fix=fix)
    order = sorted(stated, key=lambda name: name in Units.names())
    if words := [word for name in order for word in stated[name][1]]:
        say(f"tables are read as at the fit: {shlex.join(words)}")
    add_to_command_line(words)
    return replace(given, **{name: value for name, (value, _) in stated.items()})


def _marks_of_fit(command: str, given: Units, csv: Path) -> set[str]:
    """Names of the marks that a file shares with the table of the fit: it has more columns with them."""
    with suppress(ValueError, IndexError, InputError):
        marks = _stated(shlex.split(command), {"sep"} if given.decimal else {"sep", "decimal"})
        like = replace(given, **{name: value for name, (value, _) in marks.items()})
        widths = [len(CsvLines(csv, table_format(units).sep).header) for units in (given, like)]
        return {*marks} if widths[1] > widths[0] else set()
    return set()


def rows_in_table(csv: Path, rows: Rows) -> tuple[Rows, list[str]]:
    """Options without the kinds of rows that a table has no column of, if it has those of others; and these kinds."""
    table = table_format(rows)
    header = set(read_cells(with_places(csv, rows, table), table.sep)[0])
    kinds = {
        "--position": [_place(text)[1] for text in rows.position or ()],
        "--socket": [rows.socket] * (rows.socket is not None),
    }
    kinds |= {f"--reading {text}": [text.partition("=")[2]] for text in rows.reading or () if CORNERS not in text}
    named = {kind: {name.strip() for text in texts for name in text.split(",")} for kind, texts in kinds.items()}
    there = {kind: bool(names & header) for kind, names in named.items() if names}
    if all(there.values()) or not any(there.values()):
        return rows, []
    missing = [kind for kind, has in there.items() if not has]
    changes: dict[str, Any] = {} if rows.session in header else {"session": None, "remounted": False}
    if "--position" in missing:
        changes |= {"position": None, "std": None, "rotation": None, "rotation_std": None}
    if "--socket" in missing:
        changes |= {"socket": None, "distance": None, "distance_std": None}
    kept = [text for text in rows.reading or () if f"--reading {text}" not in missing]
    return replace(rows, reading=kept or None, **changes), missing


def _stated(words: Sequence[str], wanted: Container[str]) -> dict[str, tuple[Any, list[str]]]:
    """Name of a wanted option of tables -> its value in a command line, and the words that state it.

    ValueError or IndexError for a value that is none.
    """
    stated = dict[str, tuple[Any, list[str]]]()
    for option in (entry for entry in Rows.all() if entry.field in wanted):
        name, hint, given = option.shown, option.hint, list[list[str]]()
        for place, word in enumerate(words):
            begin, equal, value = word.partition("=")
            if begin == name:
                given.append([name] if hint is bool else [name, value if equal else words[place + 1]])
        given = given if has(hint, list) else given[-1:]
        texts = [group[-1] for group in given]
        allowed = next((get_args(part) for part in (hint, *get_args(hint)) if get_origin(part) is Literal), texts)
        if wrong := [text for text in texts if text not in allowed]:
            raise ValueError(f"'{wrong[0]}' for {name}")
        if given:
            values = [float(text) for text in texts] if has(hint, float) else texts
            value = True if hint is bool else values if has(hint, list) else values[-1]
            stated[option.field] = value, [word for group in given for word in group]
    return stated


# --- tables -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MeasuredTable:
    """A table of measurements as the options describe it."""

    csv: Path
    table: TableFormat  # what it holds; without joints they are named after the robot's
    duplicates: str = "keep"  # what to do with exactly repeated rows
    growing: bool = False  # whether rows will be added

    def read(self, robot: Tree, tips: Sequence[str] = ()) -> Any:
        """The rows, with warnings of copies; later tables of the model have the same order of markers."""
        data = self.rows(robot, tips)
        if not self.growing:
            data.warn_of_copies()
        given = self.table
        named: Any = given.marker and data.origin.columns.table.marker
        if given.marker != named:
            say(f"markers: {', '.join(data.marker_names)}, numbered from 0 in this order")
            add_to_command_line(["--marker", named])
        return data

    def rows(self, robot: Tree, tips: Sequence[str] = ()) -> Any:
        """The rows of a robot, under the names of its own joints, as of :func:`read_observations`.

        ``tips`` are those of every marker, for a robot with several; none where a model knows them.
        """
        given, triples = self.table, self.table.position
        several = bool(tips) and max(len(tips), len(robot.tips)) > 1 and given.sockets is None and not given.readings
        if several and triples is not None and len(tips) != len(triples):
            expected, fix = f"{len(triples)}, one for each --position", "repeat a tip that carries several markers"
            raise InputError.of("--tip", expected=expected, got=len(tips), fix=fix)
        session = given.session if triples or not given.readings else None  # of readings it names their devices
        table = replace(of_robot(given, robot), session=session)
        data = read_observations(self.csv, table, duplicates=self.duplicates, growing=self.growing)
        data = data.with_joint_names(robot.joint_names)
        return data.with_tips(tips) if several else data

    def warn_of_other_frames(self, count: int) -> None:
        """Warn of rows of the fit that are judged in a frame in which they were not measured."""
        if count and self.table.session is None:
            what = f"{count} rows of the fit, of another set-up than the model's, are judged in the model's frame"
            warn_user(sentence(what, fix="name the column of the set-ups (--session), or leave these rows out"))


def targets_of(path: Path, table: TableFormat, given: Targets, tools: int) -> Tensor | None:
    """(N, T, 4, 4) poses or (N, T, 3) positions of T tools, m, in a program; None if its columns hold none."""
    position, rotation = given.position, given.rotation
    if not position:
        if rotation:
            raise InputError.of("--rotation without --position", fix="name the columns of the position too")
        return None
    if len(position) != tools:
        fix = "name the columns of the targets once for every --tip"
        raise InputError.of("--position", expected=f"{tools} of them", got=len(position), fix=fix)
    turned = Rows(rotation=rotation, convention=given.convention, rotation_angle=given.rotation_angle)
    table = with_rows(table, turned) if rotation else table
    table = replace(table, position=[_split_names(text) for text in position])
    data = read_observations(path, table, duplicates="keep", growing=True)  # 0, 0, 0 is a target
    lines = [line for line, _ in read_cells(path, table.sep, columns_of(table).names)[1]]
    if len(data) < len(lines):
        what = f"file '{path}', line {few(sorted({*lines} - {*data.line_numbers.tolist()}))}"
        raise InputError.of(what, expected="a target", got="empty cells", fix="fill them in, or remove the lines")
    return data.points if data.poses is None else by_frame(data.poses)


def of_robot(table: TableFormat, robot: Tree) -> TableFormat:
    """Name the joints of a robot, in columns that it names, or else after them; or with its poses."""
    joints, defaults = table.joints, list(robot.joint_names)
    if isinstance(joints, PoseColumns):
        count = robot.n if joints.is_program else len(joints.columns) if not joints.convention else POSE_JOINTS
        if not is_cartesian(robot) or robot.n != count:
            expected = f"the {robot.n} joint values of robot '{robot.name}'"
            raise InputError.of(f"--robot-pose {','.join(joints.columns)}", expected=expected, got="other inputs")
        return replace(table, joints=replace(joints, robot=robot), kinds=robot.kinds)
    names, order = list(joints) or defaults, ",".join(defaults)
    if names != defaults and sorted(names) == sorted(defaults):
        fix = "leave it out: columns that are named after the joints are found wherever they are"
        raise InputError.of("--joints in another order", expected=order, got=",".join(names), fix=fix)
    if len(names) != robot.n:
        expected = f"{robot.n} columns, in the order {order.replace(',', ', ')}"
        raise InputError.of(f"--joints {','.join(names)}", expected=expected, got=len(names))
    return replace(table, joints=names, kinds=robot.kinds)


def as_written(table: TableFormat) -> TableFormat:
    """Name the columns in which joints, or the poses of a machine, are written."""
    joints = table.joints
    return replace(table, joints=joints.written) if isinstance(joints, PoseColumns) else table


def with_rotation(table: TableFormat, given: Targets) -> TableFormat:
    """The format of poses that are written: as targets are, by default as commanded poses, else a rotation vector."""
    convention, angle, joints = given.convention, given.rotation_angle, table.joints
    if convention is None and isinstance(joints, PoseColumns) and not joints.is_program:
        convention, angle = joints.convention or None, angle or table.angle
    return replace(table, convention=convention, rotation_angle=angle).for_writing(rotation_std=False)


def _place(text: str) -> tuple[str | None, str]:
    """How a place is a distance and two angles, None for x, y and z; and its columns."""
    way, _, columns = text.partition("=")
    return (way, columns) if way in SPHERICAL else (None, text)


def _split_names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _names_of_each(texts: list[str] | None) -> list[str] | list[list[str]] | None:
    """Names for the only frame, or a list for each of several."""
    names = [_split_names(text) for text in texts or ()]
    return (names[0] if len(names) == 1 else names) or None


def socket_columns(socket: str, rows: Rows, table: TableFormat) -> SocketColumns:
    """The options of sockets in SI units."""
    lengths, std = dict[tuple[str, str], float](), rows.distance_std
    for text in rows.distance or ():
        pair, _, length = text.rpartition("=")
        names, value = _split_names(pair), _number(length) or 0.0
        if len(names) != 2 or value <= 0.0:
            fix = "write two names of sockets and a length, such as 0,1=50 or front/0,front/1=50"
            raise InputError.of(f"--distance {text}", expected="A,B=LENGTH", fix=fix)
        lengths[names[0], names[1]] = value / table.per_metre
    return SocketColumns(tuple(_split_names(socket)), lengths or None, None if std is None else std / table.per_metre)


def readings_columns(texts: Sequence[str], rows: Rows, names: Sequence[str] = ()) -> tuple[Any, ...]:
    """The columns of every kind of reading; those of images are of one kind, whatever number of cameras took them.

    A number that is one of the ``names`` of columns is that column, others are the length of a ball bar.
    """
    corners = [text for text in texts if text.startswith(CORNERS)]
    others = [reading_columns(text, rows.session, names) for text in texts if text not in corners]
    return (*([image_columns(corners, rows)] if corners else []), *others)


def image_columns(texts: Sequence[str], rows: Rows) -> ImageColumns:
    """corners=CAMERA.yaml, or corners=WIDTH,HEIGHT of images by an unknown camera, as columns.

    Of several cameras each has a file, whose name without .yaml is that of the camera in the table.
    """
    names = [text.removeprefix(CORNERS).strip() for text in texts]
    if len(names) == 1:
        width, _, height = names[0].partition(",")
        sized = width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0
        camera = (int(width), int(height)) if sized else read_camera(names[0])
        return ImageColumns(camera, rows.camera_on_tool, rows.session)
    cameras = {Path(name).stem: read_camera(name) for name in names}
    if len(cameras) < len(names):
        fix = "name the file of each camera after the camera in the table, such as left.yaml"
        raise InputError.of("--reading corners=", expected="a file for each camera", got=few(names), fix=fix)
    return ImageColumns(cameras, rows.camera_on_tool, rows.session)


def reading_columns(text: str, device: str | None, names: Sequence[str] = ()) -> ReadingColumns:
    """KIND=COLUMN as columns; images have two, and the four numbers of their cameras. ``names``: of all columns."""
    word, _, rest = text.partition("=")
    first, *others = words = tuple(_split_names(rest))
    kind = next((kind for kind in known_kinds().values() if word in kind.columns()), None)
    if word == "image" and len(words) == 6 and all(words[:2]):
        fx, fy, cx, cy = map(_number, words[2:])
        if fx and fy and cx is not None and cy is not None and min(fx, fy) > 0.0:
            return ReadingColumns("image", words[:2], device, intrinsics=(fx, fy, cx, cy))
    elif kind is not None and len(words) == kind.numbers_each and all(words):
        value = None if others or first in names else _number(first)
        if word == "distance" and value is not None and value <= 0.0:
            fix = "write the length of the ball bar in the unit of --length, or name a column"
            raise InputError.of(f"--reading {text}", expected="a distance above 0", fix=fix)
        zero = UNKNOWN_ZERO_M * (word == "displacement")
        return ReadingColumns(kind.kind, words if value is None else value, device, zero, unit=kind.unit)
    expected = "distance=COLUMN, displacement=COLUMN, height=COLUMN, image=U,V,FX,FY,CX,CY or corners=FILE"
    raise InputError.of(f"--reading {text}", expected=expected, fix="focal lengths FX, FY are positive pixels")


def _number(text: str) -> float | None:
    """A finite number; None for the name of a column."""
    value = number(text.strip(), ".")
    return value if value is not None and isfinite(value) else None


def stated_numbers(option: str, text: str, counts: Sequence[int], expected: str = "") -> list[float]:
    """Numbers separated by commas; InputError unless there are so many."""
    values = [value for word in text.split(",") if (value := _number(word)) is not None]
    if len(values) not in counts or len(values) <= text.count(","):
        usual = f"{' or '.join(map(str, counts))} numbers, separated by {'a colon' if 2 in counts else 'commas'}"
        raise InputError.of(f"{option} {text}", expected=expected or usual, fix="write decimal points in numbers")
    return values
