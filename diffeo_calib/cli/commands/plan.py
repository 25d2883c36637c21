"""`diffeo-calib plan`: choose poses, write them, and say what to expect of how many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import isfinite, pi, radians
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from diffeo_calib.calibration.planning.candidates import Tracker, candidates
from diffeo_calib.calibration.planning.collisions import collision_free
from diffeo_calib.calibration.planning.plan import Plan, plan, sensors_for
from diffeo_calib.calibration.planning.sensors import Sensor
from diffeo_calib.calibration.planning.starts import MARKER
from diffeo_calib.cli.console import exit_on_interrupt, out, progress_bar, say
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.options.plan import FACING_HALF_ANGLE_DEG
from diffeo_calib.cli.options.shared import Free
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables.positions import joint_columns, table_format
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import load_urdf
from diffeo_calib.sensors.range import UNKNOWN_ZERO_M

SENSORS = {
    "distance": Sensor.distances,
    "displacement": partial(Sensor.distances, offset_std=UNKNOWN_ZERO_M),
    "height": Sensor.heights,
    "image": Sensor.images,
    "socket": Sensor.sockets,
}
"""Devices, by the words of --sensor."""
TRACKERS = {"tracker": Sensor.positions, "poses": Sensor.poses}


def sensors_of(words: list[str] | None, table: TableFormat) -> list[Sensor]:
    """What --sensor says; nothing if it was not given."""
    numbers: dict[str, list[list[float]]] = {}
    found = []
    for text in words or ():
        kind, _, values = text.partition("=")
        if text in TRACKERS:
            found.append(TRACKERS[text]())
        elif kind in SENSORS and values:
            numbers.setdefault(kind, []).append([x / table.per_metre for x in _numbers("--sensor", values, (3, 4, 6))])
        else:
            expected = f"{', '.join(TRACKERS)}, or {', '.join(f'{kind}=NUMBERS' for kind in SENSORS)}"
            raise InputError.of(f"--sensor {text}", expected=expected)
    return [*found, *(SENSORS[kind](places) for kind, places in numbers.items())]


@dataclass(frozen=True)
class Source:
    """What is planned for: a model file, or a chain in a URDF with markers on its tip."""

    model: Path | None
    urdf: Path | None
    base: str
    tips: list[str]
    markers: list[str] | None
    payload: float | None

    def read(self, table: TableFormat) -> tuple[Tree | CalibratedKinematics, Tensor]:
        """The robot or the model, and its markers (P, 3) in the frame of the tip, m."""
        if self.model is not None:
            model = load_kinematics(self.model)
            for line in provenance_lines(model):
                say(line)
            if self.payload is not None:
                model = model.with_payload(self.payload)
            elif model.payload is not None:
                say(f"planned with a payload of {model.payload:g}, the median of the fit; --payload for another one")
            return model, model.geometry.tool
        robot = load_urdf(self.urdf or "", self.base, self.tips[0] if len(self.tips) == 1 else self.tips)
        given = [_numbers("--marker", text, (3,)) for text in self.markers or ()]
        places = torch.tensor(given or [MARKER], dtype=torch.float64, device=HOST)
        return robot, places / table.per_metre if given else places


@dataclass(frozen=True)
class Cell:
    """What random configurations have to respect, as the options say it."""

    limits: list[str] | None
    tracker: str | None
    facing: str | None
    cone: float | None
    floor: float | None
    column: str | None
    collisions: bool

    def __post_init__(self) -> None:
        if self.tracker is None and not (self.facing is None and self.cone is None):
            raise InputError.of("--facing and --cone belong to --tracker", fix="add --tracker, or leave them out")

    def draw(
        self, robot: Tree, marker: Tensor, count: int, seed: int, places: Tensor | None, table: TableFormat
    ) -> Tensor:
        """Random configurations (count, n), rad or m."""
        scale = table.per_metre
        tracker = None
        if self.tracker is not None:
            position = [x / scale for x in _numbers("--tracker", self.tracker, (3,))]
            direction = _numbers("--facing", self.facing or "0,0,1", (3,))
            cone = FACING_HALF_ANGLE_DEG if self.cone is None else self.cone
            tracker = Tracker(position, marker.tolist(), direction, radians(cone))
        column = None
        if self.column is not None:
            column = [x / scale for x in _numbers("--column", self.column, (3, 4))]
        return candidates(
            robot,
            count,
            ranges=self._ranges(robot, table),
            keep=collision_free(robot) if self.collisions else None,
            tracker=tracker,
            floor=None if self.floor is None else self.floor / scale,
            column=column,
            places=places,
            ball=marker,
            seed=seed,
        )

    def _ranges(self, robot: Tree, table: TableFormat) -> dict[str, list[float]]:
        """Name of a joint -> its range, rad or m."""
        turns = dict(zip(robot.joint_names, robot.periodic, strict=True))
        found = {}
        for text in self.limits or ():
            name, _, ends = text.rpartition("=")
            if not name or ends.count(":") != 1:
                raise InputError.of(f"--range {text}", expected="JOINT=A:B, such as joint_1=-90:90")
            numbers = _numbers("--range", ends.replace(":", ","), (2,))
            unit = 1 / table.joints_per_metre if not turns.get(name, True) else 1.0
            found[name] = [x * (pi / 180 if turns.get(name) and table.angle == "deg" else unit) for x in numbers]
        return found


@dataclass(frozen=True)
class Rows:
    """Tables of configurations, and the format of all tables."""

    candidates: Path | None
    target: Path | None
    measured: Path | None
    joints: str | None
    table: TableFormat

    @classmethod
    def of(cls, form: tuple[Any, ...], *files: Any) -> Rows:
        """Those of the command: ``form`` as of :func:`table_format`, and the other arguments of the class."""
        return cls(*files, table_format(*form))

    def read(self, path: Path | None, robot: Tree) -> Tensor | None:
        """Configurations (N, n), rad or m; None without a table."""
        if path is None:
            return None
        return read_joints(path, joint_columns(self.joints, robot), self.table, kinds=robot.kinds)


@dataclass(frozen=True)
class Wanted:
    """What to plan: the file, numbers of poses and of random candidates, their seed, what has moved, what measures."""

    output: Path
    count: int
    drawn: int
    seed: int
    free: Free | None
    sensor: list[str] | None


def run(source: Source, cell: Cell, rows: Rows, wanted: Wanted) -> None:
    """Plan, write the poses, and print what to expect of them."""
    with exit_on_interrupt(), progress_bar() as progress:
        given, markers = source.read(rows.table)
        robot = given.robot if isinstance(given, CalibratedKinematics) else given
        sensors = sensors_of(wanted.sensor, rows.table) or sensors_for(given)
        progress("candidates", 0, 1)
        q = rows.read(rows.candidates, robot)
        if q is None:
            q = _drawn(given, sensors, markers, max(wanted.drawn, wanted.count), (cell, rows.table, wanted.seed))
        progress("candidates", 1, 1)
        progress("plan", 0, 1)
        framed = isinstance(given, CalibratedKinematics) or any(one.of_frames for one in sensors)
        found = plan(
            given,
            q,
            wanted.count,
            target=rows.read(rows.target, robot),
            marker=None if framed else markers,
            measured=rows.read(rows.measured, robot),
            free=None if wanted.free is None else wanted.free.value,
            sensor=sensors,
        )
    found.write(wanted.output, rows.table, joint_columns(rows.joints, robot))
    entries = {"expected_rms_m": found.expected_rms, "noise_rms_m": found.noise_rms, "assumed": found.assumed}
    record.add(rows=wanted.count, **entries, files={"poses": wanted.output})
    _show(found, of_positions=all(one.of_positions for one in sensors))
    say(f"{wanted.count} of {len(q)} configurations written to {wanted.output}, in an order of short moves")
    say("its column `rank`: the poses of ranks 1 to k are the plan for k poses")
    if found.devices:
        say("its column `device`: what measures the pose")
        for line in [line for one in sensors for line in one.sentences()]:
            say(line)


def _drawn(
    given: Tree | CalibratedKinematics,
    sensors: Sequence[Sensor],
    markers: Tensor,
    count: int,
    how: tuple[Cell, TableFormat, int],
) -> Tensor:
    """Random configurations, shared by sensors that need the ball in their sockets and those that do not."""
    cell, table, seed = how
    robot, base = given, torch.eye(4, dtype=torch.float64, device=HOST)
    if isinstance(given, CalibratedKinematics):
        robot, base = given.robot, given.geometry.base
    parts = [one.places_in(base) for one in sensors]
    anywhere = sum(places is None for places in parts)
    sockets = [places for places in parts if places is not None]
    found = []
    if anywhere:
        found.append(cell.draw(robot, markers.mean(0), -(-count * anywhere // len(parts)), seed, None, table))
    if sockets:
        share, places = -(-count * len(sockets) // len(parts)), torch.cat(sockets)
        found.append(cell.draw(robot, markers[-1], share, seed, places, table))
    return torch.cat(found)


def _show(found: Plan, *, of_positions: bool) -> None:
    """Print the expected errors by number of poses.

    Args:
        found: the plan. of_positions: whether held-out errors of the planned poses are errors of positions.
    """
    more = "" if found.assumed else " more"
    title = f"Expected RMS error in mm by number of{more} poses"
    table = Table(title=title, title_justify="left", min_width=len(title))
    for column in (f"{more} poses".strip(), "model", *["held out"] * of_positions):
        table.add_column(column, justify="right")
    for count in (*[0] * (not found.assumed), *found.counts):
        rms = 1e3 * float(found.expected_rms[count])
        with_noise = (rms**2 + (1e3 * found.noise_rms) ** 2) ** 0.5
        table.add_row(str(count), f"{rms:.3f}", *[f"{with_noise:.3f}"] * of_positions)
    out.print(table)
    if of_positions:
        say("held out: with the noise of one measurement, as `fit` and `evaluate` show it")
    if found.assumed:
        say(f"{found.caution}: measure the first 20 poses, fit them, and plan the next with the model")


def _numbers(option: str, text: str, counts: tuple[int, ...]) -> list[float]:
    """Numbers separated by commas.

    Raises:
        InputError: another number of numbers.
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts or not all(isfinite(value) for value in values):
        expected = f"{' or '.join(map(str, counts))} numbers, separated by {'a colon' if 2 in counts else 'commas'}"
        raise InputError.of(f"{option} {text}", expected=expected, fix="write decimal points in numbers")
    return values
