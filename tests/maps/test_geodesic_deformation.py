"""k1 = psi o k0 o phi^-1: its derivative, limits and linearisation; rows of several kinds as one observation; noise."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from fit_bank import random_start, shared_noise
from math_bank import (
    K_V,
    K_W,
    case_named,
    central_difference,
    circle,
    line,
    naive_rk4,
    normal,
    rows_jacobian,
    slopes,
    spatial_markers,
    tensor,
    two_marker_problem,
    uniform,
)
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.maps import linearisation
from diffeo_calib.maps.deformation import ModelSpec, Momenta, finite
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise, measured_coordinates, without_hidden
from diffeo_calib.maps.nominal import NominalMap, SmoothMap
from diffeo_calib.maps.observation import LinearFunctionals, Part, ReadPoints, Stacked
from diffeo_calib.sensors.range import FixedPoints

N = 6
EMPTY = torch.zeros(0, dtype=torch.float64)


class Warped(NominalMap):
    """Two markers in the plane with three parameters that enter non-linearly."""

    parameters = 3

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        t = x[:, :1] + theta[0] * x[:, 1:2].cos()
        first = torch.cat([t.cos() + theta[1] * x[:, 1:2], t.sin()], 1)
        return torch.cat([first, first * (1 + theta[2]) + 0.2 * x[:, 1:2].sin()], 1)

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        return SmoothMap(lambda at: self(at, theta)).jacobian(x, EMPTY)

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        jacobian = torch.autograd.functional.jacobian(lambda at: self(x, at), theta)
        assert isinstance(jacobian, Tensor)
        return jacobian


def three_joints(x: Tensor) -> Tensor:
    """A prismatic and two revolute joints, tip in R^2."""
    t = x[:, 1] + x[:, 2]
    return torch.stack([x[:, 0] + x[:, 1].cos() + 0.5 * t.cos(), x[:, 1].sin() + 0.5 * t.sin()], -1)


@dataclass(frozen=True)
class Arm:
    """A model and a sampler of its configurations."""

    spec: ModelSpec
    points: Callable[[int, int], Tensor]
    markers: int

    @property
    def joints(self) -> int:
        return self.points(1, 0).shape[1]

    @property
    def outputs(self) -> int:
        return self.spec.task_dim * self.markers

    def momenta(self, size: float) -> Momenta:
        k = self.spec.nominal.parameters
        return Momenta(
            size * normal(N, self.joints, seed=3),
            size * normal(N * self.markers, self.spec.task_dim, seed=4),
            size * normal(k, seed=5),
        )

    def deform(self, size: float = 0.1, steps: int = 2) -> GeodesicDeformation:
        return GeodesicDeformation(self.spec, self.points(N, 2), self.momenta(size), RK4(steps))


def _torus(count: int, seed: int) -> Tensor:
    return uniform(count, 2, seed=seed)


def _spec(nominal: NominalMap | Callable[[Tensor], Tensor], joint: Kernel, task: Kernel, dim: int) -> ModelSpec:
    nominal = nominal if isinstance(nominal, NominalMap) else SmoothMap(nominal)
    return ModelSpec(nominal, joint, task, tensor([0.3, 0.7, 0.2])[: nominal.parameters], dim)


SLIDING = dc.Gaussian([1.1, 0.8], [0.4, 0.3], space=circle(1) * line(1))
ARMS = {
    "two spatial markers": Arm(
        _spec(spatial_markers, SLIDING, dc.Matern(0.7, 3.5, 0.6), 3),
        lambda count, seed: uniform(count, 2, seed=seed) * tensor([1.0, 0.1]),
        2,
    ),
    "mixed joints": Arm(
        _spec(three_joints, case_named("sum").kernel, dc.Cauchy([0.9, 1.2]), 2),
        lambda count, seed: uniform(count, 3, seed=seed) * tensor([0.3, 1.0, 1.0]),
        1,
    ),
    "parameters": Arm(_spec(Warped(), K_V, K_W, 2), _torus, 2),
}
every_arm = pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS.keys())


@every_arm
def test_composition_of_naive_flows(arm: Arm) -> None:
    """psi(k0(phi^-1(x))) written out with the fields of two naive geodesics; controls have their own images."""
    deformation, x = arm.deform(), arm.points(9, 1)
    torch.testing.assert_close(deformation(deformation.x), deformation.z1, rtol=0, atol=1e-13)

    def carried(kernel: Kernel, q: Tensor, a: Tensor, points: Tensor) -> Tensor:
        def field(state: Tensor) -> Tensor:
            live, momenta = state[: len(q)], state[len(q) : 2 * len(q)]
            velocity, slope = kernel.gradient(live, momenta, live, momenta)
            return torch.cat([velocity, -slope, kernel.field(state[2 * len(q) :], live, momenta)])

        return naive_rk4(field, torch.cat([q, a, points]), 2)[-1][2 * len(q) :]

    b, p, theta = deformation.momenta.tensors
    xi = carried(arm.spec.joint_kernel, deformation.x, b, deformation.x)
    z0 = arm.spec.nominal(xi, theta).reshape(-1, arm.spec.task_dim)
    z = arm.spec.nominal(carried(arm.spec.joint_kernel, deformation.x, b, x), theta).reshape(-1, arm.spec.task_dim)
    expected = carried(arm.spec.task_kernel, z0, p, z).reshape(9, -1)
    torch.testing.assert_close(deformation(x), expected, rtol=1e-12, atol=1e-13)


@every_arm
def test_jacobian(arm: Arm) -> None:
    deformation, x, dx = arm.deform(), arm.points(9, 1), normal(9, arm.joints, seed=6)
    jacobian = deformation.jacobian(x)
    assert jacobian.shape == (9, arm.outputs, arm.joints)
    torch.testing.assert_close(jacobian, rows_jacobian(deformation, x), rtol=1e-11, atol=1e-12)
    difference = central_difference(deformation, x, dx)
    torch.testing.assert_close((jacobian @ dx[:, :, None])[:, :, 0], difference, rtol=1e-9, atol=1e-9)


@every_arm
def test_tangent_limit(arm: Arm) -> None:
    """k1(eps b, eps p, eps theta) - (k0 + eps (Dk0 K_V b + K_W p + S theta)) = O(eps^2)."""
    x, unit = arm.points(N, 2), arm.momenta(1.0)
    zero = torch.zeros_like(unit.theta)
    k0, dk0, s = (f(x, zero) for f in (arm.spec.nominal, arm.spec.nominal.jacobian, arm.spec.nominal.sensitivities))
    marker = k0.reshape(-1, arm.spec.task_dim)
    v = (arm.spec.joint_kernel.matrix(x, x) @ unit.joint.flatten()).view_as(x)
    w = (arm.spec.task_kernel.matrix(marker, marker) @ unit.task.flatten()).view_as(k0)
    first = torch.einsum("imn,in->im", dk0, v) + w + s @ unit.theta
    errors = [float((arm.deform(eps).z1 - k0 - eps * first).norm()) for eps in (4e-3, 2e-3, 1e-3)]
    assert slopes(errors) == pytest.approx([2.0, 2.0], abs=0.15)
    small = arm.deform(1e-6)  # the response to its own fields, at its controls and elsewhere
    whole = small.linear_response(small.linearise())
    torch.testing.assert_close(whole, 1e-6 * first, rtol=1e-4, atol=1e-10)
    some = small.linear_response(small.linearise(x[1:4]), elsewhere=True)
    torch.testing.assert_close(some, whole[1:4], rtol=1e-11, atol=1e-18)


def perturbed(arm: Arm, x: Tensor, steps: int, eps: float, where: str) -> Tensor:
    """k1(x) along the flows of an :class:`Arm` when one field is changed to v + eps u, u fixed in time."""
    start = arm.deform(0.1, steps)

    def flow(points: Tensor, kernel: Kernel, controls: Tensor, push: float) -> Tensor:
        def field(state: Tensor) -> Tensor:
            count = (len(state) - len(points)) // 2
            q, a, moving = state[:count], state[count : 2 * count], state[2 * count :]
            velocity, slope = kernel.gradient(q, a, q, a)
            return torch.cat([velocity, -slope, kernel.field(moving, q, a) + push * disturbance(moving)])

        return naive_rk4(field, torch.cat([*controls, points]), steps)[-1][-len(points) :]

    theta = start.momenta.theta
    if where == "theta":
        theta = theta + eps * tensor([0.4, -0.3, 0.8])
    xi = flow(x, arm.spec.joint_kernel, start.joint_flow.nodes[0], eps if where == "x" else 0.0)
    z0 = arm.spec.nominal(xi, theta)
    markers = z0.reshape(-1, arm.spec.task_dim)
    return flow(markers, arm.spec.task_kernel, start.task_flow.nodes[0], eps if where == "y" else 0.0).view_as(z0)


def disturbance(points: Tensor) -> Tensor:
    return torch.stack([(1.3 * points.sum(-1) + k).sin() for k in range(points.shape[-1])], -1)


SLOW = {"mixed joints": [pytest.mark.slow]}


@pytest.mark.parametrize("arm", [pytest.param(arm, id=name, marks=SLOW.get(name, ())) for name, arm in ARMS.items()])
@pytest.mark.parametrize("where", ["x", "y", "theta"])
def test_linearisation_in_path_space(arm: Arm, where: str) -> None:
    """The derivative of k1 when a field changes along the whole path: sum_s c_s Theta_s u(chi_s), order 4."""
    if where == "theta" and not arm.spec.nominal.parameters:
        return
    x, eps, errors = arm.points(4, 7), 1e-3, []
    values = [perturbed(arm, x, 8, k * eps, where) for k in (-1, 1, -2, 2)]
    expected = (8 * (values[1] - values[0]) - (values[3] - values[2])) / (12 * eps)
    for steps in (2, 4):
        lin = arm.deform(0.1, steps).linearise(x)
        if where == "theta":
            actual = lin.sensitivity @ tensor([0.4, -0.3, 0.8])
        else:
            nodes = lin.joint if where == "x" else lin.task
            actual = sum((p.response(disturbance(p.points)).reshape(4, -1) for p in nodes), torch.zeros(()))
        errors.append(float((actual - expected).abs().max()))
    assert errors[-1] <= 1e-4 * float(expected.abs().max())
    assert slopes(errors)[0] >= 3.3


@every_arm
def test_momenta_are_the_end_momentum_transported_to_the_start(arm: Arm) -> None:
    """b = Theta_0^T mu, p = Phi_0^T mu, with Theta_0 = Dk1 of the whole path and Phi_0 = Dpsi."""
    deformation, mu = arm.deform(0.2), normal(N, arm.outputs, seed=9)
    b, p, theta = deformation.linearise().momenta(mu).tensors
    torch.testing.assert_close(b, torch.einsum("imn,im->in", deformation.jacobian(deformation.x), mu))
    points = deformation.z0.reshape(-1, arm.spec.task_dim)
    d_psi = rows_jacobian(deformation.task_flow, points)
    torch.testing.assert_close(p, torch.einsum("ikl,ik->il", d_psi, mu.reshape(points.shape)))
    s = arm.spec.nominal.sensitivities(deformation.xi, deformation.momenta.theta)
    s = (d_psi @ s.reshape(len(points), arm.spec.task_dim, -1)).reshape(s.shape)
    torch.testing.assert_close(theta, arm.spec.prior_variance * torch.einsum("imk,im->k", s, mu))


@pytest.mark.parametrize("value", [1e200, -1e80, float("inf"), float("nan")])
def test_ends_too_large_to_compute_with_are_overflows(value: float) -> None:
    """Kinematics refuse them as bad input: a trial step of a fit must end as one that is too long."""
    with pytest.raises(NumericalError, match="the flow overflows: the momenta are too large"):
        finite(tensor([[0.0, value]]), "the flow overflows")


def test_a_flow_that_folds_space_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    deformation = ARMS["parameters"].deform(0.2)
    points, jacobians = deformation.joint_flow.path(deformation.x)
    monkeypatch.setattr(deformation.joint_flow, "path", lambda _: (points, [0.0 * each for each in jacobians]))
    with pytest.raises(NumericalError, match="folds space"):
        deformation.linearise(deformation.x)


PROBLEM = two_marker_problem(uniform(9, 2, seed=1))
DEFORMED = PROBLEM.deform(random_start(PROBLEM), dc.RK4(2))


@pytest.mark.parametrize("rows", [1, 4])
def test_covariance_with_itself_is_that_with_an_equal_one(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """By blocks below the diagonal and their transposes, the last one smaller."""
    at = DEFORMED.linearise()
    expected = at.gram(replace(at))
    monkeypatch.setattr(linearisation, "GRAM_ROWS", rows)
    assert_close(at.gram(), expected, rtol=0, atol=1e-14 * float(expected.abs().max()))
    assert_close(at.gram(), at.gram().T, rtol=0, atol=1e-14 * float(expected.abs().max()))


def test_values_at_the_controls_are_those_of_the_fit() -> None:
    """As a copy, for the very same configurations only, and not around another map there or elsewhere."""
    x = DEFORMED.x.clone()
    DEFORMED.at_controls(x).add_(1.0)  # pyright: ignore[reportOptionalMemberAccess]
    assert_close(DEFORMED.at_controls(x), DEFORMED(x), rtol=0, atol=1e-13)
    shifted = SmoothMap(lambda at: PROBLEM.spec.nominal(at, at.new_zeros(0)) + 1.0)
    own = GeodesicDeformation(replace(DEFORMED.spec, at_controls=shifted), x, DEFORMED.momenta, dc.RK4(2))
    for other, at in (
        (DEFORMED, x.flip(0)),
        (DEFORMED, x[:-1]),
        (DEFORMED.with_nominal(shifted), x),  # another tool
        (own, x),  # markers of their own at every row of the fit
    ):
        assert other.at_controls(at) is None


TABLE_ROWS, M, R = 7, 6, 3
Z = normal(TABLE_ROWS, M, seed=1)
LENGTHS, HEIGHTS = torch.tensor([4, 0, 2]), torch.tensor([1, 6])


def table() -> Stacked:
    """Three distances and two pairs of heights of different points; rows 3 and 5 report nothing."""
    distances = ReadPoints(FixedPoints.read, torch.cat([3.0 + normal(3, 3, seed=2), normal(3, 1, seed=3)], 1), 3)
    heights = LinearFunctionals(normal(2, 2, 3, seed=4), normal(2, 2, seed=5))
    parts = [
        Part(LENGTHS, torch.tensor([3, 4, 5]), torch.tensor([1]), distances),
        Part(HEIGHTS, torch.tensor([0, 1, 2]), torch.tensor([2, 0]), heights),
    ]
    return Stacked(TABLE_ROWS, R, M, parts)


def test_values_are_those_of_each_kind_and_slopes_those_of_differences() -> None:
    every = table()
    found, (lengths, heights) = every.value(Z), every.parts
    assert_close(found[LENGTHS, 1], lengths.observe.value(Z[LENGTHS, 3:])[:, 0])
    assert_close(found[HEIGHTS][:, [2, 0]], heights.observe.value(Z[HEIGHTS, :3]))
    assert int((found != 0).sum()) == 3 + 4
    step, h = normal(TABLE_ROWS, M, seed=6), 1e-6
    change = (every.value(Z + h * step) - every.value(Z - h * step)) / (2 * h)
    assert_close((every.slope(Z) @ step[..., None])[..., 0], change, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("index", [[4, 1, 1], [0, 5], [6, 2, 4, 3, 0]])
def test_rows_are_those_of_the_whole(index: list[int]) -> None:
    rows, every = torch.tensor(index), table()
    some = every.rows(rows)
    assert len(some) == len(index)
    assert_close(some.value(Z[rows]), every.value(Z)[rows])
    assert_close(some.slope(Z[rows]), every.slope(Z)[rows])


def explicit(noise: Noise) -> Tensor:
    flat = noise.shared.flatten(0, 1)
    return torch.block_diag(*noise.covariance) + flat @ flat.T


def test_the_operations_are_those_of_the_explicit_matrix() -> None:
    R, values = shared_noise(6, 3), normal(6, 3, seed=3)
    matrix = explicit(R)
    torch.testing.assert_close(R.solve(values).flatten(), torch.linalg.solve(matrix, values.flatten()))
    torch.testing.assert_close(R.multiply(values[..., None]).flatten(), matrix @ values.flatten())
    torch.testing.assert_close(R.add_to(torch.zeros_like(matrix)), matrix)
    rows = torch.tensor([4, 1])
    some = matrix.view(6, 3, 6, 3)[rows][:, :, rows].reshape(6, 6)
    torch.testing.assert_close(explicit(R.rows(rows)), some)
    torch.testing.assert_close(explicit(R.own), torch.block_diag(*R.covariance))


def test_a_correlation_of_rounding_errors_is_symmetric() -> None:
    """Products of Jacobians may leave 1e-19 and 1.00001e-19 beside variances of 1e-10."""
    blocks = 1e-10 * torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    blocks[1, 0, 1], blocks[1, 1, 0] = 1e-19, 1.00001e-19
    assert torch.equal(Noise(blocks).covariance, blocks)
    blocks[1, 1, 0] = 1e-12
    with pytest.raises(InputError, match=r"`noise`.* at row 1"):
        Noise(blocks)


@pytest.mark.parametrize("reduced", [False, True])
def test_a_map_knows_its_measurements(reduced: bool) -> None:
    """The measurements that momenta imply are those of the fit, or, with few control points, lead to the same map."""
    problem = two_marker_problem(uniform(15, 2, seed=3), shared_noise(15, 4))
    solver, steps = dc.GaussNewton(tolerance=1e-12), dc.RK4(4)
    controls = problem.x[::2] if reduced else None
    fitted = dc.fit(problem, solver, steps, controls=controls)
    implied = fitted.model.measured()
    if not reduced:
        torch.testing.assert_close(implied, problem.y, rtol=0.0, atol=1e-5)
    problem.y = implied
    again = dc.fit(problem, solver, steps, controls=controls, start=fitted.momenta)
    new = uniform(20, 2, seed=8)
    torch.testing.assert_close(again.model(new), fitted.model(new), rtol=0.0, atol=1e-4)


def gaps(rows: int = 9, m: int = 6) -> tuple[Tensor, Tensor]:
    """Random blocks, and which coordinates of them were measured."""
    root = normal(rows, m, m, seed=5)
    visible = (normal(rows, m // 3, seed=6) > -0.3).repeat_interleave(3, 1)
    visible[0], visible[1, :3] = True, False
    return root @ root.mT + torch.eye(m, dtype=torch.float64), visible


def test_hidden_coordinates_carry_no_information() -> None:
    """And stay hidden in another frame and with weights."""
    blocks, visible = gaps()
    hidden = without_hidden(blocks, visible)
    noise, values = Noise(hidden), normal(*visible.shape, seed=7)
    solved = noise.solve(values)
    for row, seen in enumerate(visible):
        expected = torch.linalg.solve(blocks[row][seen][:, seen], values[row, seen])
        torch.testing.assert_close(solved[row, seen], expected, rtol=1e-9, atol=1e-12)
        assert float(solved[row, ~seen].abs().sum()) < 1e-6
    turn = torch.block_diag(*2 * [torch.linalg.qr(normal(3, 3, seed=8)).Q])
    turned = turn @ hidden @ turn.mT
    for same in (noise.visible, Noise(0.5 * (turned + turned.mT)).visible, measured_coordinates(turned / 2.5)):
        assert same.tolist() == visible.tolist()  # 2.5: the largest weight of a row


def test_mean_block_leaves_out_what_was_hidden() -> None:
    blocks, visible = gaps()
    mean = Noise(without_hidden(blocks, visible)).mean
    for k in range(visible.shape[1]):
        own = blocks[visible[:, k], k, k]
        assert float(mean[k, k]) == pytest.approx(float(own.mean()), rel=1e-12)
    assert float(torch.linalg.eigvalsh(mean)[0]) > 0
    large = 1e12 * blocks  # the unit of a map that is no robot's
    assert bool(Noise(large).visible.all())
    torch.testing.assert_close(Noise(large).mean, large.mean(0))
