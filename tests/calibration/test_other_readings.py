"""Tables that were read wrongly: the right reading is found and named, and columns that are not what they seem."""

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from numbers_bank import drawn, normal, tensor
from product_bank import Case, erring, simulated, simulated_poses, sliding_robot, with_usual_scales
from source_bank import tracked
from table_bank import read_table, refused, warned
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.judged_rows import stuck_columns, warn_of_stuck
from diffeo_calib.calibration.diagnostics.likely_mistakes import (
    Reading,
    conventions_of,
    likely_mistake,
    other_columns,
    residual_of,
    warn_of_joints_below_tip,
)
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_identification,
    check_markers,
    marker_column,
    quantum,
    unmeasured_markers,
)
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.csv.columns import JointExpressions
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.csv.lines import write_rows
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import Geometry, Joint, SimulatedArm, from_dh
from diffeo_calib.robots.se3 import rotation, transforms

XYZ = ["x", "y", "z"]


@pytest.fixture(scope="module")
def posed() -> tuple[SimulatedArm, dc.Measurements]:
    arm, train, _ = simulated_poses(40)
    return arm, train


def advice(robot: dc.Tree, data: dc.Measurements) -> str:
    return likely_mistake(robot, data, residual_of(robot, data))


def written_and_read(
    folder: Path, data: dc.Measurements, robot: dc.Tree, convention: str, wrong: dict[str, object]
) -> dc.Measurements:
    """Poses after they were written in one convention and read with other options."""
    unit = None if convention.startswith(("quat", "matrix")) else "deg"
    table = TableFormat("mm", "deg", convention=convention, rotation_angle=unit)
    write_measurements(folder / "t.csv", data, table, joints=robot)
    right = replace(table.for_writing(rotation_std=False), rotation_angle=unit)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DiffeoCalibWarning)  # a wrong unit is doubted when it is read
        return read_table(folder / "t.csv", robot, XYZ, replace(right, **wrong))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("convention", "wrong", "words"),
    [
        ("XYZ", {"convention": "xyz"}, "written with convention='XYZ' (the median residual falls from "),
        ("zyx", {"convention": "rotvec"}, "written with convention='zyx' (the"),
        ("rotvec", {"convention": "ZYX"}, "written with convention='rotvec' (the"),
        ("quat_wxyz", {"convention": "quat_xyzw"}, "written with convention='quat_wxyz' (the"),
        ("XYZ", {"rotation_angle": "rad"}, "written with rotation_angle='deg' (the"),
        ("XYZ", {"rotation": ["euler2", "euler1", "euler3"]}, "to be in the order euler1,euler2,euler3 (the"),
    ],
)
def test_the_right_reading_of_rotations(
    convention: str, wrong: dict[str, object], words: str, posed: tuple[SimulatedArm, dc.Measurements], tmp_path: Path
) -> None:
    arm, data = posed
    read = written_and_read(tmp_path, data, arm.nominal, convention, wrong)
    assert words in advice(arm.nominal, read)


@pytest.mark.slow
def test_inverted_rotations_and_poses(posed: tuple[SimulatedArm, dc.Measurements]) -> None:
    arm, data = posed
    turned = transforms(data.poses[:, :3, :3].mT, data.poses[:, :3, 3])
    for poses, words in ((turned, "the rotations alone seem"), (torch.linalg.inv(data.poses), "seen from the tool")):
        assert words in advice(arm.nominal, dc.Measurements.from_poses(data.q, poses))


def gantry() -> dc.Chain:
    """Three slides and a head that turns about x."""
    none, inf = [0.0, 0.0, 0.0], math.inf
    return robot(*(("prismatic", none, axis, -inf, inf) for axis in (X, Y, UP)), ("revolute", none, X, -inf, inf))


def test_no_claim_where_the_rotations_do_not_tell_conventions_apart(tmp_path: Path) -> None:
    """Turns about one axis are the same in many conventions."""
    q = drawn(24, 4)
    poses = gantry()(q)
    poses[:, :3, 3] += normal(24, 3, size=1e-5)
    data = dc.Measurements.from_poses(q, poses)
    said = advice(gantry(), written_and_read(tmp_path, data, gantry(), "xyz", {"convention": "zyx"}))
    for option in ("'xyz'", "'XYZ'", "'rotvec'"):
        assert f" or convention={option}" in said or f"with convention={option}" in said
    assert "which these rows do not tell apart" in said
    assert "convention='yxz'" not in said


@pytest.mark.slow
def test_a_wrong_column(tmp_path: Path) -> None:
    arm = SimulatedArm(seed=1)
    data = dc.Measurements(*arm.measure(30, seed=2), arm.nominal.joint_names)
    path, table = tmp_path / "t.csv", TableFormat("mm", "deg")
    write_measurements(path, data, table)
    lines = path.read_text().splitlines()
    added = ["y_2,load", *(f"{a},{b}" for a, b in drawn(30, 2).tolist())]
    lines = [f"{line},{cells}" for line, cells in zip(lines, added, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    names = list(arm.nominal.joint_names)
    read = read_table(path, names, ["x", "y_2", "z"], table, kinds=arm.nominal.kinds)
    assert "column 'y' fits in place of 'y_2': check the position columns (the median" in advice(arm.nominal, read)
    names[1] = "load"
    read = read_table(path, names, XYZ, table, kinds=arm.nominal.kinds)
    right = [
        one
        for one in other_columns(Reading.of(arm.nominal, read), read)
        if "'shoulder_joint' fits as shoulder_joint in pl" in one.words
    ]
    torch.testing.assert_close(right[0].q, data.q, rtol=1e-12, atol=1e-12)
    for changed in (lambda: path.write_text("another file\n"), path.unlink):
        changed()
        assert read.origin.numeric_columns(read.line_numbers) == {}


@pytest.mark.slow
def test_a_joint_below_the_tip(tmp_path: Path) -> None:
    arm = SimulatedArm(seed=1)
    arm.write_urdf(tmp_path / "arm.urdf")
    path, table = tmp_path / "t.csv", TableFormat("mm", "deg")
    write_measurements(path, dc.Measurements(*arm.measure(40, seed=2), arm.nominal.joint_names), table)
    short = dc.load_urdf(tmp_path / "arm.urdf", "base_link", "wrist_link")
    read = read_table(path, short, XYZ, table)
    words = "joint 'wrist_roll_joint', which is below the tip 'wrist_link': choose 'output_link' or a link below it"
    with pytest.warns(DiffeoCalibWarning, match=f"a joint below the tip seems to move the markers: .*{words}"):
        warn_of_joints_below_tip(short, read)
    # A joint below the tip that does not move the marker, as of a gripper, is no reason for a warning.
    still = dc.Measurements(read.q, short(read.q)[:, None, :3, 3] + normal(40, 1, 3, size=1e-5))
    warn_of_joints_below_tip(short, still.with_columns(line_numbers=read.line_numbers, origin=read.origin))


def with_joint(q: Tensor, joint: int, factor: float, offset: float = 0.0) -> Tensor:
    return q.index_copy(1, torch.tensor([joint]), factor * q[:, [joint]] + offset)


MISTAKES: dict[str, Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    "1000 times too large": lambda q, y: (q, 1e3 * y),
    "radians that were converted": lambda q, y: (q.deg2rad(), y),
    "seems to be left-handed": lambda q, y: (q, y[..., [1, 0, 2]]),
    "joints='waist_joint,shoulder_joint,wrist_bend_joint,": lambda q, y: (q[:, [0, 1, 4, 3, 2, 5]], y),
    "pi/180*{elbow_joint},": lambda q, y: (with_joint(q, 2, 180 / math.pi), y),
    ",{elbow_joint}-90,": lambda q, y: (with_joint(q, 2, 1.0, math.pi / 2), y),
    "-{elbow_joint}": lambda q, y: (with_joint(with_joint(q, 2, -1.0), 4, -1.0), y),
}


@pytest.mark.parametrize("words", [*MISTAKES])
def test_what_joint_values_and_units_mean(words: str) -> None:
    arm = SimulatedArm(seed=3)
    assert words in advice(arm.nominal, dc.Measurements(*MISTAKES[words](*arm.measure(40, seed=4)), doubt=False))


def test_joints_of_a_slide() -> None:
    """Honest measurements have no mistake."""
    robot = sliding_robot()
    data = erring(robot, 40)
    assert advice(robot, data) == ""
    read = dc.Measurements(with_joint(data.q, 2, 1e-3), data.points)
    assert "1000 times too small: check their unit (`joint_length`)" in advice(robot, read)


UP, Y, X = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]


def robot(*joints: tuple[str, list[float], list[float], float, float], error: float = 0.0) -> dc.Chain:
    """Joints (kind, origin, axis, limits); origins differ by an error [m] from what is known of them."""
    made = []
    for k, (kind, origin, axis, low, high) in enumerate(joints):
        place = torch.eye(4, dtype=torch.float64)
        place[:3, 3] = tensor(origin) + normal(3, seed=k, size=error)
        made.append(Joint(f"j{k + 1}", kind, place, tensor(axis), lower=low, upper=high))
    return dc.Chain("robot", "base", "tip", made)


SCARA = (
    ("revolute", [0.0, 0.0, 0.3], UP, -2.3, 2.3),
    ("revolute", [0.4, 0.0, 0.0], UP, -2.5, 2.5),
    ("prismatic", [0.35, 0.0, 0.0], UP, -0.25, 0.0),
    ("revolute", [0.0, 0.0, 0.0], UP, -3.0, 3.0),
)
SEVEN = (
    ("revolute", [0.0, 0.0, 0.34], UP, -2.9, 2.9),
    ("revolute", [0.0, 0.0, 0.0], Y, -2.0, 2.0),
    ("revolute", [0.0, 0.0, 0.4], UP, -2.9, 2.9),
    ("revolute", [0.05, 0.0, 0.0], Y, -2.0, 2.0),
    ("revolute", [0.0, 0.0, 0.4], UP, -2.9, 2.9),
    ("revolute", [0.0, 0.0, 0.0], Y, -2.0, 2.0),
    ("revolute", [0.1, 0.0, 0.12], UP, -3.0, 3.0),
)


def measured(joints: tuple[Any, ...], rows: int = 40) -> tuple[Tensor, Tensor]:
    """Joint values (N, n) and a marker (N, 3) of a robot with errors of several mm, in another frame."""
    real = robot(*joints, error=0.003)
    low, high = real.limits.unbind(1)
    q = low + (high - low) * (0.2 + 0.6 * drawn(rows, real.n, seed=1))
    poses = real(q)
    seen = poses[:, :3, 3] + poses[:, :3, :3] @ tensor([0.03, -0.05, 0.08])
    return q, seen @ rotation(normal(3, seed=2)).mT + 2.0 + normal(rows, 3, seed=3, size=1e-4)


def found(joints: tuple[Any, ...], q: Tensor, points: Tensor) -> list[str]:
    """Expressions of the columns a, b, ..., in degrees and m."""
    nominal = robot(*joints)
    names = list("abcdefg"[: nominal.n])
    data = dc.Measurements(q, points, doubt=False)
    return [",".join(one.texts(names, "deg", 1.0)) for one in conventions_of(nominal, data, "deg")]


def test_signs_and_zeros_of_a_scara() -> None:
    """The zero of the first joint and of the last are those of base and marker: the plain one is named."""
    q, points = measured(SCARA)
    read = q.clone()
    read[:, 2] *= -1
    read[:, 1] -= math.pi / 2
    read[:, 0] += 1.0
    assert found(SCARA, read, points) == ["a,{b}+90,-{c},d"]


def test_percent_of_limits_beside_a_joint_that_stands_still() -> None:
    """Such as a gripper."""
    joints = (*SCARA[:2], SCARA[3], ("revolute", [0.0, 0.0, 0.1], X, 0.2, 0.8))
    q, points = measured((*joints[:3], (*joints[3][:3], 0.4, 0.4001)))
    read = q * torch.tensor([100.0 / math.degrees(one[4]) for one in joints])
    assert found(joints, read, points)[0].startswith("1.3178*{a},1.43239*{b},1.71887*{c},")


def test_expressions_that_were_read_are_composed() -> None:
    """Not nested: "-{-{b}+90}"."""
    q, points = measured(SCARA)
    read = q.clone()
    read[:, 1] *= -1
    (one,) = conventions_of(robot(*SCARA), dc.Measurements(read, points, doubt=False), "deg")
    given = JointExpressions.of(["a", "-{b}+90", "c", "{d}+{b}"])
    own = one.of_columns(given.matrix, given.offset, "deg", 1.0)
    assert own.texts(given.columns, "deg", 1.0) == ["a", "{b}-90", "c", "{b}+{d}"]


def test_nothing_is_proposed_for_a_right_table_of_a_wrong_robot() -> None:
    q, points = measured(SCARA)
    assert found(SCARA, q, points) == []
    shuffled = points[torch.randperm(40, generator=torch.Generator().manual_seed(0))]
    assert found(SCARA, q, shuffled) == []


@pytest.mark.slow
def test_a_seven_axis_arm() -> None:
    q, points = measured(SEVEN)
    middle = ",".join(f"360/4096*{{{name}}}+180" for name in "bcdef")
    assert f"360/4096*{{a}},{middle},360/4096*{{g}}" in found(SEVEN, (q + math.pi) * (4096 / 360), points)


# --- columns: stuck, rounded, of unnamed markers, of markers that nobody measured -------------------------------------


HELD = {
    "poses": ("pose", "z"),
    "images and a tracker": ("marker", "marker 2"),
    "inclinations": ("inclination", "inclination 2"),
}
"""Kind of table -> kind of its rows, and the column that sticks there."""


def stuck(data: Any, kind: str) -> Any:
    """The last number of rows of a kind, of the first device: one value in all rows."""
    if isinstance(data, dc.Observations):
        return dc.Observations([stuck(part, kind) for part in data.parts], data.index)
    if data.kind != kind:
        return data
    if isinstance(data, dc.Readings):
        values, own = data.values.clone(), (data.device == 0).nonzero()[:, 0]
        number = min(1, values.shape[1] - 1)
        values[own, number] = float(values[own[0], number])
        return with_attributes(data, values=values)
    if data.poses is not None:
        poses = data.poses.clone()
        poses[:, 2, 3] = poses[0, 2, 3]
        return dc.Measurements.from_poses(data.q, poses, data.joint_names)
    points = data.points.clone()
    points[:, -1, 2] = torch.where(points[:, -1, 2].isnan(), torch.nan, 0.4)
    return with_attributes(data, points=points)


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD)
def test_a_stuck_column_is_named(name: str) -> None:
    """Before a calibration chooses scales and fits."""
    kind, (rows, column) = kind_named(name), HELD[name]
    data = stuck(kind.data, rows)
    placed, _ = warned(place, kind.robot, data, silent)
    (text,) = warned(warn_of_stuck, placed.tangent_data(), data)[1]
    assert f"'{column}' of the {rows}s" in text


def planar_rows(wrong: int = 0) -> tuple[Any, dc.Measurements]:
    """A planar robot, whose marker a flat device sees: the third coordinate is zero in all rows."""
    robot = from_dh([(0.5, 0, 0), (0.4, 0, 0), (0.2, 0, 0)], name="planar")
    q, flat = 2.4 * drawn(60, 3, seed=4) - 1.2, tensor([1.0, 1.0, 0.0])
    points = Geometry.nominal(robot, 1).with_tool(tensor([[0.03, -0.02, 0.0]])).points(q + 2e-3 * torch.sin(q))
    points = flat * (points + normal(60, 1, 3, seed=5, size=2e-5))
    points[:wrong] += flat * normal(wrong, 1, 3, seed=6, size=0.03)
    return robot, dc.Measurements(q, points, robot.joint_names)


@pytest.mark.parametrize("wrong", [0, 28])
def test_the_height_of_a_planar_robot_may_be_one_value(wrong: int) -> None:
    robot, data = planar_rows(wrong)
    assert [words for words, _ in stuck_columns(data)] == ["'z' of the positions"]
    found, texts = warned(with_usual_scales, robot, data)
    assert len(found.outliers) >= 0.8 * wrong
    assert any("are outliers" in one for one in texts) == bool(wrong)
    assert not any("one value" in one for one in texts)


def test_deviations_and_a_few_rows_are_no_stuck_columns_and_others_are() -> None:
    data = kind_named("positions").data
    for right in (
        with_attributes(data, std=torch.full_like(data.points, 2e-5)),
        stuck(data.rows(slice(5)), "position"),
    ):
        assert not [*stuck_columns(right)]
    for name, rows, column in (("heights", "height", "height"), ("images", "image", "v")):
        ((words, _),) = stuck_columns(stuck(kind_named(name).data, rows))
        assert f"'{column}' of the {rows}s" in words
    hidden = kind_named("hidden markers")
    _, texts = warned(dc.calibrate, hidden.robot, stuck(hidden.data, "position"), hyperparameters=hidden.scales)
    assert any("'marker3_z' of the positions holds one value" in one for one in texts)


@pytest.mark.parametrize(("step", "words"), [(5e-4, "0.0005 rad"), (math.radians(0.01), "0.01 degrees")])
def test_the_step_of_a_column(step: float, words: str, arm: Case) -> None:
    values = (arm.train.q[:, 1] / step).round() * step
    assert quantum(values, turning=True) == (pytest.approx(step), words)
    assert quantum(arm.train.q[:, 1], turning=True) is None
    assert quantum(values[:6], turning=True) is None  # a few round numbers are no evidence
    assert quantum(1e-6 * drawn(40), turning=True) is None  # nor is zero, of any step
    values = (torch.linspace(0.1, 0.6, 40, dtype=torch.float64).sqrt() * 1e3).round() / 1e3
    assert quantum(values, turning=False) == (pytest.approx(1e-3), "1 mm")


@pytest.mark.parametrize("step", [1e-2, 1e-3, 1e-6])
def test_rounded_joint_values_are_warned_about_where_they_cause_the_error(step: float) -> None:
    """Those of 1e-2 were commanded, and reached: their rounding would cause far larger errors than remain."""
    arm, train, _ = simulated(40)
    q = (train.q / step).round() * step
    points = arm.true_points(q) + 2e-5 * normal(40, 1, 3, seed=2) if step > 1e-3 else train.points
    words = r"waist_joint, .*, wrist_roll_joint are rounded to 0.001 rad: .* got 0\.\d+ mm RMS of position error"
    _, texts = warned(with_usual_scales, arm.nominal, dc.Measurements(q, points))
    assert [bool(re.search(words, one)) for one in texts if "rounded" in one] == [True] * (step == 1e-3)


ROWS = 45
ARM = SimulatedArm(seed=4, markers=3)
Q, POINTS = ARM.measure(ROWS, seed=5)
LABELS = torch.arange(ROWS) % 3


def labelled(path: Path, points: Tensor, labels: Tensor, q: Tensor = Q) -> dc.Measurements:
    names = ARM.nominal.joint_names
    rows = [[*one.tolist(), "ABCDEFGHI"[label]] for one, label in zip(torch.cat([q, points], 1), labels, strict=True)]
    write_rows(path, [*names, "x", "y", "z", "target"], [rows], TableFormat("m", "rad"))
    return dc.read_measurements(path, ARM.nominal, ["x", "y", "z"], length="m", angle="rad", duplicates="keep")


def test_several_markers_are_told_by_their_column(tmp_path: Path) -> None:
    data = labelled(tmp_path / "t.csv", POINTS[torch.arange(ROWS), LABELS], LABELS)
    start = register(ARM.nominal, data.q, data.points)
    column, words = marker_column(start.geometry, data) or ("", "")
    found = re.match(r"3 values between which the points jump by ([\d.]+) mm", words)
    assert column == "target"
    assert found is not None
    assert float(found[1]) == pytest.approx(1e3 * float(torch.cdist(ARM.truth.tool, ARM.truth.tool).max()), rel=0.1)
    refused(
        (
            r"column 'target' takes 3 values.* name the column: --marker target",
            lambda: check_identification(data, start),
        )
    )


@pytest.mark.parametrize("case", ["no jump", "other labels", "device", "mass", "repeated poses"])
def test_other_columns_name_no_marker(case: str, tmp_path: Path) -> None:
    """Labels without meaning, a device that moved, a load, a few poses again and again."""
    points, labels, q = POINTS[:, 0], LABELS, Q
    if case == "other labels":
        points, labels = POINTS[torch.arange(ROWS), LABELS], torch.arange(ROWS) // 9
    elif case == "device":
        points = points + tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.03, 0.01]])[labels]
    elif case == "mass":
        heavy = [ARM.measure(ROWS, seed=5, payload=mass)[1][:, 0] for mass in (0.0, 10.0, 40.0)]
        points = torch.stack(heavy)[labels, torch.arange(ROWS)]
    elif case == "repeated poses":
        q, labels = Q[:9].repeat(5, 1), torch.arange(9).repeat(5)
        points = ARM.true_points(q)[:, 0]
    data = labelled(tmp_path / "t.csv", points, labels, q)
    assert marker_column(register(ARM.nominal, data.q, data.points).geometry, data) is None


PAIR = SimulatedArm(seed=5, markers=2)
PAIR_ROWS = tracked(PAIR, 40, 1)
FIRST = PAIR_ROWS.points[:, 0]


def pair(first: Tensor, second: Tensor) -> dc.Measurements:
    return dc.Measurements(PAIR_ROWS.q, torch.stack([first, second], 1), PAIR_ROWS.joint_names)


def wished(digits: int, reached: float = 0.0) -> Tensor:
    """Places of the nominal robot in another frame, to so many digits of a mm, at joint values reached so well, rad."""
    q = PAIR_ROWS.q
    poses = PAIR.nominal(q + reached * normal(*q.shape))
    at = poses[:, :3, :3] @ tensor([0.02, 0.03, 0.1]) + poses[:, :3, 3]
    return (at @ rotation(tensor([-0.2, 0.1, 0.3])).mT + 0.4).round(decimals=3 + digits)


def test_markers_that_are_no_measurements_are_refused() -> None:
    """Wished places, and copies, also shifted ones; measured markers are silent."""
    follows, copy = (
        r"marker 1 follows the nominal robot to 0\.00.* mm, another one to",
        "marker 1 is a copy of marker 0",
    )
    shifted = FIRST + tensor([0.1, 0.0, 0.2])
    refused(
        (follows, lambda: dc.calibrate(PAIR.nominal, pair(FIRST, wished(2)))),
        (follows, lambda: check_markers(PAIR.nominal, pair(FIRST, wished(9)))),
        (copy, lambda: dc.calibrate(PAIR.nominal, pair(FIRST, FIRST.clone()))),
        (f"{copy}, shifted by the same", lambda: check_markers(PAIR.nominal, pair(FIRST, shifted))),
    )
    hidden = FIRST.clone()
    hidden[::2] = torch.nan
    assert [proved for _, _, proved in unmeasured_markers(PAIR.nominal, pair(FIRST, hidden))] == [True]
    for rows in (PAIR_ROWS, PAIR_ROWS.rows(slice(8))):
        assert not list(unmeasured_markers(PAIR.nominal, rows))


def test_a_marker_that_is_near_the_nominal_robot_is_measured_where_the_other_one_does_not_belong() -> None:
    """A robot with errors of micrometres, and a marker that is not on its tip: no proof against the first."""
    near = wished(4, reached=3e-5)
    with pytest.warns(DiffeoCalibWarning, match="marker 1 follows the nominal robot"):
        check_markers(PAIR.nominal, pair(FIRST, near))
    elsewhere = PAIR.nominal(PAIR_ROWS.q.roll(1, 0))[:, :3, 3]
    assert not list(unmeasured_markers(PAIR.nominal, pair(elsewhere, near)))
    planar, data = planar_rows()  # markers above each other on a robot whose axes are parallel are two
    above = torch.cat([data.points, data.points + tensor([0.0, 0.0, 0.1])], 1)
    assert not list(unmeasured_markers(planar, dc.Measurements(data.q, above)))
