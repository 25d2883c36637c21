"""Scales of kernels, priors and noise.

The kernel of the joint errors is

    K_V = diag_l( a_l^2 k_l(x_l, x'_l) + c_l^2 k_all(x, x') ).

k_l (Matern 5/2) depends on joint l only and models its transmission (gear eccentricity, meshing); k_all (Gaussian)
depends on all joints, with one length scale each, and models load and coupling. K_W is a Gaussian kernel on R^3.
Geometric errors, the coefficients of the gravity sag and those of gear lines have Gaussian priors, and those of errors
of axes have that of the functions c_k cos(k pi t), 0 < t < 1, with the spectrum of a Matern 5/2 kernel. The
noise of a configuration is

    R_i = sigma^2 I + Dk0(x_i) diag(s^2) Dk0(x_i)^T   (for poses with a term for their rotation)

where s is the repeatability of the joints, which the likelihood would otherwise attribute to signal. In a search
autograd follows the scales only: d/d r_l sum W a^2 kappa(sum_l r_l d_l) = a^2 sum W kappa' d_l, r_l = lengthscale_l^-2.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.profiles import GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.radial import PerJoint, RadialKernel
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots.placement import PLACES

TRANSMISSION_PROFILE = MaternProfile(2.5)  # gears have several harmonics, for which a Gaussian kernel is too smooth
COUPLED_PROFILE = TASK_PROFILE = GaussianProfile()
SENSOR_SHARE = 0.2  # default noise of the sensor, relative to the residual of the geometric calibration
NEGLIGIBLE_DISPLACEMENT = 3e-3
"""Prior displacement, relative to the standard deviation of the noise, that no amount of data would reveal."""
FIELD_AMPLITUDES = ("transmission_amplitude", "coupled_amplitude", "joint_noise", "task_amplitude")
JOINT_SCALES = ("transmission_lengthscale", "coupled_lengthscale", *FIELD_AMPLITUDES[:3])
"""Of the fields of every active joint."""
ELASTIC_AMPLITUDES = ("compliance", "lateral_compliance")
AMPLITUDES = frozenset((*FIELD_AMPLITUDES, *ELASTIC_AMPLITUDES, "gravity", "axis_errors"))
"""Scales that may shrink to zero, when the data do not support the part of the model that they scale."""
DEVIATIONS = (
    *(*FIELD_AMPLITUDES, *ELASTIC_AMPLITUDES),
    *("sensor_noise", "rotation_noise", "translation_errors", "rotation_errors"),
)
"""Scales that are standard deviations: scaled together, they scale the whole covariance."""


@dataclass(frozen=True)
class GearLine:
    """A periodic error of one joint at one frequency, as reduction gears have at multiples of their ratio."""

    joint: int  # number of the active joint
    frequency: float  # w, rad per rad of the joint: periods per turn
    amplitude: float  # b, prior standard deviation of its cosine and of its sine, rad


@dataclass(frozen=True)
class Hyperparameters:
    """Scales of kernels, priors and noise; lengths in m, angles in rad; n active joints, J moving joints.

    Args:
        transmission_lengthscale: (n,) of k_l; on a circle concentration = lengthscale^-2.
        transmission_amplitude: (n,) a_l, rad or m.
        coupled_lengthscale: (n,) of k_all, ARD.
        coupled_amplitude: (n,) c_l, rad or m.
        joint_noise: (n,) s_l, rad or m.
        task_lengthscale: scalar, m. task_amplitude: scalar, m, of K_W.
        sensor_noise: scalar sigma, m, per coordinate. rotation_noise: scalar, rad, of measured poses.
        translation_errors: scalar, m, and rotation_errors: scalar, rad: priors of the joints' error twists.
        compliance: (J,) prior of a joint's deflection about its own axis, rad per m of lever arm.
        lateral_compliance: (J,) the same about the other two axes.
        gravity: (3,) factors on both by the direction of the load in the robot's base.
        lines: gear lines; found by a scan, they take no part in the search.
        payload: factor on both compliances for the sag under the largest payload; found after the search.
        axes: axes with errors that depend on their own position, see :class:`PositionErrors`; A of them. Found by their
            evidence beside scales without them, and then searched with these.
        axis_errors: (A, 2) their RMS shift in each direction, m, and turn, rad; None without such axes, as below.
        axis_lengthscale: (A,) as a part of the range.
        other_noise: (K - 1,) m, in place of sensor_noise for rows of the second and further kinds of devices, such as a
            ball in sockets beside measured positions; None if all rows are of one kind, or measured alike.
    """

    transmission_lengthscale: Tensor
    transmission_amplitude: Tensor
    coupled_lengthscale: Tensor
    coupled_amplitude: Tensor
    joint_noise: Tensor
    task_lengthscale: Tensor
    task_amplitude: Tensor
    sensor_noise: Tensor
    rotation_noise: Tensor
    translation_errors: Tensor
    rotation_errors: Tensor
    compliance: Tensor
    lateral_compliance: Tensor
    gravity: Tensor
    lines: tuple[GearLine, ...] = ()
    payload: float = 1.0
    axes: tuple[tuple[int, float, float, int], ...] = ()
    axis_errors: Tensor | None = None
    axis_lengthscale: Tensor | None = None
    other_noise: Tensor | None = None

    def joint_kernel(self, space: Space) -> Kernel:
        """K_V on the joint space: diag_l a_l^2 k_l + c_l^2 k_all."""
        lengthscale, variance = self.coupled_lengthscale, self.coupled_amplitude**2
        coupled = RadialKernel(COUPLED_PROFILE, lengthscale=lengthscale, variance=variance, periodic=space.periodic)
        smooth = self.transmission_lengthscale, self.transmission_amplitude**2
        return PerJoint(*smooth, space, TRANSMISSION_PROFILE) + coupled

    def task_kernel(self) -> Kernel:
        """K_W on R^3."""
        return RadialKernel(TASK_PROFILE, lengthscale=self.task_lengthscale, variance=self.task_amplitude**2)

    def prior_variance(self, nominal: GeometryMap, place_deviation: float = PLACES.found_m_rad) -> Tensor:
        """Prior variances of theta: errors of the geometry, coefficients of gravity sag, gear lines and axes in turn.

        Args:
            nominal: k0, with these gear lines and axes.
            place_deviation: standard deviation of base and markers around their registration, m and rad.
        """
        geometry, elasticity = nominal.geometry, nominal.elasticity
        twist = torch.cat([self.translation_errors.expand(3), self.rotation_errors.expand(3)])
        places = twist.new_full((6 + 3 * geometry.markers,), place_deviation)
        deviations = torch.cat([places[:6], twist.repeat(geometry.chain.moving), places[6:]])
        if elasticity is not None:
            axial, lateral = self.compliance[elasticity.joints], self.lateral_compliance[elasticity.joints]
            elastic = torch.where(elasticity.own, axial, lateral) * self.gravity[elasticity.components]
            elastic = torch.where(elasticity.loaded, self.payload * elastic, elastic)
            deviations = torch.cat([deviations, elastic])
        lines = [line.amplitude for line in self.lines for _ in range(2)]
        deviations = torch.cat([deviations, deviations.new_tensor(lines)])
        if self.axis_errors is not None and self.axis_lengthscale is not None:
            for axis, errors, lengthscale in zip(self.axes, self.axis_errors, self.axis_lengthscale, strict=True):
                deviations = torch.cat([deviations, axis_deviations(errors, lengthscale, axis[3])])
        return deviations.square()

    def supported(self, jacobian: Tensor, noise: Tensor) -> Hyperparameters:
        """Return the scales, with amplitudes set to zero where the field stays far below the noise.

        Args:
            jacobian: (N, m, n) of k0. noise: (N, m, m) blocks R_i, m^2, or their mean (m, m).
        """
        level = NEGLIGIBLE_DISPLACEMENT * float(noise.diagonal(dim1=-2, dim2=-1).mean().sqrt())
        lever = jacobian.square().mean((0, 1)).sqrt()
        sizes = {"transmission_amplitude": lever, "coupled_amplitude": lever, "task_amplitude": 1.0}
        found = {name: (getattr(self, name), size) for name, size in sizes.items()}
        return replace(self, **{name: torch.where(own * size < level, 0.0, own) for name, (own, size) in found.items()})

    def inflated(self, factor: float) -> Hyperparameters:
        """All standard deviations times a factor: the same fit (up to known covariances), larger uncertainty."""
        lines = tuple(replace(line, amplitude=factor * line.amplitude) for line in self.lines)
        names = [name for name in (*DEVIATIONS, *DEVIATIONS_OF_SOME) if getattr(self, name) is not None]
        return replace(self, **{name: factor * getattr(self, name) for name in names}, lines=lines)

    @property
    def searched(self) -> tuple[str, ...]:
        """Names of the scales that are searched, in the order of the vector of logarithms."""
        return (*SCALES, *(name for name in SCALES_OF_SOME if getattr(self, name) is not None))

    def logarithms(self) -> Tensor:
        """All scales, without gear lines, as one vector of logarithms."""
        return torch.cat([getattr(self, name).reshape(-1) for name in self.searched]).log()

    def from_logarithms(self, vector: Tensor) -> Hyperparameters:
        """The inverse of :meth:`logarithms`, shaped like this object and with its gear lines."""
        shapes = [getattr(self, name).shape for name in self.searched]
        parts = torch.split(vector.exp(), [s.numel() for s in shapes])
        return replace(self, **{name: p.reshape(s) for name, p, s in zip(self.searched, parts, shapes, strict=True)})

    @property
    def vector(self) -> Tensor:
        """All scales that any measurements have as one vector, without gear lines, as model files hold them."""
        return torch.cat([getattr(self, name).reshape(-1) for name in SCALES])

    def amplitudes(self) -> Tensor:
        """Which entries of the vector of logarithms may shrink to zero: boolean."""
        scales = [(name in AMPLITUDES, getattr(self, name).reshape(-1)) for name in self.searched]
        return torch.cat([torch.full_like(scale, flag, dtype=torch.bool) for flag, scale in scales])


DEVIATIONS_OF_SOME = "axis_errors", "other_noise"
SCALES_OF_SOME = (*DEVIATIONS_OF_SOME, "axis_lengthscale")
PAYLOAD_FACTORS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Candidates of :attr:`Hyperparameters.payload`."""
FOUND = "lines", "payload", "axes", "axis_errors", "axis_lengthscale"
"""Names of what is found beside other scales, before these are searched again."""
SCALES = tuple(one.name for one in fields(Hyperparameters) if one.name not in (*FOUND, *SCALES_OF_SOME))
"""Names of the scales that are tensors and that all measurements have."""


def axis_deviations(errors: Tensor, lengthscale: Tensor, count: int) -> Tensor:
    """Deviations (6 count,) of c_1 ... of functions with RMS shift and turn (2,), see :class:`Hyperparameters`."""
    rates = torch.pi * torch.arange(1, count + 1, dtype=lengthscale.dtype, device=lengthscale.device)
    deviations = (1.0 + (rates * lengthscale).square() / 5.0) ** -1.5
    return torch.outer(deviations * (2.0 / deviations.square().sum()).sqrt(), errors.repeat_interleave(3)).flatten()


class Term(NamedTuple):
    """a_l^2 kappa(r_l d_l), r_l = lengthscale_l^-2; ``joined``: of all coordinates, a_l^2 kappa(sum_k r_k d_k)."""

    profile: Profile
    amplitudes: Tensor
    lengthscales: Tensor
    joined: bool = False


class KernelValues:
    """A sum of terms for squared distances d (n, M, N) of n coordinates.

    Attributes:
        values: (n, M, N), detached.
    """

    def __init__(self, distances: Tensor, *terms: Term) -> None:
        self.distances, self._terms, values = distances, list[tuple[Term, Tensor, Tensor]](), list[Tensor]()
        for term in terms:
            rates = term.lengthscales.detach().pow(-2)
            scaled = torch.tensordot(rates, distances, dims=1) if term.joined else distances * rates[:, None, None]
            kappa, slope = term.profile.derivatives(scaled, 1)
            self._terms.append((term, kappa, slope))
            values.append(term.amplitudes.detach().square()[:, None, None] * kappa)
        self.values = reduce(torch.add, values)

    def inner(self, weights: Tensor) -> Tensor:
        """sum(weights * values) for weights (n, M, N), differentiable in the scales: scalar."""
        total = weights.new_zeros(())
        for term, kappa, slope in self._terms:
            variances, rates = term.amplitudes.square(), term.lengthscales.pow(-2)
            if term.joined:
                sums = weights.flatten(1) @ kappa.flatten()
                pooled = torch.tensordot(variances.detach(), weights, dims=1).mul_(slope)
                slopes = self.distances.flatten(1) @ pooled.flatten()
            else:
                sums = (weights * kappa).sum((1, 2))
                slopes = variances.detach() * (weights * slope).mul_(self.distances).sum((1, 2))
            total = total + variances @ sums + slopes @ (rates - rates.detach())  # zero, with a derivative
        return total


class Pairs:
    """Covariance by the fields of all numbers of N rows; distances are computed once, for a search of many scales.

    Args:
        x: (N, n) configurations. points: (N, 3 P) of the robot there, m. J: (N, R, n) and A: (N, R, 3 P) derivatives
            of the numbers by the errors of the joints and of the points.
    """

    def __init__(self, x: Tensor, points: Tensor, J: Tensor, A: Tensor, space: Space) -> None:
        self.J, self.A, z = J, A.unflatten(2, (-1, 3)), points.reshape(-1, 3)
        self._joints = space.squared_distances(x, x)
        self._points = torch.cdist(z, z, compute_mode="donot_use_mm_for_euclid_dist").square_()

    def values(self, scales: Hyperparameters) -> tuple[KernelValues, KernelValues]:
        """K_V, diagonal (n, N, N), at all pairs of configurations, and kappa (1, N P, N P) of K_W = kappa I."""
        term = Term(TRANSMISSION_PROFILE, scales.transmission_amplitude, scales.transmission_lengthscale)
        coupled = Term(COUPLED_PROFILE, scales.coupled_amplitude, scales.coupled_lengthscale, joined=True)
        task = Term(TASK_PROFILE, scales.task_amplitude.reshape(1), scales.task_lengthscale.reshape(1))
        return KernelValues(self._joints, term, coupled), KernelValues(self._points[None], task)

    def matrix(self, values: tuple[KernelValues, KernelValues]) -> Tensor:
        """(N R, N R), without a graph."""
        (joint, task), (N, R, P, _) = (one.values for one in values), self.A.shape
        by_joint = (joint.transpose(0, 1)[..., None] * self.J.permute(2, 0, 1)).flatten(2)  # (N, n, N R)
        by_point = torch.einsum("tjp,jrpc->tcjr", task[0].unflatten(1, (N, P)), self.A)
        by_point = self.A.flatten(2) @ by_point.reshape(N, 3 * P, N * R)
        return torch.baddbmm(by_point, self.J, by_joint).flatten(0, 1)

    def inner(self, values: tuple[KernelValues, KernelValues], weights: Tensor) -> Tensor:
        """sum(weights * matrix) for weights (N R, N R), differentiable in the scales: scalar.

        With the gradient of a function of the matrix as weights, its derivative is that of the function, but autograd
        records no matrix of this size.
        """
        N, R, P, _ = self.A.shape
        half = (self.A.flatten(2).mT @ weights.view(N, R, -1)).view(N * P, 3, N, R)
        of_points = torch.einsum("tcjr,jrpc->tjp", half, self.A).flatten(1)
        return values[0].inner(joint_weights(self.J, weights)) + values[1].inner(of_points[None])


def joint_weights(J: Tensor, weights: Tensor) -> Tensor:
    """The weights (n, N, N) of the values of K_V in a sum of weights (N R, N R) times the covariance: J^T W J."""
    half = (J.mT @ weights.view(*J.shape[:2], -1)).unflatten(2, J.shape[:2])
    return torch.einsum("icjr,jrc->cij", half, J).contiguous()
