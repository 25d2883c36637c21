"""What joint values mean: signs, zeros, couplings and units are found by what they explain, else nothing is."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.conventions import socket_projector
from diffeo_calib.calibration.diagnostics.likely_mistakes import conventions_of
from diffeo_calib.measurements.csv.joints import JointExpressions
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.simulated_arm import SimulatedArm

UP, Y, X = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]


def robot(*joints: tuple[str, list[float], list[float], float, float], error: float = 0.0) -> dc.Chain:
    """Joints (kind, origin, axis, limits); origins differ by an error [m] from what is known of them."""
    generator, made = torch.Generator().manual_seed(3), []
    for k, (kind, origin, axis, low, high) in enumerate(joints):
        place = torch.eye(4, dtype=torch.float64)
        place[:3, 3] = torch.tensor(origin, dtype=torch.float64) + error * torch.randn(3, generator=generator)
        made.append(Joint(f"j{k + 1}", kind, place, torch.tensor(axis, dtype=torch.float64), lower=low, upper=high))
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


def measured(
    joints: tuple[tuple[str, list[float], list[float], float, float], ...], rows: int = 40
) -> tuple[Tensor, Tensor]:
    """Joint values (N, n) and a marker (N, 3) of a robot with errors of several mm, in another frame."""
    real, generator = robot(*joints, error=0.003), torch.Generator().manual_seed(1)
    low, high = real.limits.unbind(1)
    q = low + (high - low) * (0.2 + 0.6 * torch.rand(rows, real.n, generator=generator, dtype=torch.float64))
    poses = real(q)
    seen = poses[:, :3, 3] + poses[:, :3, :3] @ torch.tensor([0.03, -0.05, 0.08], dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    noise = 1e-4 * torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    return q, seen @ (turn * turn.det()).mT + 2.0 + noise


def found(
    joints: tuple[tuple[str, list[float], list[float], float, float], ...], q: Tensor, points: Tensor
) -> list[str]:
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
@pytest.mark.parametrize(
    ("meant", "texts"),
    [
        (
            lambda q: q.index_fill(1, torch.tensor([3]), 0.0) + torch.nn.functional.pad(-q[:, 3:4], (3, 3)),
            "a,b,c,-{d},e,f,g",
        ),
        (
            lambda q: q * (4096 / 360),
            "360/4096*{a},360/4096*{b},360/4096*{c},360/4096*{d},360/4096*{e},360/4096*{f},360/4096*{g}",
        ),
        (
            lambda q: (q + math.pi) * (4096 / 360),
            "360/4096*{a},360/4096*{b}+180,360/4096*{c}+180,360/4096*{d}+180,360/4096*{e}+180,360/4096*{f}+180,"
            "360/4096*{g}",
        ),
        (lambda q: q * torch.tensor([1, 1, 1, 100, 1, 1, 1]), "a,b,c,1/100*{d},e,f,g"),
        (lambda q: q[:, [0, 1, 2, 5, 4, 3, 6]], "a,b,c,f,e,d,g"),
    ],
)
def test_a_seven_axis_arm(meant: object, texts: str) -> None:
    q, points = measured(SEVEN)
    assert texts in found(SEVEN, meant(q), points)  # pyright: ignore[reportCallIssue]


@pytest.mark.slow
def test_one_zero_of_all_joints_is_plainer_than_signs() -> None:
    """Of ticks that count half a turn at zero; a spherical wrist could count the other way instead."""
    arm = SimulatedArm(seed=1)
    q, points = arm.measure(40, seed=2)
    data = dc.Measurements((q + math.pi) * 4096 / 360, points, doubt=False)
    (one,) = conventions_of(arm.nominal, data, "deg")
    texts = one.texts(list("abcdef"), "deg", 1.0)
    assert texts == ["360/4096*{a}", *(f"360/4096*{{{name}}}+180" for name in "bcde"), "360/4096*{f}"]


@pytest.mark.slow
def test_shares_of_the_limits_that_look_like_degrees() -> None:
    """-100..100; the factor of the last joint trades with the robot's errors of several mm."""
    q, points = measured(SEVEN)
    (text,) = found(SEVEN, q / torch.tensor([2.9, 2.0, 2.9, 2.0, 2.9, 2.0, 3.0]) * math.radians(100.0), points)
    assert text.startswith("1.66158*{a},1.14592*{b},1.66158*{c},1.14592*{d},1.66158*{e},1.14592*{f},1.7")


@pytest.mark.slow
def test_meanings_that_rows_do_not_tell_apart_are_all_named() -> None:
    """A spherical wrist: the middle joint counts the other way, or the one before it half a turn further."""
    arm = SimulatedArm(seed=1)
    q, points = arm.measure(40, seed=2)
    q[:, 4] *= -1
    data = dc.Measurements(q, points)
    texts = [one.texts(list("abcdef"), "rad", 1.0) for one in conventions_of(arm.nominal, data, "rad")]
    assert ["a", "b", "c", "d", "-{e}", "f"] in texts
    assert ["a", "b", "c", "{d}+pi", "e", "f"] in texts
    assert len(texts) == 2


@pytest.mark.slow
def test_joint_three_against_the_floor() -> None:
    arm = SimulatedArm(seed=1, markers=3)
    q, points = arm.measure(30, seed=2)
    q[:, 2] += q[:, 1]
    points[[3, 8, 20], [0, 1, 2]] = torch.nan
    (one,) = conventions_of(arm.nominal, dc.Measurements(q, points), "deg")
    assert one.texts(list("abcdef"), "deg", 1.0) == ["a", "b", "-{b}+{c}", "d", "e", "f"]


def test_a_socket_explains_one_place() -> None:
    socket = torch.tensor([0, 2, 0, 2, 1])
    P = socket_projector(socket)
    assert float((P @ (socket[:, None] == socket.unique()).double()).abs().max()) < 1e-12
    assert float(P.trace()) == pytest.approx(2.0)
