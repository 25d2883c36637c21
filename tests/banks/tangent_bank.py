"""The tangent model of a robot written a second time, with gravity, geometric priors and every kind of noise."""

from dataclasses import replace
from functools import cache
from math import pi

import torch
from numbers_bank import drawn, normal, tensor
from product_bank import erring, joint_covariance, simulated_poses, sliding_robot
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots import DHRow, SimulatedArm
from diffeo_calib.robots.tree import Tree


class Setting:
    """Measurements after the geometric calibration, from which scales are chosen."""

    def __init__(self, robot: Tree, data: dc.Measurements) -> None:
        self.data = data
        registration = register(robot, data.q, data.points)
        self.identification = identify(registration.geometry, data.q, data.points)
        nominal = GeometryMap(registration.geometry, elastic=True)
        deflection = torch.zeros(nominal.parameters - nominal.geometry.size, dtype=torch.float64)
        theta = torch.cat([self.identification.theta, deflection])
        sensor = NoiseModel.of(data, self.identification.noise)
        tails = Tails.none(len(data), sensor.bodies)
        self.tangent_data = TangentData(nominal, theta, data.q, data.points.flatten(1), sensor, tails)
        self.scales = defaults(self.tangent_data, self.identification.noise, self.identification.prior)

    @property
    def nominal(self) -> GeometryMap:
        return self.tangent_data.nominal


def two_markers() -> Setting:
    arm = SimulatedArm(seed=3, markers=2)
    return Setting(arm.nominal, dc.Measurements(*arm.measure(14, seed=4)))


def sliding() -> Setting:
    return Setting(sliding_robot(), erring(sliding_robot(), 25))


def posed() -> Setting:
    arm, data, _ = simulated_poses(12)
    poses = data.poses
    assert poses is not None
    known = dc.Measurements.from_poses(data.q, poses, position_std=2e-5, rotation_std=1e-4)
    return Setting(arm.nominal, known)


def mimicking() -> Setting:
    """Four axes and a parallelogram, as in robots that load pallets."""
    rows = [
        DHRow(0.15, -pi / 2, 0.4),
        DHRow(0.6, 0.0, 0.0),
        DHRow(0.5, 0.0, 0.0),
        DHRow(0.1, -pi / 2, 0.0, mimic={"joint_2": -1.0, "joint_3": -1.0}),
        DHRow(0.0, 0.0, -0.1),
    ]
    robot = dc.from_dh(rows, name="palletizer")
    return Setting(robot, erring(robot, 24))


SETTINGS = {"two markers": two_markers, "sliding": sliding, "posed": posed, "mimic joint": mimicking}


@cache
def built(name: str) -> Setting:
    """Every setting once."""
    return SETTINGS[name]()


def shaken(scales: dc.Hyperparameters, seed: int, size: float = 0.5) -> dc.Hyperparameters:
    """Other scales nearby."""
    vector = scales.logarithms()
    return scales.from_logarithms(vector + size * normal(len(vector), seed=seed))


def weighted(setting: Setting, seed: int = 0) -> TangentData:
    """The same measurements with weights of any size, and a nominal map that sags under gravity."""
    data = setting.tangent_data
    weights = 0.05 + 1.45 * drawn(*data.tails.weights.shape, seed=seed)
    theta = data.theta.clone()
    theta[data.nominal.geometry.size :] = normal(len(theta) - data.nominal.geometry.size, seed=seed, size=1e-3)
    return replace(data, theta=theta, tails=Tails(4.0, weights))


def prior_covariance(data: TangentData, scales: dc.Hyperparameters) -> Tensor:
    """Of all numbers of the rows, hidden ones too, by fields, unknowns and shared shifts: (N r, N r)."""
    at = data.numbers(scales).at
    S = at.sensitivity.flatten(0, 1)
    return at.fields.gram() + (S * data.unknowns_variance(scales)) @ S.T


def covariance(data: TangentData, scales: dc.Hyperparameters) -> Tensor:
    """The same with noise."""
    return prior_covariance(data, scales) + torch.block_diag(*data.noise_of_numbers(scales))


def places(chain: Tree) -> list[int]:
    """Frames (the tip's last) that are not always in the point where the frame before is."""
    origins = _origins(chain, 2 * drawn(9, chain.n) - 1)
    steps = (origins[:, 1:] - origins[:, :-1]).norm(dim=-1).amax(0)
    return [k + 1 for k, step in enumerate(steps.tolist()) if step > 1e-6]


def _origins(chain: Tree, q: Tensor) -> Tensor:
    return torch.cat([chain.joint_frames(q)[..., :3, 3], chain(q)[:, None, :3, 3]], 1)


def _turns(axis: Tensor) -> list[Tensor]:
    """The axis and two unit vectors across it."""
    helper = torch.eye(3, dtype=torch.float64)[int(axis.abs().argmin())]
    across = torch.linalg.cross(axis, helper)
    across = across / across.norm()
    return [axis, across, torch.linalg.cross(axis, across)]


def gravity_covariance(scales: dc.Hyperparameters, nominal: GeometryMap, theta: Tensor, x: Tensor) -> Tensor:
    """Of the deflections under gravity, loads drawn from their priors: (N m, N m)."""
    chain = nominal.geometry.chain
    origins, frames = _origins(chain, x), chain.joint_frames(x)
    twists = nominal.sensitivities(x, theta)[..., 6 : 6 + 6 * chain.moving].unflatten(-1, (-1, 6))
    m = twists.shape[1]
    total = torch.zeros(len(x) * m, len(x) * m, dtype=torch.float64)

    def add(effect: Tensor, feature: Tensor, deviation: Tensor) -> None:
        nonlocal total
        columns = (deviation * scales.gravity * effect[..., None] * feature[:, None]).flatten(0, 1)
        total = total + columns @ columns.mT

    for joint, axis in enumerate(chain.axes):
        turning, R = bool(chain.revolute[joint]), frames[:, joint, :3, :3]
        if not turning:
            add(twists[:, :, joint, :3] @ axis, R @ axis, scales.compliance[joint])
        for number, turn in enumerate(_turns(axis)):
            own = turning and number == 0
            deviation = (scales.compliance if own else scales.lateral_compliance)[joint]
            for place in places(chain):
                if place > joint:
                    arm = origins[:, place] - origins[:, joint]
                    add(twists[:, :, joint, 3:] @ turn, torch.linalg.cross(R @ turn, arm), deviation)
    return total


def tangent_covariance(scales: dc.Hyperparameters, nominal: GeometryMap, theta: Tensor, x: Tensor) -> Tensor:
    """G = Dk0 K_V Dk0^T + K_W + S_geometry Lambda^-1 S_geometry^T + gravity: (N m, N m)."""
    geometry = nominal.geometry
    J, y = nominal.jacobian(x, theta), nominal(x, theta).unflatten(1, (-1, 3))
    G = torch.einsum("ial,ijl,jbl->iajb", J, joint_covariance(scales, x, x, geometry.chain.periodic), J)
    for k in range(geometry.markers):
        for h in range(geometry.markers):
            r2 = (y[:, None, k] - y[None, :, h]).square().sum(-1) / scales.task_lengthscale**2
            for axis in range(3):
                G[:, 3 * k + axis, :, 3 * h + axis] += scales.task_amplitude**2 * (-r2 / 2).exp()
    shift, turn = float(scales.translation_errors), float(scales.rotation_errors)
    each = [0.1] * 6 + ([shift] * 3 + [turn] * 3) * geometry.chain.moving + [0.1] * 3 * geometry.markers
    S = nominal.sensitivities(x, theta)[..., : geometry.size].flatten(0, 1) * tensor(each)
    return G.reshape(len(S), len(S)) + S @ S.mT + gravity_covariance(scales, nominal, theta, x)


def noise_covariance(scales: dc.Hyperparameters, setting: Setting, theta: Tensor, weights: Tensor) -> Tensor:
    """R_i of markers or poses, divided by their weights: (N, m, m)."""
    data = setting.data
    J = setting.nominal.jacobian(data.q, theta)
    m = J.shape[1]
    R = torch.einsum("ial,l,ibl->iab", J, scales.joint_noise**2, J)
    if data.poses is None:
        R += (scales.sensor_noise**2 + 1e-14) * torch.eye(m, dtype=torch.float64)
        w = weights.repeat_interleave(3, 1)
    else:
        assert data.lever is not None
        slack = 0.1 * setting.identification.noise
        if data.covariance is not None:  # 0.3 of the smallest known deviation of poses, of 6 freedoms in 9
            smallest = torch.linalg.eigvalsh(data.covariance)[:, 3]
            smallest = smallest[smallest > 1e-14]
            slack = min(slack, 0.3 * float(smallest.median().sqrt())) if len(smallest) else slack
        R += (slack**2 + 1e-14) * torch.eye(m, dtype=torch.float64)
        modes = body_modes(data.poses, data.lever)
        for k in range(6):
            size = scales.sensor_noise if k < 3 else scales.rotation_noise
            R += size**2 * modes[:, :, k, None] * modes[:, None, :, k]
        w = weights.expand(-1, m)
    if data.covariance is not None:
        R += data.covariance
    return R / (w[:, :, None] * w[:, None, :]).sqrt()


def body_modes(poses: Tensor, lever: float, h: float = 1e-4) -> Tensor:
    """What shifts and turns of a pose do to its points, by central differences: (N, 9, 6)."""
    columns = []
    for step in torch.eye(6, dtype=torch.float64):
        ends = []
        for d in (h * step, -h * step):
            x, y, z = d[3:].tolist()
            turn = torch.linalg.matrix_exp(tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
            moved = poses.clone()
            moved[:, :3] = torch.cat([turn @ poses[:, :3, :3], poses[:, :3, 3:] + d[:3, None]], 2)
            ends.append(mark_points(moved, lever).flatten(1))
        columns.append((ends[0] - ends[1]) / (2 * h))
    return torch.stack(columns, 2)
