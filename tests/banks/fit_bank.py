"""Fitting problems for tests: noise blocks, deformations and starts away from zero, interruptions."""

from collections.abc import Callable

import torch
from math_bank import normal
from torch import Tensor

from diffeo_calib.fitting.problem import Problem
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.robots import elastic_rr


def noise_blocks(count: int, m: int, least: float = 1e-5) -> Tensor:
    """Different full covariances (count, m, m); ``least`` bounds their eigenvalues from below."""
    root = 0.01 * normal(count, m, m, seed=11)
    return root @ root.mT + least * torch.eye(m, dtype=torch.float64)


def shared_noise(count: int, m: int) -> Noise:
    """Different full covariances, and two shifts of decimetres that all but the first rows share."""
    shared = 0.3 * normal(count, m, 2, seed=13)
    shared[: count // 3] = 0.0
    return Noise(noise_blocks(count, m, 1e-4), shared)


def momenta_of_size(problem: Problem, size: float, seed: int) -> Momenta:
    """Random momenta of all unknowns."""
    zero = problem.zero()
    return zero.unflatten(size * normal(zero.flatten().numel(), seed=seed))


def deformed(problem: Problem) -> GeodesicDeformation:
    """A deformation of a few per cent."""
    return problem.deform(momenta_of_size(problem, 0.02, seed=12), RK4(2))


def random_start(problem: Problem, size: float = 0.02) -> Momenta:
    return momenta_of_size(problem, size, seed=21)


class Offset(NominalMap):
    """The RR arm with an unknown offset of its tip."""

    parameters = 2

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        return elastic_rr.nominal(x) + theta

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        x1, t2 = x[:, 0], x[:, 0] + x[:, 1]
        elbow, tip = torch.stack([-x1.sin(), x1.cos()], -1), 0.5 * torch.stack([-t2.sin(), t2.cos()], -1)
        return torch.stack([elbow + tip, tip], -1)

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        return torch.eye(2, dtype=torch.float64).expand(len(x), 2, 2)


def stop_at(call: int) -> Callable[[str, int, int], None]:
    """A progress callback that interrupts after ``call`` calls."""
    calls = []

    def progress(task: str, done: int, total: int) -> None:
        calls.append((task, done, total))
        if len(calls) > call:
            raise KeyboardInterrupt

    return progress
