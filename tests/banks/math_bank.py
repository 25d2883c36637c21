"""The problem bank of the mathematics: kernels with their textbook formulas, naive algorithms, and test problems."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from math import log2, sqrt

import torch
from numbers_bank import drawn, normal, tensor
from section_5 import SIGMA, section_5, section_5_kernels
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.profiles import CauchyProfile, ConstantProfile, GaussianProfile, MaternProfile
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.robots import elastic_rr

Kappa = Callable[[Tensor], Tensor]


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Another number of torch's threads inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def uniform(*shape: int, seed: int = 0) -> Tensor:
    """In [-pi, pi)."""
    return torch.pi * (2.0 * drawn(*shape, seed=seed) - 1.0)


def line(dim: int = 1) -> Space:
    """R^dim."""
    return Space((False,) * dim)


def circle(dim: int = 1) -> Space:
    """The torus T^dim."""
    return Space((True,) * dim)


def constant_kernel(variance: object = 1.0) -> RadialKernel:
    """K = variance: one common translation of all points."""
    return RadialKernel(ConstantProfile(), variance=variance)


def gaussian(r2: Tensor) -> Tensor:
    return torch.exp(-r2 / 2)


def cauchy(r2: Tensor) -> Tensor:
    return 1 / (1 + r2)


def constant(r2: Tensor) -> Tensor:
    return torch.ones_like(r2) + 0 * r2


def matern(nu: float) -> Kappa:
    def kappa(r2: Tensor) -> Tensor:
        r = torch.sqrt(2 * nu * r2)
        polynomial = {1.5: 1 + r, 2.5: 1 + r + r**2 / 3, 3.5: 1 + r + 2 * r**2 / 5 + r**3 / 15}[nu]
        return polynomial * torch.exp(-r)

    return kappa


@dataclass(frozen=True)
class Term:
    """kappa(sum_l d_l^2 / s_l^2) * diag(output), with d_l the distance, or the chord on a circle."""

    kappa: Kappa
    scales: dict[int, float]
    output: tuple[float, ...]


@dataclass(frozen=True)
class Case:
    """A kernel of the package and its textbook formula."""

    name: str
    kernel: Kernel
    space: Space
    terms: tuple[Term, ...]

    @property
    def dim(self) -> int:
        return self.space.dim

    def points(self, count: int, seed: int = 0) -> Tensor:
        """Points of the space, angles over a whole turn."""
        x = normal(count, self.dim, seed=seed)
        return torch.where(torch.tensor(self.space.periodic), 1.7 * x, 0.6 * x)

    def pair(self, x: Tensor, y: Tensor) -> Tensor:
        """K(x, y) by the textbook formula: (..., n), (..., n) -> (..., n, n)."""
        blocks = []
        for term in self.terms:
            r2 = torch.zeros((), dtype=torch.float64)
            for column, scale in term.scales.items():
                d = x[..., column] - y[..., column]
                r2 = r2 + (4 * torch.sin(d / 2) ** 2 if self.space.periodic[column] else d**2) / scale**2
            blocks.append(term.kappa(r2)[..., None, None] * torch.diag(tensor(term.output)))
        return torch.stack(blocks).sum(0)

    def at_zero(self) -> Tensor:
        """K(x, x): (n, n), the same for every x."""
        return sum((torch.diag(tensor(t.output)) for t in self.terms), torch.zeros(self.dim, self.dim).double())

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        """(M n, N n), block by block."""
        rows = [torch.cat([self.pair(a, b) for b in y], -1) for a in x]
        return torch.cat(rows, -2)

    def velocity(self, x: Tensor, q: Tensor, a: Tensor) -> Tensor:
        """v(x) = sum_j K(x, q_j) a_j, all pairs different: (M, n)."""
        return torch.einsum("ijkl,jl->ik", self.pair(x[:, None], q[None]), a)

    def hamiltonian(self, q: Tensor, a: Tensor) -> Tensor:
        """H(q, a), with the diagonal written separately (sqrt has no derivative at 0)."""
        i, j = torch.triu_indices(len(q), len(q), 1)
        cross = torch.einsum("pk,pkl,pl->", a[i], self.pair(q[i], q[j]), a[j])
        return cross + 0.5 * torch.einsum("ik,kl,il->", a, self.at_zero(), a)

    def geodesic_field(self, state: Tensor) -> Tensor:
        """J grad H by plain autograd, differentiable again."""
        with torch.enable_grad():
            live = state if state.requires_grad else state.detach().requires_grad_()
            h = self.hamiltonian(live[0], live[1])
            (g,) = torch.autograd.grad(h, live, create_graph=True)
        return torch.stack([g[1], -g[0]])


def _ard(kappa: Kappa, scales: tuple[float, ...], output: tuple[float, ...]) -> Term:
    return Term(kappa, dict(enumerate(scales)), output)


def _von_mises(b: tuple[float, ...], output: tuple[float, ...]) -> Term:
    return _ard(gaussian, tuple(1 / sqrt(v) for v in b), output)


MIXED = line(1) * circle(2)
_PER_JOINT = dc.PerJoint([0.7, 0.9, 1.2], [0.5, 1.5, 0.8], MIXED)
_PER_JOINT_TERMS = tuple(
    Term(gaussian, {j: s}, tuple(v if k == j else 0.0 for k in range(3)))
    for j, (s, v) in enumerate(((0.7, 0.5), (0.9, 1.5), (1.2, 0.8)))
)

CIRCULAR = circle(1) * line(1) * circle(1)
CASES = (
    Case(
        "gaussian",
        dc.Gaussian([0.8, 1.1, 0.6], [1.3, 0.0, 2.0]),
        line(3),
        (_ard(gaussian, (0.8, 1.1, 0.6), (1.3, 0.0, 2.0)),),
    ),
    *(
        Case(f"matern-{nu}", dc.Matern(0.9, nu, 0.7), line(2), (_ard(matern(nu), (0.9, 0.9), (0.7, 0.7)),))
        for nu in (1.5, 3.5)
    ),
    Case(
        "matern-mixed",
        dc.Matern([0.9, 1.1, 0.7], 2.5, 1.4, space=MIXED),
        MIXED,
        (_ard(matern(2.5), (0.9, 1.1, 0.7), (1.4, 1.4, 1.4)),),
    ),
    Case(
        "cauchy-mixed",
        dc.Cauchy(0.9, [0.6, 1.0, 1.2], space=CIRCULAR),
        CIRCULAR,
        (_ard(cauchy, (0.9, 0.9, 0.9), (0.6, 1.0, 1.2)),),
    ),
    Case("constant", constant_kernel([0.4, 0.9]), line(2), (_ard(constant, (1.0, 1.0), (0.4, 0.9)),)),
    Case(
        "von-mises",
        dc.VonMises((0.7, 1.9, 0.3), (2.0, 1.0, 0.5)),
        circle(3),
        (_von_mises((0.7, 1.9, 0.3), (2.0, 1.0, 0.5)),),
    ),
    Case(
        "gaussian-mixed",
        dc.Gaussian([0.7, 0.9, 1.2], 1.1, space=MIXED),
        MIXED,
        (_ard(gaussian, (0.7, 0.9, 1.2), (1.1, 1.1, 1.1)),),
    ),
    Case("per-joint", _PER_JOINT, MIXED, _PER_JOINT_TERMS),
    Case(
        "per-joint-matern",
        dc.PerJoint([0.7, 0.9], [0.5, 1.5], circle(2), MaternProfile(3.5)),
        circle(2),
        (Term(matern(3.5), {0: 0.7}, (0.5, 0.0)), Term(matern(3.5), {1: 0.9}, (0.0, 1.5))),
    ),
    Case(
        "output",
        RadialKernel(CauchyProfile(), lengthscale=[0.8, 1.3], variance=1.7, columns=[0, 2], output=1),
        line(3),
        (Term(cauchy, {0: 0.8, 2: 1.3}, (0.0, 1.7, 0.0)),),
    ),
    Case(
        "sum",
        _PER_JOINT + dc.Gaussian(1.5, 0.3, space=MIXED) + constant_kernel(0.2),
        MIXED,
        (*_PER_JOINT_TERMS, _ard(gaussian, (1.5, 1.5, 1.5), (0.3,) * 3), _ard(constant, (1.0,) * 3, (0.2,) * 3)),
    ),
    Case(
        "sum-output",
        RadialKernel(GaussianProfile(), lengthscale=0.8, variance=0.9, periodic=(True, False), columns=[0], output=1)
        + dc.Matern([0.9, 1.1], 2.5, 0.7, space=circle(1) * line(1)),
        circle(1) * line(1),
        (Term(gaussian, {0: 0.8}, (0.0, 0.9)), _ard(matern(2.5), (0.9, 1.1), (0.7, 0.7))),
    ),
)
NAMES = [case.name for case in CASES]


def case_named(name: str) -> Case:
    return next(case for case in CASES if case.name == name)


def naive_rk4(field: Callable[[Tensor], Tensor], state: Tensor, steps: int) -> list[Tensor]:
    """States at the nodes of [0, 1]."""
    h, states = 1.0 / steps, [state]
    for _ in range(steps):
        y = states[-1]
        k1 = field(y)
        k2 = field(y + h / 2 * k1)
        k3 = field(y + h / 2 * k2)
        k4 = field(y + h * k3)
        states.append(y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    return states


def central_difference(function: Callable[[Tensor], Tensor], x: Tensor, dx: Tensor, eps: float = 1e-3) -> Tensor:
    """Derivative of ``function`` at x along dx, error O(eps^6)."""

    def half(k: int) -> Tensor:
        return (function(x + k * eps * dx) - function(x - k * eps * dx)) / (2 * eps)

    return 1.5 * half(1) - 0.3 * half(2) + half(3) / 30


def rows_jacobian(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Autograd Jacobian (M, m, n) of a map whose rows are independent."""
    x = x.detach().requires_grad_()
    y = function(x)
    grads = [torch.autograd.grad(y[:, k].sum(), x, retain_graph=True)[0] for k in range(y.shape[1])]
    return torch.stack(grads, 1)


def slopes(errors: list[float]) -> list[float]:
    """Orders of convergence when each entry halves the step of the one before."""
    return [log2(a / b) for a, b in pairwise(errors)]


K_V, K_W = section_5_kernels()


def rr_problem(k: int, noise: float = SIGMA) -> Problem:
    """The paper's test bed on a k x k grid."""
    return section_5(noise, k)


def few_points() -> Problem:
    """A problem that is well-conditioned enough for L-BFGS to converge without preconditioning."""
    x = uniform(6, 2, seed=3)
    return Problem(
        elastic_rr.nominal,
        x,
        elastic_rr.real(x),
        joint_kernel=dc.Matern(0.6, 2.5, 0.5, space=circle(2)),
        task_kernel=dc.Matern(0.4, 2.5, 0.1),
        noise=0.3,
    )


def planar_two_markers(x: Tensor) -> Tensor:
    """A planar 2R arm with one marker at the tip and one beside the forearm: (N, 2) -> (N, 4)."""
    t1, t2 = x[:, 0], x[:, 0] + x[:, 1]
    elbow = torch.stack([t1.cos(), t1.sin()], -1)
    along, across = torch.stack([t2.cos(), t2.sin()], -1), torch.stack([-t2.sin(), t2.cos()], -1)
    return torch.cat([elbow + 0.5 * along, elbow + 0.2 * along + 0.3 * across], -1)


def real_two_markers(x: Tensor) -> Tensor:
    """The same arm with errors in its joints and a distorted measuring frame: (N, 2) -> (N, 4)."""
    turned = x + 0.03 * torch.stack([x[:, 0].sin(), (2 * x[:, 1]).cos()], -1)
    z = planar_two_markers(turned)
    w = z.view(-1, 2)
    return (w + 0.02 * torch.stack([w[:, 1].sin(), w[:, 0].cos()], -1)).view_as(z)


def two_marker_problem(x: Tensor, noise: object = 0.01) -> Problem:
    return Problem(
        planar_two_markers,
        x,
        real_two_markers(x),
        joint_kernel=dc.VonMises(1.0, 0.01),
        task_kernel=dc.Gaussian(0.7, 0.01),
        noise=noise,
        markers=2,
    )


def spatial_markers(x: Tensor) -> Tensor:
    """A revolute and a prismatic joint with two markers in R^3: (N, 2) -> (N, 6)."""
    c, s, d = x[:, 0].cos(), x[:, 0].sin(), x[:, 1]
    first = torch.stack([c * (0.5 + d), s * (0.5 + d), 0.3 * d], -1)
    second = torch.stack([c * d - 0.2 * s, s * d + 0.2 * c, 0.1 + d**2], -1)
    return torch.cat([first, second], -1)
