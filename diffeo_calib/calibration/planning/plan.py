"""`plan`: which poses to measure, in which order, and what to expect of them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.planning.candidates import (
    Criterion,
    Tracker,
    all_of,
    candidates,
    check_limits,
    ranges_around,
)
from diffeo_calib.calibration.planning.scene import Scene, followed, of_model, of_robot
from diffeo_calib.calibration.planning.sensors import Options, Sensor, sensors_for
from diffeo_calib.common.checks import check_count
from diffeo_calib.common.data_frames import data_frame
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.common.threads import small_work
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.maps.linearisation import Numbers
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.conditional import Conditional, Opened
from diffeo_calib.robots.tree import Tree

SMALLEST_STROKE = 1e-9

JOINT_DIGITS = 6  # decimal places of joint values in a plan: no controller takes more


def short_path(q: Tensor, turning: tuple[bool, ...]) -> Tensor:
    """An order (N,) of configurations with short moves: nearest neighbours, then reversals of parts (2-opt).

    All joints start together and the slowest decides. The path starts wherever that shortens it.

    Args:
        q: (N, n) rad or m. turning: which joints turn; a slide counts in units of half its stroke here.
    """
    half = 0.5 * (q.amax(0) - q.amin(0)).clamp(min=SMALLEST_STROKE)
    unit = q / torch.where(torch.tensor(turning, dtype=torch.bool, device=q.device), torch.ones_like(half), half)
    # A point at no distance from all others closes the path to a tour, which has no ends to be treated apart.
    D = np.pad((unit[:, None] - unit[None]).abs().amax(-1).cpu().numpy(), (0, 1))
    path, left = [0], np.arange(1, len(q))
    while len(left):
        nearest = left[D[path[-1], left].argmin()]
        path, left = [*path, int(nearest)], left[left != nearest]
    tour = np.append(path, len(q))
    while True:
        after = np.roll(tour, -1)
        old = D[tour, after]
        change = np.triu(D[np.ix_(tour, tour)] + D[np.ix_(after, after)] - old[:, None] - old[None], 1)
        first, last = np.unravel_index(change.argmin(), change.shape)
        if change[first, last] > -1e-12 * (1 + old.sum()):
            break
        tour[first + 1 : last + 1] = tour[first + 1 : last + 1][::-1].copy()
    start = int(np.flatnonzero(tour == len(q))[0])
    return torch.from_numpy(np.roll(tour, -start)[1:].astype(np.int64)).to(q.device)


LOG = logging.getLogger(__name__)
FREE = (None, "base", "marker", "both")
COUNTS = (10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 120, 150, 200, 250, 300, 400, 500, 600, 800, 1000)
"""Numbers of poses at which a plan says what it expects."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses to measure.

    Args:
        q: (count, n) joint values in an order of short moves, rad or m.
        rank: (count,) 1 for the pose that helps most, 2 for the one that helps most after it, ... The poses of ranks
            1 to k are the plan for k poses.
        rows: (count,) row numbers of the poses among the candidates.
        expected_rms: (count + 1,) RMS error of the markers (the origin, for measured poses) over the targets, m,
            expected of a calibration with the poses of ranks 1 to 0, 1, ..., count, together with everything measured
            before. An expectation under the scales that the plan started from, without the noise of measurements and
            without rows that are wrong.
        noise_rms: RMS noise of one measured position under the same scales, m; held-out errors contain it, too.
        assumed: whether these scales are only those of usual industrial robots and trackers. Then ``expected_rms`` is a
            guess that may be far off; the choice of the poses depends on it little.
        joint_names: names of the joints. kinds: their kinds.
        devices: (count,) what measures each pose, by name; empty if there is one device.
        payload: the mass that the robot carries in the plan, in the unit of its measurements; None without.
    """

    q: Tensor
    rank: Tensor
    rows: Tensor
    expected_rms: Tensor
    noise_rms: float
    assumed: bool
    joint_names: tuple[str, ...]
    kinds: tuple[str, ...]
    devices: tuple[str, ...] = ()
    payload: float | None = None

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        end = 1e3 * float(self.expected_rms[-1])
        return f"Plan({len(self)} poses of {len(self.joint_names)} joints, expected RMS {end:.3f} mm)"

    def __str__(self) -> str:
        lines = [f"{count:5d} poses: {1e3 * float(self.expected_rms[count]):.3f} mm" for count in self.counts]
        return "\n".join([repr(self), *lines, *[self.caution] * self.assumed])

    @property
    def caution(self) -> str:
        """Caveat on ``expected_rms`` if it rests on usual scales."""
        return "before any measurement these errors are guesses for an industrial robot and a tracker, perhaps far off"

    @property
    def counts(self) -> tuple[int, ...]:
        """Some numbers of poses up to that of the plan, at which to look at ``expected_rms``."""
        return (*(count for count in COUNTS if count < len(self)), len(self))

    def to_csv(
        self, path: str | PathLike[str], *, length: str = "m", angle: str = "rad", sep: str = ",", decimal: str = "."
    ) -> None:
        """Write the poses in measuring order: the joints under the robot's names, and the rank.

        `fit` reads the table when the columns of the measured positions have been added.

        Args:
            path: the file.
            length: unit of prismatic joints, ``"m"`` or ``"mm"``. angle: of revolute joints, ``"rad"`` or ``"deg"``.
            sep: one character between cells. decimal: ``"."`` or ``","``.

        Raises:
            MeasurementError: an unknown unit or separator. InputError: a file that cannot be written.
        """
        self.write(path, TableFormat(length, angle, sep, decimal))

    def to_frame(self) -> Any:
        """The poses in measuring order as a pandas.DataFrame: the joints [rad or m], and the rank.

        Raises:
            ImportError: pandas is not installed.
        """
        columns = dict(zip(self.joint_names, self.q.T, strict=True)) | {"rank": self.rank}
        return data_frame(columns | ({"device": list(self.devices)} if self.devices else {}))

    def write(self, path: str | PathLike[str], table: TableFormat) -> None:
        """Write as :meth:`to_csv` does, in a format given as one object, which may name the joints otherwise."""
        columns = Columns.of(replace(table.joints_only(), joints=table.joints or self.joint_names, kinds=self.kinds))
        devices = [[name] for name in self.devices] or [[]] * len(self)
        values = columns.joints_from_si(self.q).round(decimals=JOINT_DIGITS).tolist()
        rows = zip(values, self.rank.tolist(), devices, strict=True)
        header = [*columns.joints.columns, "rank", *["device"] * bool(self.devices)]
        write_rows(path, header, [[[*joints, rank, *device] for joints, rank, device in rows]], table)


@small_work()
@outside_inference_mode
def plan(
    robot_or_model: Tree | CalibratedKinematics,
    candidates: object,
    count: int,
    *,
    target: object = None,
    marker: object = None,
    measured: object = None,
    free: str | None = None,
    hyperparameters: Hyperparameters | None = None,
    sensor: Sensor | Sequence[Sensor] | None = None,
) -> Plan:
    """Choose the poses to measure that make a calibration most accurate where the robot will work.

    Three uses:

    * ``plan(robot, ...)``: the first poses, from the description of the robot and usual sizes of its errors;
    * ``plan(model, ...)``: the next poses of the session, given all that the model was fitted to;
    * ``plan(model, ..., free="base")``: poses to measure anew later, when the measuring device stands elsewhere.

    Args:
        robot_or_model: nominal chain, n joints, or a calibrated model of it.
        candidates: (M, n) configurations that can be measured, rad or m, for example from :func:`candidates`.
        count: number of poses to choose.
        target: (T, n) configurations at which the robot shall be accurate; the candidates by default.
        marker: for a robot: (3,) or (P, 3) markers in the tip's frame, m, or the (4, 4) pose of a frame there whose
            poses are measured. By default one marker 0.1 m beside and 0.1 m in front of the tip. Of several tips each
            has the same, or those in a dictionary tip -> marker. A model knows its own.
        measured: (K, n) configurations that one device has measured already, but that are not in the model.
        free: for a model: what may have moved since its fit, "base" (the device or the robot), "marker" or "both".
        hyperparameters: for a robot: scales of its errors, for example those that another robot of its kind was
            found to have.
        sensor: what will measure, one :class:`Sensor` or several; by default what the rows of a model were measured
            with, and positions, or poses, for a robot. New devices stand in places that are not known.

    Returns:
        a :class:`Plan`.

    Raises:
        InputError: arguments of the wrong kind or shape, fewer candidates than poses, candidates beyond the robot's
            limits, a marker beyond its reach, fewer candidates than poses that a device can measure, or an argument
            that belongs to a robot with a model, and vice versa.
    """
    robot = _checked(robot_or_model, {"marker": marker, "hyperparameters": hyperparameters}, free)
    q = _configurations(robot, candidates, "candidates")
    check_limits(robot, q, "candidates")
    check_count(count, "`count`, at most the number of candidates", most=len(q))
    near = q if target is None else _configurations(robot, target, "target")
    sensors = sensors_for(robot_or_model, sensor)
    if isinstance(robot_or_model, Tree):
        flags = {"frames": any(one.of_frames for one in sensors), "free": not any(one.of_positions for one in sensors)}
        scene = of_robot(robot_or_model, marker, hyperparameters, near, **flags)
    else:
        scene = of_model(robot_or_model, free)
    wanted, near = scene.view(q), scene.view(followed(near, scene.averaged.shape[1]))
    parts = [part for one in sensors for part in one.measured(scene, wanted)]
    reachable = len(torch.cat([part.rows for part in parts]).unique())
    if reachable < count:
        fix = "pass other candidates: those at which the devices see the tool or its board, or that bring the ball to "
        what, fix = "candidates that can be measured", fix + "its sockets"
        raise InputError.of(what, expected=f"at least {count}", got=str(reachable), fix=fix)
    options = Options.of(scene, wanted, parts)
    new = options.noise.new_ones(options.at.sensitivity.shape[2] - scene.columns)
    posterior: Conditional = Opened(scene.known, scene.columns, new)
    if measured is not None:
        rows = _measured(scene, sensors, _configurations(robot, measured, "measured"))
        posterior = Conditional.given(posterior, Numbers.of(rows.at), rows.noise)  # of any size
    order, variance = scene.chosen(posterior, (options.at, options.noise, options.rows), near.at, count)
    LOG.info("%d poses chosen of %d", count, len(q))
    stated = next((one.std**2 for one in sensors if one.of_positions and one.std is not None), None)
    rows, names = options.rows[order], [options.devices[k] for k in order]
    path = short_path(q[rows], robot.periodic)
    return Plan(
        q=q[rows][path],
        rank=path + 1,
        rows=rows[path],
        devices=tuple(names[k] for k in path.tolist()) if len(parts) > 1 else (),
        expected_rms=(3 * variance).sqrt(),
        noise_rms=(3 * float(scene.variance(near.noise) if stated is None else stated)) ** 0.5,
        assumed=isinstance(robot_or_model, Tree) and hyperparameters is None,
        joint_names=robot.joint_names,
        kinds=robot.kinds,
        payload=None if isinstance(robot_or_model, Tree) else robot_or_model.payload,
    )


def _measured(scene: Scene, sensors: Sequence[Sensor], earlier: Tensor) -> Options:
    """What one device measured already."""
    view = scene.view(earlier)
    parts = [part for sensor in sensors for part in sensor.measured(scene, view)]
    if len(parts) > 1 or len(parts[0].rows) < len(earlier):
        fix = "leave `measured` out, and fit the model again with these rows"
        raise InputError.of("`measured`", expected="configurations that one device has measured", fix=fix)
    return Options.of(scene, view, parts)


def drawn(
    given: Tree | CalibratedKinematics,
    sensors: Sequence[Sensor],
    count: int,
    markers: Tensor,
    *,
    keep: Criterion | None = None,
    tracker: Tracker | None = None,
    **cell: Any,
) -> Tensor:
    """Random configurations (M, n), M at least ``count``, in which some sensors can measure, rad or m.

    They are shared by sensors that need the ball in their sockets, those that see a part of the workspace, and others.

    Args:
        given: a robot, or a model of it. markers: (P, 3) in the frame of the tip, m; the ball last.
        keep, tracker, cell: as of :func:`candidates`; the reflector of the tracker is one of the markers.
    """
    robot, base, ranges = given, torch.eye(4, dtype=torch.float64, device=HOST), dict[str, Any]()
    if isinstance(given, CalibratedKinematics):
        robot, base, ranges = given.robot, given.geometry.base, ranges_around(given.robot, given.configurations)
        kept = zip(ranges.items(), robot.periodic, robot.limits.isfinite().all(1).tolist(), strict=True)
        ranges = dict(ends for ends, turns, limited in kept if not (turns or limited))  # slides without limits
    reached = [sensor.reached(base) for sensor in sensors]
    groups = [(number, {}) for number in [reached.count({})] if number]
    groups += [(1, where) for where in reached if "keep" in where]
    held = [where["places"] for where in reached if "places" in where]  # all sockets are one sensor
    groups += [(1, {"places": torch.cat(held)})] if held else []
    whole, draws = sum(number for number, _ in groups), []
    for number, where in groups:
        marker = markers[-1] if "places" in where else markers.mean(0)
        device = None if tracker is None else replace(tracker, marker=marker.tolist())
        within = ranges | where.get("ranges", {}) | dict(cell.get("ranges") or {})
        how = cell | {"ranges": within, "places": where.get("places")}
        criteria = all_of([asked for asked in (where.get("keep"), keep) if asked is not None])
        draws.append(candidates(robot, -(-count * number // whole), tracker=device, ball=marker, keep=criteria, **how))
    return torch.cat(draws)


def _checked(given: object, of_robots: dict[str, object], free: str | None) -> Tree:
    """The robot; refuses what is none, arguments of a robot with a model, and of a model with a robot."""
    if isinstance(given, Tree):
        if free is not None:
            fix = "leave it out: of a robot without a model the place of base and markers is not known anyway"
            raise InputError.of("`free` belongs to a model", fix=fix)
        scales = of_robots["hyperparameters"]
        if not (scales is None or isinstance(scales, Hyperparameters)):
            raise InputError.of("`hyperparameters`", expected="dc.Hyperparameters", got=type(scales).__name__)
        return given
    if not isinstance(given, CalibratedKinematics):
        expected = "a robot (dc.Tree) or its model (dc.CalibratedKinematics)"
        raise InputError.of("`robot_or_model`", expected=expected, got=type(given).__name__)
    for name in (name for name, value in of_robots.items() if value is not None):
        raise InputError.of(f"`{name}` belongs to a robot", got="a model, which has its own", fix="leave it out")
    if free not in FREE:
        raise InputError.of("`free`", expected=", ".join(map(repr, FREE)), got=as_written(free))
    return given.robot


def _configurations(robot: Tree, values: object, name: str) -> Tensor:
    """(N, n) checked joint values, at least one row."""
    try:
        q = robot.joint_values(values)  # pyright: ignore[reportArgumentType]
    except InputError as error:
        raise InputError(f"`{name}`: {error}") from None
    if not len(q):
        raise InputError.of(f"`{name}` is empty", expected=f"(N, {robot.n}) joint values", fix="pass at least one row")
    return q.detach()
