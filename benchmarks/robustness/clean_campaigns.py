"""Clean campaigns as people really make them: nothing is wrong with their tables but normal noise.

What a campaign is like is drawn in blocks of 20, in each of which every property takes all of its levels in a random
order. Positions, hidden markers and poses are of a six-axis arm of 0.1 to 4 m, also on a rail, or with joints that
count from 0 to 360 degrees; other kinds are made by their own simulators, with an arm of 1.1 m. Noise is at most 1 % of
the reach, and the error of the robot's description 3 %.
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi, radians
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / name) for name in ("benchmarks/real_robots", "scripts/examples", "tests/banks")]

import campaigns as planned
import inclinometer
import laser_line
import numpy as np
import reading_bank
import torch
from hidden_markers import at_random
from kind_bank import table_options
from mistakes import PLACES, noise, resting
from simulated_camera import camera_arm, fixed_camera_arm
from simulated_sockets import rest_in_sockets
from torch import Tensor
from varied_arms import TWIST_DEVIATION, Kind, VariedArm

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.measurements.table_format import LEVER, TableFormat
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.robots.simulated_arm import URDF_FILE

BLOCK = 20
REACH_M = 1.1
"""Of the simulated arm."""
TRACKED = ("positions", "hidden markers", "poses")
SEARCHED = ("ball in sockets", "mixture", "inclinations", "board poses", "board images")
KINDS = (
    *("positions",) * 6,
    *("hidden markers", "poses") * 2,
    *("ball in sockets", "distances", "heights", "marks in images", "laser beams", "inclinations", "mixture"),
    *("several kinds", "board poses", "board images"),
)
ROBOTS = ("arm",) * 8 + ("still rail",) * 5 + ("rail",) * 3 + ("0 to 360",) * 4
STYLES = ("random",) * 7 + ("small ranges",) * 2 + ("grid",) * 4 + ("trajectories",) * 3 + ("one joint at a time",) * 2
STYLES += ("tool hardly turned",) * 2
JOINTS = ("reported, 6 digits",) * 5 + ("reported, 4 digits",) * 4 + ("reported, 1 digit",) * 2
JOINTS += ("commanded, whole degrees",) * 4 + ("commanded, 4 digits",) * 3 + ("commanded, 1 digit",) * 2
DIGITS = {"whole degrees": 0, "1 digit": 1, "4 digits": 4, "6 digits": 6}
"""After the decimal point of degrees."""
OFF_MM = (0.0, 0.0) + (0.3, 1.0, 2.0) * 4 + (5.0,) * 3 + (15.0,) * 3
MARKERS = (1,) * 9 + (2,) * 5 + (3,) * 3 + (4,) * 3
PLAY_RAD = (0.0,) * 14 + (3e-5,) * 3 + (1e-4,) * 3
SESSIONS = (1,) * 14 + (2,) * 4 + (3,) * 2
STOPPED_RAD = 1e-5
"""How exactly a commanded position is reached."""
FEWEST_READINGS, MOST_READINGS, MOST_NUMBERS = 64, 100, 1500
"""Rows of other devices than trackers, and measured numbers of a tracker: a fit takes seconds."""


@dataclass(frozen=True)
class Design:
    """What a campaign is like.

    Args:
        number: of the campaign. kind: of the rows. robot, style, joints: see above. rows: their number.
        noise_mm: of a coordinate. off_mm: RMS error of the robot's description. play_rad: of every joint.
    """

    number: int
    kind: str
    robot: str
    style: str
    joints: str
    rows: int
    noise_mm: float
    markers: int
    reach_m: float
    off_mm: float
    play_rad: float
    sessions: int

    @property
    def words(self) -> str:
        """In one line."""
        text = f"{self.kind}, {self.rows} rows, {self.style}, joints {self.joints}, noise {self.noise_mm:.2g} mm"
        if self.kind not in TRACKED:
            return text
        text += f", {self.robot} of {self.reach_m:.2g} m, {self.markers} marker(s), off by {self.off_mm:.2g} mm"
        text += f", play {1e3 * self.play_rad:.2g} mrad" * bool(self.play_rad)
        return text + f", {self.sessions} sessions" * (self.sessions > 1)


@dataclass(frozen=True)
class Campaign:
    """A table, its files, and the truth.

    Args:
        design: what it is like. robot: as it is described. urdf: text of the description. data: the rows.
        truth: joint values (N, n) to true markers (N, P, 3), m, in any frame. links_mm: deviation of a link's error.
    """

    design: Design
    robot: dc.Tree
    urdf: str
    data: Any
    truth: Callable[[Tensor], Tensor]
    links_mm: float

    def written(self, folder: Path) -> list[str]:
        """Write robot and table; return the words of the command that calibrates them."""
        robot, table = folder / "robot.urdf", folder / "table.csv"
        robot.write_text(self.urdf)
        turned = {"convention": "rotvec", "rotation_angle": "deg"}
        turned = turned if self.design.kind in ("poses", "board poses", "inclinations") else {}
        on_tool = self.design.kind in ("board poses", "board images") and self.design.number % 2 == 0
        form = TableFormat("mm", "deg", joint_length="m", camera_on_tool=on_tool, **turned)  # pyright: ignore
        form = write_measurements(table, self.data, form, joints=self.robot)
        _as_printed(table, self.robot.joint_names, DIGITS[self.design.joints.partition(", ")[2]])
        words = ["fit", str(table), "--robot", str(robot), "--base", self.robot.base, "--tip", "flange"]
        return [*words, "--length", "mm", "--angle", "deg", "--joint-length", "m", *table_options(form)]


def _as_printed(table: Path, joints: tuple[str, ...], digits: int) -> None:
    """Print joint values with so many digits after the point; those of a rail in m with six."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row |= {name: f"{float(row[name]):.{6 if name == 'rail' else digits}f}" for name in joints}
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


# --- what campaigns are like ----------------------------------------------------------------------------------------


def design(number: int) -> Design:
    """The campaign of this number."""
    rng, k = np.random.default_rng([number // BLOCK, 20]), number % BLOCK
    strata = [(rng.permutation(BLOCK) + rng.random(BLOCK)) / BLOCK for _ in range(3)]
    few, noisy, large = (float(part[k]) for part in strata)
    levels = (KINDS, ROBOTS, STYLES, JOINTS, OFF_MM, MARKERS, PLAY_RAD, SESSIONS)
    picked: list[Any] = [level[int(rng.permutation(BLOCK)[k])] for level in levels]
    kind, robot, style, joints, off, markers, play, sessions = picked
    rows, tracked = round(12 * (500 / 12) ** few**2), kind in TRACKED
    reach = 0.1 * 40**large if tracked else REACH_M
    noise_mm = min(0.01 * 300**noisy, 10 * reach) if tracked else 0.01 * 10**noisy
    if kind in SEARCHED:  # their poses are where the ball or the camera needs them
        style, joints = "random", joints.replace("commanded, whole degrees", "commanded, 4 digits")
        joints = joints.replace("commanded", "reported")
    markers = 1 if kind == "poses" else max(markers, 2) if kind == "hidden markers" else markers
    most = MOST_NUMBERS // (3 * markers + 6 * (kind == "poses")) if tracked else MOST_READINGS
    rows = min(max(rows, 12 if tracked else FEWEST_READINGS), most)
    sessions = min(sessions, rows // 15) or 1
    return Design(
        *(number, kind, robot, style, joints, rows, noise_mm, markers, reach, min(off, 30 * reach), play, sessions)
    )


def urdf(of: Design) -> str:
    """The simulated arm in another size, on a rail, or with joints that turn without end."""
    size = of.reach_m / REACH_M

    def scaled(match: re.Match[str]) -> str:
        return f'<origin xyz="{" ".join(repr(size * float(word)) for word in match[1].split())}"'

    text = re.sub(r'<origin xyz="([^"]*)"', scaled, URDF_FILE.read_text(encoding="utf-8"))
    if of.robot == "0 to 360":
        for name in ("waist_joint", "forearm_roll_joint", "wrist_roll_joint"):
            joint = rf'(<joint name="{name}" type=)"revolute"(.*?)\s*<limit[^>]*>'
            text = re.sub(joint, r'\1"continuous"\2', text, flags=re.DOTALL)
    if "rail" in of.robot:
        rail = (
            '<link name="ground"/><joint name="rail" type="prismatic"><parent link="ground"/><child link="base_link"/>'
        )
        rail += '<origin xyz="0 0 0" rpy="0 0 0"/><axis xyz="0 1 0"/><limit lower="-5" upper="5"/></joint>'
        text = text.replace('<link name="base_link">', rail + '<link name="base_link">')
    return text


def configurations(of: Design, arm: VariedArm, rng: np.random.Generator) -> Tensor:
    """Joint values (rows, 6) of an arm without a rail, rad."""
    drawn, many, size = torch.Generator().manual_seed(of.number), of.rows, of.reach_m / REACH_M
    own: Any = SimpleNamespace(nominal=arm.nominal)
    if of.style == "trajectories":
        return arm.rows(many, of.number, "motions")
    if of.style == "one joint at a time":
        return planned.one_at_a_time(own, many, drawn)
    if of.style == "small ranges":
        return planned.half_turn(own, many, drawn)
    if of.style == "tool hardly turned":
        return planned.box((0.4 * size, 0.4 * size, 0.3 * size), radians(3.0))(own, many, drawn)
    if of.style == "grid":
        return _grid(arm.nominal.limits, many, rng)
    return planned.joints(own, many, drawn)


def _grid(limits: Tensor, rows: int, rng: np.random.Generator) -> Tensor:
    """Rows of a grid of three or four values of every joint, in its order."""
    values = [np.linspace(0.8 * low, 0.8 * high, 3 + (rows > 200)) for low, high in limits.tolist()]
    every = np.stack(np.meshgrid(*values, indexing="ij"), -1).reshape(-1, len(values))
    return torch.from_numpy(every[np.sort(rng.choice(len(every), rows, replace=False))])


# --- a tracker ------------------------------------------------------------------------------------------------------


def _loaded(text: str, folder: Path, base: str) -> dc.Tree:
    path = folder / "of_arm.urdf"
    path.write_text(text)
    return dc.load_urdf(path, base, "flange")


def _arm(robot: dc.Tree, of: Design) -> VariedArm:
    """An arm whose errors of links, gears and sag move its markers by ``off_mm`` RMS, and its markers."""

    def drawn(kind: Kind) -> VariedArm:
        arm, rng = VariedArm(robot, kind, of.number), np.random.default_rng([of.number, 22])
        if of.kind == "poses":
            frame = torch.eye(4, dtype=torch.float64)
            frame[:3, 3] = arm.tool[0] * of.reach_m / REACH_M
            arm.tool = mark_points(frame[None], LEVER)[0]
        else:
            near = rng.uniform((-0.1, -0.1, 0.05), (0.1, 0.1, 0.2), (of.markers, 3))
            arm.tool = torch.from_numpy(near * of.reach_m / REACH_M)
        arm.sag = arm.sag * torch.tensor(robot.periodic)  # a slide is level
        return arm

    usual, none = drawn(Kind()), drawn(Kind(geometry=0.0, transmission=0.0, gravity=0.0))
    q = usual.rows(200, of.number, "random")
    size = 1e3 * float((usual.true_points(q) - none.true_points(q)).square().sum(-1).mean().sqrt())
    factor = of.off_mm / size
    return drawn(Kind(geometry=factor, transmission=factor, gravity=factor))


def _tracked(of: Design, folder: Path, rng: np.random.Generator) -> Campaign:
    """Positions, or poses."""
    text, base = urdf(of), "ground" if "rail" in of.robot else "base_link"
    robot = _loaded(text, folder, base)
    plain = _loaded(urdf(replace(of, robot="arm")), folder, "base_link")
    q = configurations(of, VariedArm(plain, Kind(), of.number), rng)
    if of.robot == "0 to 360":
        q[:, torch.tensor(robot.periodic) & robot.limits.isinf().any(1)] %= 2 * pi
    if of.joints.startswith("commanded"):
        step = radians(10.0 ** -DIGITS[of.joints.partition(", ")[2]])
        q = (q / step).round() * step
    there = q + noise(rng, q, STOPPED_RAD) * of.joints.startswith("commanded")
    if "rail" in of.robot:
        along = torch.from_numpy(rng.uniform(-of.reach_m, of.reach_m, (of.rows, 1))).round(decimals=2)
        along = along if of.robot == "rail" else noise(rng, along)
        q, there = torch.cat([along, q], 1), torch.cat([along, there], 1)
    arm = _arm(robot, of)
    signs = torch.from_numpy(rng.choice([-0.5, 0.5], tuple(q.shape))) * torch.tensor(robot.periodic)
    points = arm.true_points(there + of.play_rad * signs)
    deviation, names, links = 1e-3 * of.noise_mm, robot.joint_names, 1e3 * TWIST_DEVIATION * arm.kind.geometry
    if of.kind == "poses":
        poses = poses_from_marks(points, LEVER)
        poses[:, :3, 3] += noise(rng, poses[:, :3, 3], deviation)
        poses[:, :3, :3] = rotation(noise(rng, poses[:, :3, 3], deviation / 0.3)) @ poses[:, :3, :3]
        data = dc.Measurements.from_poses(q, poses, names, doubt=False)
        return Campaign(of, robot, text, data, arm.true_points, links)
    points = points + noise(rng, points, deviation)
    if of.kind == "hidden markers":
        points = points.masked_fill(at_random(points, of.number)[..., None], torch.nan)
    points, sessions = _in_sessions(of, points, rng)
    data = dc.Measurements(q, points, names, doubt=False)
    data = data.with_sessions(sessions) if sessions else data
    return Campaign(of, robot, text, data, arm.true_points, links)


def _in_sessions(of: Design, points: Tensor, rng: np.random.Generator) -> tuple[Tensor, list[str]]:
    """Points of sessions one after the other, before each of which the device was moved, and the names of these."""
    if of.sessions == 1:
        return points, []
    number = torch.arange(of.rows) * of.sessions // of.rows
    seen = points.clone()
    for k in range(1, of.sessions):
        turn, shift = rotation(noise(rng, torch.zeros(3), 0.1)), noise(rng, torch.zeros(3), 0.2)
        seen[number == k] = points[number == k] @ turn.mT + shift
    return seen, [f"day {k + 1}" for k in number.tolist()]


# --- other devices --------------------------------------------------------------------------------------------------


class _StyledArm(SimulatedArm):
    """The simulated arm, whose configurations are those of a campaign."""

    def __init__(self, of: Design, **given: Any) -> None:
        self.size = of.off_mm / 1.5
        usual = min(self.size, 2.0)
        super().__init__(of.number, geometry=self.size, transmission=usual, gravity=usual, **given)
        self.of = of

    def sample(self, count: int, seed: int = 0) -> Tensor:
        """See above."""
        own = replace(self.of, rows=count, number=self.of.number + seed, reach_m=REACH_M)
        rng = np.random.default_rng([own.number, 23])
        q = configurations(own, VariedArm(self.nominal, Kind(), own.number), rng)
        step = radians(10.0 ** -DIGITS[self.of.joints.partition(", ")[2]])
        return (q / step).round() * step if self.of.joints.startswith("commanded") else q


def _of_board(of: Design) -> tuple[SimulatedArm, dc.Measurements]:
    """Images of a board by a camera on the tool or a fixed one; or its poses, of which half are inverted by hand."""
    on_tool, images = of.number % 2 == 0, of.kind == "board images"
    seen = (camera_arm if on_tool or not images else fixed_camera_arm)(of.rows * 2 // 3, of.number, of.number)
    if images:
        return seen.arm, seen.images(of.noise_mm, on_tool=on_tool)
    return seen.arm, seen.measured(1e-3 * of.noise_mm, 1e-2 * of.noise_mm, on_tool=on_tool)


def _of_devices(of: Design, rng: np.random.Generator) -> Campaign:
    """Rows of other devices, by their own simulators; those that look for configurations have random ones."""
    deviation, styled = 1e-3 * of.noise_mm, _StyledArm(of, noise=1e-3 * of.noise_mm)
    names, text = styled.nominal.joint_names, URDF_FILE.read_text(encoding="utf-8")

    def campaign(arm: SimulatedArm, data: Any, order: tuple[int, ...] = (0,)) -> Campaign:
        links = 0.5 * max(1.0, styled.size)
        return Campaign(of, arm.nominal, text, data, lambda q: arm.true_points(q)[:, list(order)], links)

    def read(arm: SimulatedArm, kind: str, rows: int) -> dc.Readings:
        return reading_bank.readings(arm, kind, rows, noise=deviation, seed=of.number)

    readings = {"distances": "distance", "heights": "height", "marks in images": "image"}
    if of.kind in readings:
        return campaign(styled, read(styled, readings[of.kind], of.rows))
    if of.kind == "ball in sockets":
        arm = SimulatedArm(of.number)
        found = rest_in_sockets(arm, of.number, places=PLACES, rows=of.rows // 12, repeatability=deviation)
        known: Any = {"distances": reading_bank.DISTANCES, "distance_std": 3e-5, "doubt": False}
        return campaign(arm, dc.Measurements.from_sockets(found.q, found.names, names, **known))
    if of.kind.startswith("board"):
        return campaign(*_of_board(of), (0, 1, 2))
    if of.kind == "inclinations":
        arm = _StyledArm(of, markers=3)
        q = arm.sample(of.rows // 2, 5)
        poses = inclinometer.frames(arm, q)
        poses[:, :3, 3] += noise(rng, poses[:, :3, 3], deviation)
        both: Any = [dc.Measurements.from_poses(q, poses, names)]
        both.append(inclinometer.readings(arm, arm.sample(of.rows, 6)))
        made = campaign(arm, dc.Observations.joined(both))
        return replace(made, truth=lambda q: mark_points(inclinometer.frames(arm, q), LEVER))
    arm = _StyledArm(of, markers=2, noise=deviation)
    q, points = arm.measure(max(of.rows // 2, 30), of.number)
    both: Any = [dc.Measurements(q, points[:, 1:], names, doubt=False)]
    if of.kind == "mixture":
        both.append(resting(arm, rng, 0.05, rows=6)[1].with_joint_names(names))
    elif of.kind == "laser beams":
        both.append(laser_line.readings(arm, arm.sample(of.rows, 6)))
    else:
        both += [read(arm, kind, of.rows * 2 // 3) for kind in readings.values()]
    return campaign(arm, dc.Observations.joined(both), (1, 0))


def campaign(of: Design, folder: Path) -> Campaign:
    """Robot, table and truth of a design; files that are read again are written to ``folder``."""
    rng = np.random.default_rng([of.number, 21])
    return _tracked(of, folder, rng) if of.kind in TRACKED else _of_devices(of, rng)
