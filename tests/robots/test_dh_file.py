"""Files with a Denavit-Hartenberg table: spellings, orders, units, conventions; and what is said about broken ones."""

import warnings
from collections.abc import Sequence
from math import pi
from pathlib import Path

import pytest
import torch

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots import DHRow, from_dh
from diffeo_calib.robots.dh_file import DHFile

ROWS = [
    DHRow(0.05, -pi / 2, 0.4, 0.0, lower=-3.0, upper=2.5),
    DHRow(0.43, 0.0, -0.02, -pi / 2),
    DHRow(0.0, pi / 2, 0.15, 0.0, "prismatic"),
    DHRow(-0.01, -pi / 2, 0.0, pi),
]
"""Of an invented arm."""
Q = torch.tensor([[0.3, -0.7, 0.2, 1.1], [-1.2, 0.4, -0.1, 0.6]], dtype=torch.float64)


def lines(sep: str, header: str, cells: Sequence[Sequence[object]], before: str = "") -> str:
    return "\n".join([*before.splitlines(), header, *(sep.join(map(str, row)) for row in cells)])


def in_degrees(*values: float) -> list[str]:
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
        [
            [f"A{k}", r.kind[0].upper(), *in_degrees(r.alpha), 1e3 * r.a, 1e3 * r.d, *in_degrees(r.theta)]
            for k, r in enumerate(ROWS)
        ],
    ).replace(".", ","),
    "units without brackets, a comment": lines(
        "\t",
        "i\ta_mm\tsigma\td_mm\talpha_deg\ttheta_deg\tmass",
        [
            [k + 1, 1e3 * r.a, int(r.kind[0] == "p"), 1e3 * r.d, *in_degrees(r.alpha, r.theta), 3]
            for k, r in enumerate(ROWS)
        ],
        "# measured in 2019",
    ),
    "units by size": lines(
        ",",
        "kind,a,alpha,d,theta",
        [[r.kind, 1e3 * r.a, *in_degrees(r.alpha), 1e3 * r.d, *in_degrees(r.theta)] for r in ROWS],
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
    (tmp_path / "arm.csv").write_text(FILES[name], encoding="utf-8")
    table = DHFile.read(tmp_path / "arm.csv")
    assert not table.convention
    for convention in ("standard", "craig"):
        chain = table.chain(convention)
        torch.testing.assert_close(chain(Q), from_dh(ROWS, convention)(Q), rtol=0, atol=1e-10)
        assert chain.kinds == ("revolute", "revolute", "prismatic", "revolute")
    assert (chain.name, chain.base, chain.tip) == ("arm", "base", "tip")
    first = "A0" if "makers" in name else "joint_1"
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


@pytest.mark.parametrize(
    "text", ["# last modified: 2024", "# with the standard deviation of parameters", "# a standard"]
)
def test_words_with_another_meaning_are_no_convention(text: str, tmp_path: Path) -> None:
    path = tmp_path / "ur10_modified.csv"
    path.write_text(lines(",", "joint,theta,d,a,alpha", [["index_proximal", 0, 1, 0.2, 1.5708]], text))
    assert not DHFile.read(path).convention
    path.write_text(f"# modified\n{path.read_text()}")
    table = DHFile.read(path)
    assert table.convention == "craig"
    assert table.chain("standard").n == table.chain().n == 1


def test_cells_of_slides_limits_and_tables_in_text(tmp_path: Path) -> None:
    rows = [["0", "PI/2", "q1 + 0.15", "0", "0", "0.5"], ["0", "-PI/2", "0", "0", "-170", "170"]]
    (tmp_path / "arm.md").write_text(lines("|", "a|alpha|d|theta|min|max", [["---", ":-:", "-", "-", "-", "-"], *rows]))
    chain = DHFile.read(tmp_path / "arm.md").chain("standard")
    assert chain.kinds == ("prismatic", "revolute")
    torch.testing.assert_close(chain.limits[:, 1], torch.tensor([0.5, 170 * pi / 180], dtype=torch.float64))


def test_limits_and_a_tip_before_the_last_row(tmp_path: Path) -> None:
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
        ("", "is no DH table"),
        ("a,alpha,d,theta\n", "expected rows of 4 cells, one column of each kind, got no row"),
        ("a,alpha,d,theta\n0,1.5708,0\n", "expected rows of 4 cells"),
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
    near = [
        (0.0, 1.5709, 0.09, 0.0),
        (-0.43, 0.0005, -187.25, 0.1),
        (-0.39, -0.0071, 186.6, 6.6),
        (0.0, 1.57, 0.79, 0.0),
    ]
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
