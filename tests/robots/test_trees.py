"""Robots with branches: against pinocchio, against serial chains, against derivatives, and their descriptions."""

import json

import numpy as np
import pinocchio as pin
import pytest
import torch
from simulated_body import URDF_FILE
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, RobotError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.robots.se3 import skew
from diffeo_calib.robots.tree import Chain, Tree, robot_from_config

HANDS = ["left_hand", "right_hand"]
VIEWS = {
    "both hands": ("pelvis", HANDS, []),
    "one hand, the other as load": ("pelvis", ["left_hand"], ["right_hand"]),
    "hand to hand": ("left_hand", ["right_hand"], []),
    "hand to hand on a torso": ("left_hand", ["right_hand"], ["pelvis"]),
    "hand to pelvis": ("right_hand", ["pelvis"], ["left_hand"]),
    "from the middle": ("chest", ["left_hand", "pelvis"], ["right_hand"]),
}


@pytest.fixture(params=VIEWS.values(), ids=VIEWS.keys())
def robot(request: pytest.FixtureRequest) -> Tree:
    base, tips, loads = request.param
    return dc.load_urdf(URDF_FILE, base, tips, loads)


def draw(robot: Tree, count: int, seed: int = 0) -> Tensor:
    """Configurations (count, n)."""
    lower, upper = robot.limits.unbind(1)
    rng = torch.Generator().manual_seed(seed)
    return lower + (upper - lower) * torch.rand(count, robot.n, dtype=torch.float64, generator=rng)


def geometry_map(robot: Tree, seed: int = 0) -> tuple[GeometryMap, Tensor]:
    """An elastic robot with two markers on every tip, and random parameters."""
    rng = torch.Generator().manual_seed(seed)
    on = tuple(tip for tip in robot.tips for _ in range(2))
    tool = 0.1 * torch.randn(len(on), 3, dtype=torch.float64, generator=rng)
    nominal = GeometryMap(Geometry.nominal(robot).with_tool(tool, on), elastic=True)
    return nominal, 1e-3 * torch.randn(nominal.parameters, dtype=torch.float64, generator=rng)


# --- kinematics ---------------------------------------------------------------------------------------------------


def test_poses_agree_with_pinocchio(robot: Tree) -> None:
    model = pin.buildModelFromUrdf(str(URDF_FILE))
    data, q = model.createData(), draw(robot, 20)
    values = dict(zip(robot.joint_names, q.T, strict=True))
    for row in range(len(q)):
        configuration = np.zeros(model.nq)
        for name, column in values.items():
            configuration[model.joints[model.getJointId(name)].idx_q] = column[row]
        configuration[model.joints[model.getJointId("upright")].idx_q] = -values.get("bend", torch.zeros(len(q)))[row]
        pin.forwardKinematics(model, data, configuration)
        pin.updateFramePlacements(model, data)
        base = data.oMf[model.getFrameId(robot.base)].homogeneous
        for number, tip in enumerate(robot.tips):
            expected = np.linalg.inv(base) @ data.oMf[model.getFrameId(tip)].homogeneous
            torch.testing.assert_close(robot.tip_poses(q)[row, number], torch.from_numpy(expected), rtol=0, atol=1e-12)


def test_shapes_of_one_tip_and_of_several() -> None:
    q = draw(dc.load_urdf(URDF_FILE, "pelvis", HANDS), 3)
    both, left = dc.load_urdf(URDF_FILE, "pelvis", HANDS), dc.load_urdf(URDF_FILE, "pelvis", "left_hand", HANDS[1])
    assert both(q).shape == (3, 2, 4, 4)
    assert both.jacobian(q).shape == (3, 2, 6, 17)
    assert left(q).shape == (3, 4, 4)
    assert left.jacobian(q).shape == (3, 6, 17)
    torch.testing.assert_close(both(q)[:, 0], left(q), rtol=0, atol=0)
    with pytest.warns(DiffeoCalibWarning, match=r"are left out: 'right_shoulder_pitch'.*; pass load=\['right_hand'\]"):
        serial = dc.load_urdf(URDF_FILE, "pelvis", "left_hand")
    assert isinstance(serial, Chain)
    assert serial.n == 10
    torch.testing.assert_close(serial(q[:, :10]), left(q), rtol=0, atol=0)


def test_jacobians_are_derivatives(robot: Tree) -> None:
    q = draw(robot, 3)
    places = torch.func.vmap(torch.func.jacrev(lambda row: robot.tip_poses(row[None])[0, :, :3, 3]))(q)
    found = robot.jacobian(q).view(3, len(robot.tips), 6, robot.n)
    torch.testing.assert_close(found[:, :, :3], places, rtol=0, atol=1e-14)
    turned = torch.func.vmap(torch.func.jacrev(lambda row: robot.tip_poses(row[None])[0, :, :3, :3]))(q)
    spin = torch.einsum("ntabj,ntcb->ntacj", turned, robot.tip_poses(q)[..., :3, :3])
    torch.testing.assert_close(
        found[:, :, 3:],
        torch.stack([spin[..., 2, 1, :], spin[..., 0, 2, :], spin[..., 1, 0, :]], 2),
        rtol=0,
        atol=1e-14,
    )


def test_errors_and_sag_have_exact_derivatives(robot: Tree) -> None:
    nominal, theta = geometry_map(robot)
    q = draw(robot, 3)
    by_joint = torch.func.vmap(torch.func.jacrev(lambda row: nominal(row[None], theta)[0]))(q)
    torch.testing.assert_close(nominal.jacobian(q, theta), by_joint, rtol=0, atol=1e-13)
    by_theta = torch.func.jacrev(lambda values: nominal(q, values))(theta)
    torch.testing.assert_close(nominal.sensitivities(q, theta), by_theta, rtol=0, atol=1e-13)


# --- gravity ------------------------------------------------------------------------------------------------------


def moment_about(robot: Tree, q: Tensor, joint: int, e: Tensor, masses: Tensor) -> Tensor:
    """e . sum (o_f - o_l) x m_f g over what the joint moves on the ground, by a second derivation: potential energy.

    The moment is minus the derivative of the masses' potential energy by a turn of everything that the joint carries.
    """
    ground = robot.ground_place
    places = robot.places(q)
    places = places if ground is None else torch.linalg.inv(places[:, ground])[:, None] @ places
    frame = places[:, joint]
    axis = (frame[:, :3, :3] @ e[:, None])[..., 0]
    carried = torch.from_numpy(robot.arrays.moved[:, joint]).to(q)
    h = 1e-5
    energies = []
    for sign in (1.0, -1.0):
        turn = torch.matrix_exp(sign * h * skew(axis))
        arms = places[..., :3, 3] - frame[:, None, :3, 3]
        moved = (turn[:, None] @ arms[..., None])[..., 0]
        energies.append(((masses * carried)[:, None] * 9.81 * moved)[..., 2].sum(1))
    return (energies[1] - energies[0]) / (2 * h)


def test_features_are_moments_of_everything_that_a_joint_carries(robot: Tree) -> None:
    sag, q = GravitySag(robot), draw(robot, 12)
    rng = torch.Generator().manual_seed(1)
    masses = torch.rand(len(robot.before), dtype=torch.float64, generator=rng)
    masses[~torch.from_numpy(robot.arrays.moved).any(1)] = 0.0
    features = sag.features(q).split([c.size for c in sag.compliances], dim=1)
    for compliance, values in zip(sag.compliances, features, strict=True):
        only = torch.zeros_like(masses)
        places = list(compliance.places)
        only[places] = masses[places]
        expected = moment_about(robot, q, compliance.joint, torch.from_numpy(compliance.axis), only)
        found = -9.81 * (values.view(len(q), -1, 3)[..., 2] * masses[places]).sum(1)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)


# --- descriptions -------------------------------------------------------------------------------------------------


def test_descriptions_come_back(robot: Tree) -> None:
    again = robot_from_config(json.loads(json.dumps(robot.to_config())))
    assert type(again) is type(robot)
    assert repr(again) == repr(robot)
    q = draw(robot, 4)
    torch.testing.assert_close(again.places(q), robot.places(q), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("tips", "loads", "message"),
    [
        ([], [], "`tip`: expected the name of a link, or a list of names"),
        (["left_hand", "left_hand"], [], r"`tip` names \['left_hand'\] twice"),
        (["left_hand"], ["left_hand"], r"`load` names \['left_hand'\], which `tip` names too"),
        (["left_hand"], ["tail"], "`load`: .* has no link 'tail'"),
        (["left_hand", "pelvis"], [], "has no moving joint from 'pelvis' to 'pelvis'"),
    ],
)
def test_wrong_ends_are_explained(tips: list[str], loads: list[str], message: str) -> None:
    with pytest.raises((InputError, RobotError), match=message):
        dc.load_urdf(URDF_FILE, "pelvis", tips, loads)
