"""The kernels by their usual names: Gaussian, Matern, Cauchy, von Mises, and one kernel per joint."""

from __future__ import annotations

from diffeo_calib.common.checks import as_tensor, positive
from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.kernels.profiles import CauchyProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.radial import RadialKernel, scalar_or_vector
from diffeo_calib.kernels.spaces import Space


def Gaussian(lengthscale: object = 1.0, variance: object = 1.0, *, space: Space | None = None) -> RadialKernel:
    """variance exp(-|F - F'|^2 / 2); on lines variance exp(-|x - x'|^2 / (2 lengthscale^2)).

    Args:
        lengthscale: scalar or one per coordinate (ARD), in the unit of the coordinate (m, rad); on a
            circle a pure number, concentration = lengthscale^-2.
        variance: squared amplitude of the field, (unit of the field)^2; scalar or one per coordinate.
        space: which coordinates are lines and which are circles; all lines by default.
    """
    return _scalar_kernel(GaussianProfile(), lengthscale, variance, space)


def Matern(
    lengthscale: object = 1.0, nu: float = 2.5, variance: object = 1.0, *, space: Space | None = None
) -> RadialKernel:
    """Matern kernel with nu = 1.5, 2.5 or 3.5; arguments as :func:`Gaussian`."""
    return _scalar_kernel(MaternProfile(nu), lengthscale, variance, space)


def Cauchy(lengthscale: object = 1.0, variance: object = 1.0, *, space: Space | None = None) -> RadialKernel:
    """variance / (1 + |F - F'|^2); arguments as :func:`Gaussian`."""
    return _scalar_kernel(CauchyProfile(), lengthscale, variance, space)


def VonMises(concentration: object = 1.0, variance: object = 1.0) -> RadialKernel:
    """variance exp(sum_l b_l (cos(x_l - x'_l) - 1)) on a torus (paper section 5).

    Args:
        concentration: b, scalar or one positive value per joint.
        variance: squared amplitude in rad^2; scalar or one per joint.
    """
    b = positive(concentration, "concentration", scalar_or_vector(concentration))
    return RadialKernel(GaussianProfile(), lengthscale=b.rsqrt(), variance=variance, periodic=True)


def PerJoint(lengthscale: object, variance: object, space: Space, profile: Profile | None = None) -> SumKernel:
    """diag_l(variance_l kappa(|F_l(x_l) - F_l(x'_l)|^2)): an error of each joint that depends on that joint alone.

    Args:
        lengthscale: (n,) one per joint; on circles concentration = lengthscale^-2.
        variance: (n,) squared amplitudes, rad^2 (m^2 for a prismatic joint).
        space: the joint space, n coordinates.
        profile: Gaussian by default (von Mises on circles).
    """
    scales = positive(lengthscale, "lengthscale", (space.dim,))
    variances = as_tensor(variance, "variance", (space.dim,))
    return SumKernel(
        [
            RadialKernel(
                profile or GaussianProfile(),
                lengthscale=scales[joint],
                variance=variances[joint],
                periodic=space.periodic,
                columns=[joint],
                output=joint,
            )
            for joint in range(space.dim)
        ]
    )


def _scalar_kernel(profile: Profile, lengthscale: object, variance: object, space: Space | None) -> RadialKernel:
    periodic: bool | tuple[bool, ...] = False if space is None else space.periodic
    return RadialKernel(profile, lengthscale=lengthscale, variance=variance, periodic=periodic)
