"""Denavit-Hartenberg tables and files with one; machines with commanded poses or places; rotations."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from math import nan, pi
from pathlib import Path
from typing import Any

import pytest
import torch
from robots_bank import draw
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, RobotError
from diffeo_calib.robots import DHRow, from_dh, se3
from diffeo_calib.robots.dh_file import DHFile
from diffeo_calib.robots.se3 import nearest_rotations, right_jacobian, roll_pitch_yaw, rotation, transforms, twist_at
from diffeo_calib.robots.tree import robot_from_config


def moved(axis: str, angle: float, *shift: float) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.from_numpy(Rotation.from_euler(axis, angle).as_matrix())
    matrix[:3, 3] = torch.tensor(shift or (0.0, 0.0, 0.0), dtype=torch.float64)
    return matrix


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_table_multiplies_out_as_the_convention_says(convention: str) -> None:
    rows = [DHRow(0.1, 0.4, 0.3, 0.2, beta=0.5), DHRow(-0.2, -1.1, 0.5, 0.7, "prismatic"), DHRow(0.3, 0.9, -0.1)]
    chain = from_dh(rows, convention)
    q = torch.tensor([[0.3, -0.4, 1.2]], dtype=torch.float64)
    expected = torch.eye(4, dtype=torch.float64)
    for row, value in zip(rows, q[0].tolist(), strict=True):
        theta, d = (row.theta + value, row.d) if row.kind == "revolute" else (row.theta, row.d + value)
        about_z, about_x = moved("z", theta, 0, 0, d), moved("x", row.alpha, row.a, 0, 0) @ moved("y", row.beta)
        expected = expected @ (about_z @ about_x if convention == "standard" else about_x @ about_z)
    torch.testing.assert_close(chain(q)[0], expected, rtol=0, atol=1e-15)
    assert chain.kinds == ("revolute", "prismatic", "revolute")
    assert chain.joint_names == ("joint_1", "joint_2", "joint_3")
    named = from_dh([(0.1, 0.4, 0.3, 0.2), *rows[1:]], convention, names=["a", "b", "c"], name="table")
    assert (named.name, named.joint_names) == ("table", ("a", "b", "c"))


def test_angles_beyond_a_turn_are_angles() -> None:
    """As in calibrated tables of makers; degrees are warned about."""
    turned = from_dh([(0.1, 0.3, 0.2), (0.2, 6.50222, 0.1, -6.4)])
    same = from_dh([(0.1, 0.3, 0.2), (0.2, 6.50222 - 2 * pi, 0.1, 2 * pi - 6.4)])
    q = torch.rand(5, 2, dtype=torch.float64)
    torch.testing.assert_close(turned(q), same(q), rtol=0, atol=1e-14)
    with pytest.warns(DiffeoCalibWarning, match="an angle in row 1 of the DH table is 90 rad; convert degrees"):
        from_dh([(0, 1, 0), (0, 90, 0)])


@pytest.mark.parametrize("row", [(612, 0, 0), (0, 0, -128)])
def test_millimetres_are_warned_about(row: tuple[float, float, float]) -> None:
    with pytest.warns(DiffeoCalibWarning, match="row 0 of the DH table is .* in mm"):
        from_dh([row])
    with pytest.warns(DiffeoCalibWarning, match="inf m"), pytest.raises(InputError, match="the origin of joint"):
        from_dh([(1e308, 0.0, 0.0)])


BRANCHED = [DHRow(0.0, pi / 2, 0.4), DHRow(0.1, 0.3, 0.2, 0.5), DHRow(0.2, -0.7, 0.1, kind="prismatic")]
BRANCHED += [DHRow(0.3, 1.1, 0.0), DHRow(-0.2, 0.4, 0.1, parent=1), DHRow(0.1, -0.9, 0.3), DHRow(1, 0.2, 1, parent=-1)]
PATHS = {"tip_1": [0, 1, 2, 3], "tip_2": [0, 1, 4, 5], "tip_3": [6]}


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_every_branch_is_the_chain_of_its_rows(convention: str) -> None:
    robot = from_dh(BRANCHED, convention)
    assert robot.tips == tuple(PATHS)
    assert robot.n == len(BRANCHED)
    q = torch.linspace(-1.0, 1.2, 3 * 7, dtype=torch.float64).view(3, 7)
    poses = robot(q)
    for tip, path in PATHS.items():
        alone = from_dh([replace(BRANCHED[row], parent=None) for row in path], convention)
        torch.testing.assert_close(poses[:, robot.tips.index(tip)], alone(q[:, path]), rtol=0, atol=1e-14)


def test_branches_without_a_tip_only_weigh() -> None:
    robot = from_dh(BRANCHED, tips={"hand": 5})
    assert (robot.tips, robot.loads) == (("hand",), ("joint_4", "joint_7"))
    q = torch.linspace(-1.0, 1.2, 7, dtype=torch.float64)[None]
    torch.testing.assert_close(robot(q), from_dh(BRANCHED)(q)[:, 1], rtol=0, atol=0)
    assert robot_from_config(robot.to_config())(q).equal(robot(q))
    middle = from_dh(BRANCHED, tips={"elbow": 4, "hand": 5})(q)
    torch.testing.assert_close(middle[:, 1], robot(q), rtol=0, atol=0)


FORK = [DHRow(0, 0, 0.3), DHRow(0.3, 1.2, 0.1), DHRow(0.3, 0.9, 0.1, parent=0)]
ROW = (0, 0, 0)


@pytest.mark.parametrize(
    ("rows", "arguments", "message"),
    [
        (5, {}, "the DH table: expected rows"),
        ([ROW], {"convention": "modified"}, "`convention`: expected 'standard' or 'craig', got 'modified'"),
        ([ROW, (0, 0)], {}, "row 1 of the DH table: expected (a, alpha, d[, theta[, kind[, mimic"),
        ([(0, 0, 0, 0, "revolute", None, 0, 0)], {}, "mimic_offset]]]]), got 8 entries"),
        ([ROW, (0, 0, 0, 0, "revolute", {"elbow": 1})], {}, "joint 'joint_2' of robot 'robot' mimics 'elbow'"),
        ([ROW, DHRow(0, 0, 0, mimic={"joint_1": nan})], {}, "the multiplier of 'joint_1' in joint 'joint_2'"),
        ([(0, nan, 0)], {}, "row 0 of the DH table: expected finite numbers"),
        ([ROW], {"names": ["a", "b"]}, "`names`: expected 1 names"),
        (FORK, {"names": 5}, "`names`: expected 3 names, one for each row, got 5"),
        ([ROW, ROW], {"names": ["a", "a"]}, "several joints named ['a']"),
        *(([ROW, DHRow(*ROW, parent=parent)], {}, "the parent in row 1") for parent in (4, -2, 1.0, False)),
        (FORK, {"tips": {"hand": 7}}, "`tips` of the DH table: expected names with numbers of rows, 0 to 2"),
        *((FORK, {"tips": {tip: 1}}, "the name of a tip of the DH table") for tip in ("joint_3", "base", "")),
    ],
)
def test_wrong_tables_are_explained(rows: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        from_dh(rows, **arguments)


ROWS = [DHRow(0.05, -pi / 2, 0.4, 0.0, lower=-3.0, upper=2.5), DHRow(0.43, 0.0, -0.02, -pi / 2)]
ROWS += [DHRow(0.0, pi / 2, 0.15, 0.0, "prismatic"), DHRow(-0.01, -pi / 2, 0.0, pi)]
Q = torch.tensor([[0.3, -0.7, 0.2, 1.1], [-1.2, 0.4, -0.1, 0.6]], dtype=torch.float64)


def lines(sep: str, header: str, cells: Sequence[Sequence[object]], before: str = "") -> str:
    return "\n".join([*before.splitlines(), header, *(sep.join(map(str, row)) for row in cells)])


def deg(*values: float) -> list[str]:
    return [f"{value * 180 / pi:.10g}" for value in values]


def angle(value: float) -> str:
    """As a multiple of pi, a number in rad."""
    return {pi / 2: "pi/2", -pi / 2: "-π/2", pi: "pi"}.get(value, str(value))


METRES = [[r.kind, r.theta, r.d, r.a, r.alpha] for r in ROWS]
FILES = {
    "plain": lines(",", "type,theta,d,a,alpha", METRES),
    "blanks, greek": lines("  ", "type θ d a α", METRES),
    "makers' units": lines(
        ";",
        "Gelenk;Type;alpha [Grad];a [mm];d [mm];theta [deg]",
        [[f"A{k}", r.kind[0].upper(), *deg(r.alpha), 1e3 * r.a, 1e3 * r.d, *deg(r.theta)] for k, r in enumerate(ROWS)],
    ).replace(".", ","),
    "words of another language, inches": lines(
        ";",
        "Achse;Typ;Type;Drehwinkel [rad];Versatz [in];Länge [inch];Verdrehung [rad]",
        [[f"A{k}", "関節", r.kind, r.theta, r.d / 0.0254, r.a / 0.0254, r.alpha] for k, r in enumerate(ROWS)],
    ),
    "units without brackets, a comment": lines(
        "\t",
        "i\ta_mm\tsigma\td_mm\talpha_deg\ttheta_deg\tmass",
        [[k, 1e3 * r.a, int(r.kind[0] == "p"), 1e3 * r.d, *deg(r.alpha, r.theta), 3] for k, r in enumerate(ROWS, 1)],
        "# measured in 2019",
    ),
    "units by size": lines(
        ",", "kind,a,alpha,d,theta", [[r.kind, 1e3 * r.a, *deg(r.alpha), 1e3 * r.d, *deg(r.theta)] for r in ROWS]
    ),
    "values of the joints, multiples of pi": lines(
        ",",
        "Link,theta_i,d_i,a_i,alpha_i",
        [
            [
                k + 1,
                f"{angle(r.theta)}" if r.kind[0] == "p" else f"q{k + 1} + {angle(r.theta)}".replace("+ -", "- "),
                f"d{k + 1}+{r.d}" if r.kind[0] == "p" else r.d,
                r.a,
                angle(r.alpha),
            ]
            for k, r in enumerate(ROWS)
        ],
    ),
    "offsets": lines(
        ",",
        "type,offset,theta,d,a,alpha",
        [[r.kind, *((r.d, r.theta, 0) if r.kind[0] == "p" else (r.theta, 0, r.d)), r.a, r.alpha] for r in ROWS],
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_spellings_orders_and_units(name: str, tmp_path: Path) -> None:
    page = "gb18030" if "greek" in name else "utf-8"
    (tmp_path / "arm.csv").write_text(FILES[name], encoding=page)
    table = DHFile.read(tmp_path / "arm.csv")
    assert not table.convention
    for convention in ("standard", "craig"):
        chain = table.chain(convention)
        torch.testing.assert_close(chain(Q), from_dh(ROWS, convention)(Q), rtol=0, atol=1e-10)
        assert chain.kinds == ("revolute", "revolute", "prismatic", "revolute")
    assert (chain.name, chain.base, chain.tip) == ("arm", "base", "tip")
    first = "A0" if "makers" in name or "language" in name else "joint_1"
    assert chain.joint_names[0] == first


@pytest.mark.parametrize(
    ("text", "convention"),
    [
        (lines(",", "theta,d,a,alpha", [[0, 1, 0.2, 1.5708]], "# Craig's parameters"), "craig"),
        (lines(",", "alpha_{i-1},a_{i-1},d_i,theta_i", [[1.5708, 0.2, 1, 0]]), "craig"),
        (lines(",", "alphai-1 (rad),ai-1 (m),di (m),thetai (rad)", [[1.5708, 0.2, 1, 0]]), "craig"),
        (lines(",", "alpha_prev,a_prev,d,theta", [[1.5708, 0.2, 1, 0]]), "craig"),
        (lines(",", "theta,d,a,alpha,convention", [[0, 1, 0.2, 1.5708, "standard"]]), "standard"),
        (lines(",", "theta,d,a,alpha", [[0, 1, 0.2, 1.5708]], "Classic DH table of the cell"), "standard"),
        (lines(",", "theta_i,d_i,a_i,alpha_i", [[0, 1, 0.2, 1.5708]]), ""),
    ],
)
def test_what_a_file_says_of_its_convention(text: str, convention: str, tmp_path: Path) -> None:
    (tmp_path / "arm.csv").write_text(text)
    table = DHFile.read(tmp_path / "arm.csv")
    assert table.convention == convention
    if convention:
        other = "craig" if convention == "standard" else "standard"
        with pytest.raises(RobotError, match=f"got {other}, but the file says {convention}"):
            table.chain(other)
    else:
        with pytest.raises(RobotError, match=r"expected standard or craig \(modified\), got neither.*--dh-convention"):
            table.chain()


@pytest.mark.parametrize("text", ["# last modified: 2024", "# with the standard deviation of it", "# a standard"])
def test_words_with_another_meaning_are_no_convention(text: str, tmp_path: Path) -> None:
    path = tmp_path / "ur10_modified.csv"
    path.write_text(lines(",", "joint,theta,d,a,alpha", [["index_proximal", 0, 1, 0.2, 1.5708]], text))
    assert not DHFile.read(path).convention
    path.write_text(f"# modified\n{path.read_text()}")
    table = DHFile.read(path)
    assert table.convention == "craig"
    assert table.chain("standard").n == table.chain().n == 1


def test_cells_of_slides_limits_and_a_tip_before_the_last_row(tmp_path: Path) -> None:
    rows = [["0", "PI/2", "q1 + 0.15", "0", "0", "0.5"], ["0", "-PI/2", "0", "0", "-170", "170"]]
    (tmp_path / "arm.md").write_text(lines("|", "a|alpha|d|theta|min|max", [["---", ":-:", "-", "-", "-", "-"], *rows]))
    chain = DHFile.read(tmp_path / "arm.md").chain("standard")
    assert chain.kinds == ("prismatic", "revolute")
    torch.testing.assert_close(chain.limits[:, 1], torch.tensor([0.5, 170 * pi / 180], dtype=torch.float64))
    rows = [[r.a, r.alpha, r.d, r.theta, *((-3, 2.5) if k == 0 else ("", ""))] for k, r in enumerate(ROWS)]
    (tmp_path / "arm.csv").write_text(lines(",", "a,alpha,d,theta,min,max", rows))
    chain = DHFile.read(tmp_path / "arm.csv").chain("standard", "joint_2")
    assert chain.limits[0].tolist() == [-3.0, 2.5]
    assert chain.limits[1].isinf().all()
    assert (chain.n, chain.tip) == (2, "joint_2")
    torch.testing.assert_close(chain(Q[:, :2]), from_dh(ROWS[:2])(Q[:, :2]), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("q1,q2,x,y,z\n1,2,3,4,5\n", "is no DH table: expected a header with the columns a, alpha, d and theta"),
        ("a,alpha,d,theta\n", "expected rows of 4 cells, one column of each kind, got no row"),
        ("a,alpha,d,theta,theta\n0,1.5708,0,0,0\n", "one column of each kind, got a, alpha, d, theta, theta"),
        ("a,alpha,d,theta\n0,1.5708,x,0\n", "joint 'joint_1' of .* got d 'x'"),
        ("a,alpha,d,theta,type\n0,1.5708,0,0,ball\n", "got kind 'ball'"),
        ("a,alpha,d,theta,mimic\n0,1.5708,0,0,other\n", "got unread 'other'"),
        ("a,alpha,d,theta\n0.3,0.4,0,0\n", "the unit of angles of .*: expected rad or deg, got numbers that may"),
        ("a,alpha,d,theta,min,max\n0,90,0,0,-3,3\n", r"unit of `min` of .*write min \[rad\] or min \[deg\]"),
        ("# standard DH, not modified\na,alpha,d,theta\n0,1.5708,0,0\n", "names two conventions"),
    ],
)
def test_broken_files_are_one_error(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "arm.csv").write_text(text)
    with pytest.raises(RobotError, match=message):
        DHFile.read(tmp_path / "arm.csv")


def test_far_common_normals_of_a_maker() -> None:
    """Parallel axes with d of hundreds of metres: no warning, poses to rounding, and a robot of its real size."""
    near = [(0.0, 1.5709, 0.09, 0.0), (-0.43, 5e-4, -187.25, 0.1), (-0.39, -7e-3, 186.6, 6.6), (0.0, 1.57, 0.79, 0.0)]
    for convention in ("standard", "craig"):
        chain = from_dh(near, convention)
        assert chain.reach < 4.0
        q = torch.tensor([[0.4, -1.0, 0.8, 0.2]], dtype=torch.float64)
        far = torch.eye(4, dtype=torch.float64)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a row of this length alone
            for row, value in zip(near, q[0].tolist(), strict=True):
                far = far @ from_dh([row], convention)(torch.tensor([[value]], dtype=torch.float64))[0]
        torch.testing.assert_close(chain(q)[0], far, rtol=0, atol=1e-12)


def turns(vectors: Tensor) -> Tensor:
    return torch.from_numpy(Rotation.from_rotvec(vectors.numpy()).as_matrix())


def poses(count: int = 30, *, spread: float = 0.5, seed: int = 0) -> Tensor:
    """Around a tool that points down."""
    draws = torch.randn(count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return transforms(turns(torch.tensor([[3.1, 0.2, 0.1]])) @ turns(spread * draws[:, 3:]), draws[:, :3])


@pytest.mark.parametrize("spread", [0.1, 0.5])
def test_the_robot_goes_where_it_is_commanded(spread: float) -> None:
    commanded = poses(spread=spread)
    robot = dc.cartesian(commanded)
    q = dc.pose_inputs(robot, commanded)
    assert_close(robot(q), commanded, rtol=0, atol=1e-12)
    again = robot_from_config(robot.to_config())  # a model file keeps the machine
    assert_close(dc.pose_inputs(again, commanded), q, rtol=0, atol=0)
    low, high = robot.limits.unbind(1)
    assert bool(((q >= low) & (q <= high)).all())
    assert float(q[:, 4].sin().abs().max()) < 0.97


def test_orientations_all_around_and_refused_poses() -> None:
    """A wrist that turns all around while it tilts by up to a quarter turn: the mean would be next to a singularity."""
    angles = torch.linspace(-torch.pi, torch.pi, 25, dtype=torch.float64)
    axes = torch.stack([torch.zeros_like(angles), angles, torch.zeros_like(angles)], 1)
    commanded = transforms(turns(axes), torch.zeros_like(axes))
    robot = dc.cartesian(commanded)
    assert_close(robot(dc.pose_inputs(robot, commanded)), commanded, rtol=0, atol=1e-12)
    with pytest.raises(dc.DiffeoCalibError, match=r"`poses`, row \d+: expected orientations .* got \d+"):
        dc.cartesian(poses(3000, spread=3.0))
    robot, commanded = dc.cartesian(poses()), poses()
    commanded[3, :3, :3] *= 1.1
    with pytest.raises(dc.DiffeoCalibError, match="`poses`, row 3: expected a rotation matrix"):
        dc.cartesian(commanded)
    with pytest.raises(dc.DiffeoCalibError, match=r"`poses`: expected \(N, 4, 4\), got \(30, 3\)"):
        dc.pose_inputs(robot, poses()[:, :3, 3])
    arm = dc.from_dh([dc.DHRow(a=1.0, alpha=0.0, d=0.0, theta=0.0)])
    with pytest.raises(dc.DiffeoCalibError, match="expected a machine with commanded poses"):
        dc.pose_inputs(arm, poses())


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_places(axes: int) -> None:
    places = poses()[:, :axes, 3]
    robot = dc.cartesian(places)
    assert robot.n == axes
    assert_close(robot(dc.pose_inputs(robot, places))[:, :axes, 3], places)
    assert robot.kinds == ("prismatic",) * axes


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-12, 1e-4, 0.3, 0.999999, 1.000001, 2.0, 3.1, 6.5])
def test_rotation_and_its_jacobian_at_every_angle(angle: float) -> None:
    w = angle * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    x, y, z = w.tolist()
    W = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    torch.testing.assert_close(rotation(w), torch.linalg.matrix_exp(W), rtol=0, atol=2e-15)
    torch.testing.assert_close(twist_at(w.roll(1)) @ torch.cat([w, w]), torch.cat([w + W @ w.roll(1), w]))
    # Jr(w) = int_0^1 exp(-s [w]x) ds: the corner of the exponential of [[-W, 1], [0, 0]]
    block = torch.zeros(6, 6, dtype=torch.float64)
    block[:3, :3], block[:3, 3:] = -W, torch.eye(3)
    torch.testing.assert_close(right_jacobian(w), torch.linalg.matrix_exp(block)[:3, 3:], rtol=0, atol=1e-14)


@pytest.mark.parametrize("angles", [(0.1, -0.2, 0.3), (4.0, -5.0, 6.0), (1.0, torch.pi / 2, 2.0), (-torch.pi, 0, 0.5)])
def test_roll_pitch_yaw_turns_about_fixed_axes_and_comes_back(angles: tuple[float, float, float]) -> None:
    expected = torch.from_numpy(Rotation.from_euler("xyz", angles).as_matrix())
    found = roll_pitch_yaw(*angles)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(roll_pitch_yaw(*se3.roll_pitch_yaw_angles(found)), expected, rtol=0, atol=1e-15)


def test_nearest_rotations_are_proper_and_nearest() -> None:
    matrices = draw(6, 3, 3, seed=2)
    assert bool((torch.linalg.det(matrices) < 0).any())  # reflections among them
    found = nearest_rotations(matrices)
    torch.testing.assert_close(found.mT @ found, torch.eye(3, dtype=torch.float64).expand(6, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(6, dtype=torch.float64), rtol=0, atol=1e-14)
    least = (found - matrices).square().sum((-2, -1))
    for others in (rotation(draw(3000, 1, 3, seed=3, size=2.0)), found @ rotation(draw(100, 1, 3, size=1e-3))):
        assert bool(((others - matrices).square().sum((-2, -1)) >= least).all())
