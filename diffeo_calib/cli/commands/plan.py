"""`diffeo-calib plan`: choose poses, write them, and say what to expect of how many."""

from __future__ import annotations

from functools import partial
from math import pi, radians
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.planning.candidates import Tracker, collision_free
from diffeo_calib.calibration.planning.plan import Plan, drawn, plan
from diffeo_calib.calibration.planning.scene import MARKER
from diffeo_calib.calibration.planning.sensors import Sensor, sensors_for
from diffeo_calib.cli.console import out, progress_bar, record, say, text_table
from diffeo_calib.cli.declarations import PlanOptions
from diffeo_calib.cli.models import as_fitted, expectation_lines, load_kinematics, load_robot, planned
from diffeo_calib.cli.options import DRAWN, Candidates
from diffeo_calib.cli.tables import as_written, of_robot, stated_numbers, table_format
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.csv.columns import PoseColumns
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.cartesian import SLIDES
from diffeo_calib.robots.tree import Tree
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
    """The sensors of --sensor; none if it was not given."""
    numbers: dict[str, list[list[float]]] = {}
    sensors = []
    for text in words or ():
        kind, _, values = text.partition("=")
        if text in TRACKERS:
            sensors.append(TRACKERS[text]())
        elif kind in SENSORS and values:
            each = stated_numbers("--sensor", values, (3, 4, 6))
            numbers.setdefault(kind, []).append([x / table.per_metre for x in each])
        else:
            expected = f"{', '.join(TRACKERS)}, or {', '.join(f'{kind}=NUMBERS' for kind in SENSORS)}"
            raise InputError.of(f"--sensor {text}", expected=expected)
    return [*sensors, *(SENSORS[kind](places) for kind, places in numbers.items())]


def run(given: PlanOptions) -> None:
    """Plan, write the poses, and print what to expect of them."""
    count, output, begin = given.count, given.output, given.model or given.robot
    if begin is None:
        raise InputError.of("what to plan for", expected="a MODEL, or --robot", got="neither")
    with progress_bar() as progress:
        model = None if given.model is None else load_kinematics(given.model)
        table = table_format(given if model is None else as_fitted(model, given))
        numbers = [stated_numbers("--marker", text, (3,)) for text in given.marker or ()]
        markers = torch.tensor(numbers or [MARKER], dtype=torch.float64, device=HOST)
        markers = markers / table.per_metre if numbers else markers
        source = model or load_robot(begin, given)
        if model is not None:
            source, markers = planned(model, given.payload)
        robot = source.robot if isinstance(source, CalibratedKinematics) else source
        table = of_robot(table, robot)

        def configurations(table_of: Path | None) -> Tensor | None:
            return None if table_of is None else read_joints(table_of, table)

        sensors = sensors_of(given.sensor, table) or sensors_for(source)
        progress("candidates", 0, 1)
        q = configurations(given.candidates)
        if q is None:
            q = drawn(source, sensors, max(given.draw or DRAWN, count), markers, **_cell(given, robot, table))
        progress("candidates", 1, 1)
        progress("plan", 0, 1)
        framed = model is not None or any(sensor.of_frames for sensor in sensors)
        target, measured = configurations(given.target_poses), configurations(given.measured)
        how: dict[str, Any] = {"marker": None if framed else markers, "free": given.free, "sensor": sensors}
        proposal = plan(source, q, count, target=target, measured=measured, **how)
    proposal.write(output, as_written(table))
    entries = {"expected_rms_m": proposal.expected_rms, "noise_rms_m": proposal.noise_rms, "assumed": proposal.assumed}
    record.add(rows=count, **entries, files={"poses": output})
    _show(proposal, of_positions=all(sensor.of_positions for sensor in sensors), free=MOVED.get(given.free or ""))
    if isinstance(source, CalibratedKinematics):
        say("the table averages over the poses that were drawn or given; they may lie beyond those of the fit")
        say(*expectation_lines(source, None))
    if isinstance(table.joints, PoseColumns) and given.candidates is None:
        say("poses are drawn around those of the fit: pass --candidates where the machine, or the view, is smaller")
    say(f"{count} of {len(q)} configurations written to {output}, in an order of short moves")
    say("its column `rank`: the poses of ranks 1 to k are the plan for k poses")
    if proposal.devices:
        say("its column `device`: what measures the pose")
        say(*(line for sensor in sensors for line in sensor.sentences()))


def _cell(cell: Candidates, robot: Tree, table: TableFormat) -> dict[str, Any]:
    """What random configurations have to respect, in m and rad: arguments of :func:`drawn`."""
    scale = table.per_metre
    options: dict[str, Any] = {"ranges": _ranges(cell, robot, table), "seed": cell.seed}
    if cell.tracker is not None:
        x, y, z, *view = stated_numbers("--tracker", cell.tracker, (3, 6, 7))
        looks = (view[:3], *map(radians, view[3:])) if view else ()
        how: dict[str, Any] = dict(zip(("direction", "half_angle"), looks, strict=False))
        options["tracker"] = Tracker((x / scale, y / scale, z / scale), **how)
    if cell.column is not None:
        options["column"] = [x / scale for x in stated_numbers("--column", cell.column, (3, 4))]
    if cell.floor is not None:
        options["floor"] = cell.floor / scale
    if cell.collisions:
        options["keep"] = collision_free(robot)
    return options


def _ranges(cell: Candidates, robot: Tree, table: TableFormat) -> dict[str, list[float]]:
    """Name of a joint -> its range, rad or m; a column of a commanded place stands for the slide that goes there."""
    turns, columns = dict(zip(robot.joint_names, robot.periodic, strict=True)), as_written(table).joints
    slides = dict(zip(columns.columns, SLIDES, strict=False)) if isinstance(columns, PoseColumns) else {}
    ranges = {}
    for text in cell.range or ():
        name, _, ends = text.rpartition("=")
        name = slides.get(name, name)
        if not name or ends.count(":") != 1:
            raise InputError.of(f"--range {text}", expected="JOINT=A:B, such as joint_1=-90:90")
        numbers = stated_numbers("--range", ends.replace(":", ","), (2,))
        unit = 1 / table.joints_per_metre if not turns.get(name, True) else 1.0
        ranges[name] = [x * (pi / 180 if turns.get(name) and table.angle == "deg" else unit) for x in numbers]
    return ranges


MOVED = {"base": "the measuring device is", "marker": "the markers are", "both": "device and markers are"}
"""What --free names, in words."""
OPEN_M = 0.01  # expected error from which it is the place of what has moved


def _show(proposal: Plan, *, of_positions: bool, free: str | None) -> None:
    """Print the expected errors by number of poses, also as held-out errors of positions.

    ``free`` has moved since the fit: without poses only its place would be expected to be wrong.
    """
    more = "" if proposal.assumed else " more"
    title = f"Expected RMS error in mm by number of{more} poses"
    fewest, rows = 0 if free is None else int((proposal.expected_rms > OPEN_M).sum()), list[list[str]]()
    for count in (*[0] * (not proposal.assumed and not fewest), *proposal.counts):
        rms = 1e3 * float(proposal.expected_rms[count])
        with_noise = (rms**2 + (1e3 * proposal.noise_rms) ** 2) ** 0.5
        rows.append([str(count), f"{rms:.3f}", *[f"{with_noise:.3f}"] * of_positions])
    header = [f"{more} poses".strip(), "model", *["held out"] * of_positions]
    out.print(text_table(title, header, rows, labels=0, min_width=len(title)))
    if of_positions:
        say("held out: with the noise of one measurement, as `fit` and `evaluate` show it")
    if fewest:
        say(f"fewer than {fewest} poses do not show where {free} now")
    if free is not None:
        say("these errors are expected if nothing else has changed since the fit: test that by `recalibrate`")
    if proposal.assumed:
        say(f"{proposal.caution}: measure the first 20 poses, fit them, and plan the next with the model")
