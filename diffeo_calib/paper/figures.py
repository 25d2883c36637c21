"""The figures of the paper's section 5, drawn for any calibrated model of its elastic RR arm.

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025:
poses (figure 4), surfaces coloured by the error (6, 7), grids in the workspace (8, 9), heat maps (10, 11) and
histograms (12).
"Real" is the elastic arm, "nominal" the model (22), "calibrated" the fitted model. Errors are in the test bed's
length units; the arm's reach is 1.5.

The paper's two algorithms with its own names, for comparison with Listings 1 and 2 line by line; its section 5.

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025.
The algorithms use the parts of :func:`fit` with ``formulation="eulerian"``; :class:`Eulerian` lists the errata.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_count, check_finite, check_number
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, NumericalError, as_written
from diffeo_calib.common.files import IMAGE_SUFFIXES, write_figure
from diffeo_calib.fitting.objective import slope
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.flows.integrators import RK4, Integrator
from diffeo_calib.kernels.base import Kernel, check_kernel
from diffeo_calib.kernels.radial import Gaussian, RadialKernel, VonMises
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.nominal import NominalMap, as_nominal
from diffeo_calib.paper.eulerian import Eulerian, EulerianDeformation, EulerianProblem, checked_equations
from diffeo_calib.robots import elastic_rr

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Kinematics = Callable[[Tensor], Tensor]
TEST_ROWS, TEST_SEED = 3000, 0
"""Number of random configurations in figures 10 to 12, and the seed of their generator."""
GRID_LINES, SURFACE_POINTS = 25, 61
"""Lines of the workspace's grid and points of the surfaces, per joint."""
POSES = ((0.3, 0.9), (1.3, 0.8), (2.4, -0.9), (3.7, 0.7), (4.9, 1.1))
"""Joint angles of the arms in figure 4 [rad]."""
REAL_COLOUR, NOMINAL_COLOUR, CALIBRATED_COLOUR = "#b5525c", "#5c6773", "#1f6f8b"
SMALLEST_ERROR = 1e-12
"""Smaller errors are drawn as this one [length units]."""
DISTANCE_LABEL, COMPONENT_LABEL = "log10 of the distance / length unit", "log10 of the |error| / length unit"


def mean_error(model: Kinematics) -> float:
    """Mean distance from the real arm over the random configurations of figures 10 to 12, length units."""
    return float(_distances(model).mean())


def paper_figures(model: Kinematics, folder: str | Path, suffix: str = ".png") -> list[Path]:
    """Draw all figures and write each to a file.

    Args:
        model: calibrated kinematics, (N, 2) rad -> (N, 2) length units.
        folder: an existing folder for the files.
        suffix: ".png" (300 dpi), ".pdf" or ".svg".

    Returns:
        the paths of the files.

    Raises:
        InputError: the folder does not exist, an unknown suffix, or a file that cannot be written.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError.of(f"the folder of figures '{folder}'", expected="an existing folder")
    if suffix not in IMAGE_SUFFIXES:
        raise InputError.of("`suffix`", expected=", ".join(IMAGE_SUFFIXES), got=as_written(suffix))
    paths = []
    for name, draw in DRAWINGS.items():
        paths.append(folder / f"{name}{suffix}")
        write_figure(draw(model), paths[-1], dpi=300)
    return paths


def random_configurations() -> Tensor:
    """The configurations of figures 10 to 12: (3000, 2) in rad, uniform on the torus."""
    generator = seeded(TEST_SEED)
    return pi * (2 * torch.rand(TEST_ROWS, 2, generator=generator, dtype=torch.float64, device=HOST) - 1)


def _distances(model: Kinematics) -> Tensor:
    """Distances from the real arm at the random configurations: (3000,)."""
    x = random_configurations()
    return (model(x) - elastic_rr.real(x)).norm(dim=1)


def _new(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

    return Figure(figsize=(width, height), layout="constrained")


def poses_figure() -> Figure:
    """Figure 4: nominal and real arm at the same joint angles."""
    figure = _new(5.6, 5.2)
    axes = figure.subplots()
    x = torch.tensor(POSES, dtype=torch.float64, device=HOST)
    elbow = elastic_rr.NOMINAL_LENGTHS[0] * torch.stack([x[:, 0].cos(), x[:, 0].sin()], 1)
    rigid = torch.stack([torch.zeros_like(elbow), elbow, elastic_rr.nominal(x)], 1).numpy()
    bent = elastic_rr.real_links(x).flatten(1, 2).numpy()
    for k in range(len(POSES)):
        axes.plot(*rigid[k].T, color=NOMINAL_COLOUR, lw=1.6, ls=(0, (4, 2)), marker="o", ms=4, mfc="white")
        axes.plot(*bent[k].T, color=REAL_COLOUR, lw=2.0)
        axes.plot(*bent[k][[0, bent.shape[1] // 2, -1]].T, color=REAL_COLOUR, ls="", marker="o", ms=4)
    axes.plot([], [], color=NOMINAL_COLOUR, ls=(0, (4, 2)), marker="o", ms=4, mfc="white", label="nominal")
    axes.plot([], [], color=REAL_COLOUR, marker="o", ms=4, label="real")
    axes.legend(frameon=False, loc="upper right")
    _plane(axes)
    return figure


def surfaces_figure(model: Kinematics) -> Figure:
    """Figures 6 and 7: both coordinates of the real arm over joint space, coloured by the error of each coordinate."""
    from matplotlib import colormaps  # noqa: PLC0415

    figure = _new(9.6, 8.2)
    side = torch.linspace(-pi, pi, SURFACE_POINTS, dtype=torch.float64, device=HOST)
    shape = (SURFACE_POINTS, SURFACE_POINTS)
    x = torch.cartesian_prod(side, side)
    real = elastic_rr.real(x)
    X1, X2 = (x[:, k].view(shape).numpy() for k in (0, 1))
    count = {"rcount": SURFACE_POINTS, "ccount": SURFACE_POINTS}
    rows = (("nominal (figure 6)", elastic_rr.nominal), ("calibrated (figure 7)", model))
    for row, (name, kinematics) in enumerate(rows):
        errors = _logarithm((kinematics(x) - real).abs())
        low, high = np.quantile(errors, (0.02, 1.0))
        panels = [_surface_axes(figure, 2 * row + 1 + k) for k in (0, 1)]
        for k, axes in enumerate(panels):
            shade = np.clip((errors[:, k] - low) / max(high - low, SMALLEST_ERROR), 0.0, 1.0).reshape(shape)
            height = real[:, k].view(shape).numpy()
            axes.plot_surface(X1, X2, height, facecolors=colormaps["viridis"](shade), **count, lw=0)
            axes.set(xlabel="$x_1$ [rad]", ylabel="$x_2$ [rad]", zlabel=f"$y_{k + 1}$", title=f"{name}, $y_{k + 1}$")
        _colour_bar(figure, panels, (float(low), float(high)))
    return figure


def _surface_axes(figure: Figure, number: int) -> Any:  # matplotlib's stubs do not know 3-D axes
    axes: Any = figure.add_subplot(2, 2, number, projection="3d")
    axes.view_init(elev=32, azim=-58)
    axes.set_box_aspect((1.0, 1.0, 0.7), zoom=0.9)
    return axes


def _colour_bar(figure: Figure, panels: list[Any], limits: tuple[float, float]) -> None:
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415
    from matplotlib.colors import Normalize  # noqa: PLC0415

    shown = ScalarMappable(Normalize(*limits), "viridis")
    figure.colorbar(shown, ax=panels, label=COMPONENT_LABEL, shrink=0.7, pad=0.06, extend="min")


def workspaces_figure(model: Kinematics) -> Figure:
    """Figures 8 and 9: images of a grid of joint space, by the real arm and by the nominal or calibrated model."""
    figure = _new(9.6, 5.0)
    for axes, (name, kinematics, colour) in zip(
        figure.subplots(1, 2),
        (
            ("nominal (figure 8)", elastic_rr.nominal, NOMINAL_COLOUR),
            ("calibrated (figure 9)", model, CALIBRATED_COLOUR),
        ),
        strict=True,
    ):
        _mesh(axes, elastic_rr.real, REAL_COLOUR, 2.0)  # wide enough to show on both sides of a coinciding line
        _mesh(axes, kinematics, colour, 0.7)
        axes.plot([], [], color=REAL_COLOUR, lw=2.0, label="real")
        axes.plot([], [], color=colour, lw=0.7, label=name.split()[0])
        axes.legend(frameon=True, framealpha=0.9, edgecolor="none", loc="upper right", fontsize=8)
        axes.set_title(name, fontsize=10)
        _plane(axes)
    return figure


def _mesh(axes: Axes, kinematics: Kinematics, colour: str, width: float) -> None:
    """Images of lines x2 = constant and x1 = constant over the half x2 >= 0, which covers the workspace once."""
    fine = torch.linspace(-pi, pi, 8 * SURFACE_POINTS, dtype=torch.float64, device=HOST)
    for value in torch.linspace(0.0, pi, GRID_LINES // 2 + 1, dtype=torch.float64, device=HOST):
        axes.plot(*kinematics(torch.stack([fine, value.expand_as(fine)], 1)).T.numpy(), color=colour, lw=width)
    half = fine[fine >= 0]
    for value in torch.linspace(-pi, pi, GRID_LINES, dtype=torch.float64, device=HOST)[:-1]:
        axes.plot(*kinematics(torch.stack([value.expand_as(half), half], 1)).T.numpy(), color=colour, lw=width)


def heat_maps_figure(model: Kinematics) -> Figure:
    """Figures 10 and 11: errors at 3000 random configurations, drawn at the real arm's tip."""
    figure = _new(10.4, 4.8)
    real = elastic_rr.real(random_configurations()).numpy()
    models = (("nominal (figure 10)", elastic_rr.nominal), ("calibrated (figure 11)", model))
    for axes, (name, kinematics) in zip(figure.subplots(1, 2), models, strict=True):
        error = _logarithm(_distances(kinematics))
        order = np.argsort(error)  # large errors on top
        low = float(np.quantile(error, 0.01))
        shown = axes.scatter(*real[order].T, c=error[order], s=9, cmap="viridis", vmin=low, linewidths=0)
        figure.colorbar(shown, ax=axes, label=DISTANCE_LABEL, shrink=0.85, extend="min")
        axes.set_title(name, fontsize=10)
        _plane(axes)
    return figure


def histogram_figure(model: Kinematics) -> Figure:
    """Figure 12: histograms of the errors at 3000 random configurations."""
    figure = _new(6.4, 3.8)
    axes = figure.subplots()
    errors = [_logarithm(_distances(kinematics)) for kinematics in (elastic_rr.nominal, model)]
    bins = np.linspace(np.floor(min(e.min() for e in errors)), np.ceil(max(e.max() for e in errors)), 90)
    colours = (NOMINAL_COLOUR, CALIBRATED_COLOUR)
    for name, error, colour in zip(("nominal", "calibrated"), errors, colours, strict=True):
        label = f"{name}: mean {np.mean(10.0**error):.1e}"
        axes.hist(error, bins=list(bins), color=colour, alpha=0.85, label=label)
    axes.set(xlabel=DISTANCE_LABEL, ylabel=f"of {TEST_ROWS} random configurations")
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)
    return figure


DRAWINGS: dict[str, Callable[[Kinematics], Figure]] = {
    "figure_04_poses": lambda model: poses_figure(),
    "figure_06_07_surfaces": surfaces_figure,
    "figure_08_09_workspace": workspaces_figure,
    "figure_10_11_heat_maps": heat_maps_figure,
    "figure_12_histograms": histogram_figure,
}
"""The functions that draw the figures, by file name."""


def _plane(axes: Axes) -> None:
    axes.set(xlabel="$y_1$ [length units]", ylabel="$y_2$ [length units]", aspect="equal")
    axes.grid(alpha=0.2)


def _logarithm(errors: Tensor) -> np.ndarray:
    return errors.clamp(min=SMALLEST_ERROR).log10().numpy()


Nominal = NominalMap | Callable[[Tensor], Tensor]
Calibration = tuple[Tensor, Tensor, Nominal, Kernel, Kernel]
"""(X, P0, k, K_V, K_W), the "tuple encoding the calibrated kinematics"."""

SECTION_5_CONCENTRATION = 1.0186
"""Concentration of K_V in section 5, for both joints."""
SECTION_5_JOINT_VARIANCE = 8.0
"""Variance of K_V in section 5, rad^2."""
SECTION_5_TASK_LENGTH = 0.5135**0.5
"""Length scale of K_W in section 5, length units: exp(-|y - y'|^2 / 1.027)."""
SECTION_5_SIGMA = 0.01
"""sigma of (5), length units, with which the exact model reaches the accuracy that section 5 reports."""
SECTION_5_GRID = 16
"""Grid points per joint in section 5."""


class Descent(NamedTuple):
    """Parameters of the gradient descent in Listing 1.

    Args:
        mu: step, below 2 / (largest eigenvalue of the Hessian), which at the start of section 5 is 4e-10.
        epsilon: tolerance of the gradient's norm. max_iter: limit of iterations.
    """

    mu: float
    epsilon: float
    max_iter: int


class Discretisation(NamedTuple):
    """Variant and time stepping of (17) and (20).

    Args:
        equations: the errata to keep as printed; by default those of :class:`Eulerian`.
        integrator: RK4 with two steps by default.
    """

    equations: Eulerian | None = None
    integrator: Integrator | None = None


def lr_calibration(  # noqa: PLR0917  # as printed
    X: object,
    Y: object,
    k: Nominal,
    K_V: Kernel,
    K_W: Kernel,
    sigma: float,
    descent: Descent,
    discretisation: Discretisation | None = None,
) -> Calibration:
    """Algorithm 1, LR calibration, offline part: gradient descent on (16) with a fixed step.

    Args:
        X: (N, n) configurations, rad or m. Y: (N, m) measured end-effector positions, m.
        k: nominal kinematics. K_V, K_W: reproducing kernels.
        sigma: of (5), m. Section 5 gives "the regularization parameter sigma = 100". As the sigma of (5), 100 would
            leave the model undeformed, since residuals of 0.1 would cost only 1e-6 each. As the weight 1 / (2 sigma^2)
            it means sigma = 0.0707; as 1 / sigma it means the 0.01 of :func:`section_5`, which reaches the reported
            accuracy.
        descent: mu, epsilon and max_iter.
        discretisation: of (17).

    Returns:
        (X, P0, k, K_V, K_W), with P0 (N, m).

    Raises:
        InputError: wrong shapes or values.
        NumericalError: the descent diverges.
    """
    mu, epsilon, max_iter = descent
    check_number(mu, "`mu`", above=0.0)
    check_number(epsilon, "`epsilon`", above=0.0)
    check_count(max_iter, "`max_iter`")
    equations, integrator = _checked(discretisation)
    problem = EulerianProblem(Problem(k, X, Y, joint_kernel=K_V, task_kernel=K_W, noise=sigma), equations)
    P0 = torch.zeros_like(problem.y)  # Initialize P_0 = (P_0^1, ..., P_0^N) <- 0
    i = 0  # Set iteration counter (printed: k <- 0, which shadows the kinematics)
    while i < max_iter:
        P0.requires_grad_()
        found = slope(problem, integrator, _momenta(problem.zero(), P0), P0)  # Solve ODEs (17); gradient of (16)
        if found is None:
            raise NumericalError.of(f"Algorithm 1 diverges after {i} iterations", fix="lower `mu`")
        gradient, P0 = found[1], P0.detach()
        if float(gradient.norm()) < epsilon:
            break  # Convergence criteria met
        P0 = P0 - mu * gradient  # Update the momenta
        i = i + 1  # Increment iteration counter
    return problem.x, P0.detach(), k, K_V, K_W  # Tuple encoding the calibrated kinematics


def evaluate(  # noqa: PLR0917  # as printed
    xi: object,
    X: object,
    P0: object,
    k: Nominal,
    K_V: Kernel,
    K_W: Kernel,
    discretisation: Discretisation | None = None,
) -> tuple[Tensor, Tensor]:
    """Algorithm 2, LR calibration, online part: k1 and Dk1 at new configurations by (20), (21).

    Args:
        xi: (M, n) configurations, rad or m.
        X, P0, k, K_V, K_W: what :func:`lr_calibration` returned.
        discretisation: the same as for :func:`lr_calibration`; the tuple does not contain it.

    Returns:
        k1 (M, m) in m, and Dk1 (M, m, n) transported by (20), which differs from the derivative of k1 by some per cent
        (erratum 2).

    Raises:
        InputError: wrong shapes or values.
        NumericalError: the flow overflows.
    """
    equations, integrator = _checked(discretisation)
    X = as_tensor(X, "X", ("N", "n"))
    P0 = as_tensor(P0, "P0", (len(X), "m"), fix="pass what `lr_calibration` returned")
    check_kernel(K_V, X.shape[1], "K_V")
    check_kernel(K_W, P0.shape[1], "K_W")
    at = as_tensor(xi, "xi", ("M", X.shape[1]), empty=True)
    model = ModelSpec(as_nominal(k), K_V, K_W, X.new_zeros(0), P0.shape[1])
    momenta = Momenta(X[:0], P0, X.new_zeros(0))
    k1 = EulerianDeformation(model, X, momenta, integrator, equations)  # Solve ODEs (17)
    found = k1(at), k1.jacobian(at)  # Solve ODEs (20); (k_1(xi), Dk_1(xi))
    check_finite(found[0], "k(xi)")
    return found


def _checked(discretisation: Discretisation | None) -> tuple[Eulerian, Integrator]:
    equations, integrator = discretisation or Discretisation()
    if integrator is not None and not isinstance(integrator, Integrator):
        raise InputError.of("`integrator`", expected="dc.RK4(2), dc.RK8(1) or the like", got=as_written(integrator))
    return checked_equations(equations), integrator or RK4(2)


def section_5_kernels() -> tuple[RadialKernel, RadialKernel]:
    """K_V and K_W of section 5: von Mises on the torus, Gaussian in the plane."""
    joint = VonMises(concentration=(SECTION_5_CONCENTRATION,) * 2, variance=SECTION_5_JOINT_VARIANCE)
    return joint, Gaussian(lengthscale=SECTION_5_TASK_LENGTH)


def section_5(sigma: float = SECTION_5_SIGMA, k: int = SECTION_5_GRID) -> Problem:
    """The problem of section 5: the elastic RR arm, measured without noise on a k x k grid of joint space.

    Args:
        sigma: of (5), length units. k: grid points per joint.

    Raises:
        InputError: wrong values.
    """
    check_count(k, "`k`")
    x = elastic_rr.grid(k)
    K_V, K_W = section_5_kernels()
    return Problem(elastic_rr.nominal, x, elastic_rr.real(x), joint_kernel=K_V, task_kernel=K_W, noise=sigma)


def _momenta(like: Momenta, P0: Tensor) -> Momenta:
    return Momenta(like.joint, P0, like.theta)
