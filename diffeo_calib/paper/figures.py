"""The figures of the paper's section 5, drawn for any calibrated model of its elastic RR arm.

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025:
poses (figure 4), surfaces coloured by the error (6, 7), the workspace's grid (8, 9), heat maps (10, 11) and
histograms (12).
"Real" is the elastic arm, "nominal" the model (22), "calibrated" what a fit made of it. Errors are in the test bed's
length units; the arm's reach is 1.5.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.robots import elastic_rr

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Kinematics = Callable[[Tensor], Tensor]
TEST_ROWS, SEED = 3000, 0
GRID, FINE = 25, 61
"""Lines of the workspace's grid, and points of the surfaces, in each direction."""
POSES = ((0.3, 0.9), (1.3, 0.8), (2.4, -0.9), (3.7, 0.7), (4.9, 1.1))
"""Joint angles of the arms in figure 4 [rad]."""
REAL, NOMINAL, CALIBRATED = "#b5525c", "#5c6773", "#1f6f8b"
SUFFIXES = (".png", ".pdf", ".svg")
SMALLEST = 1e-12
"""Errors below are drawn as this."""
ERROR, COMPONENT = "log10 of the distance / length unit", "log10 of the |error| / length unit"


def mean_error(model: Kinematics) -> float:
    """Mean distance from the real arm over the random configurations of figures 10 to 12, length units."""
    test = _test_rows()
    return float((model(test) - elastic_rr.real(test)).norm(dim=1).mean())


def paper_figures(model: Kinematics, folder: str | Path, suffix: str = ".png") -> list[Path]:
    """Draw all of them.

    Args:
        model: calibrated kinematics, (N, 2) rad -> (N, 2) length units.
        folder: where to write the files; it has to exist.
        suffix: ".png" (300 dpi), ".pdf" or ".svg".

    Returns:
        the files.

    Raises:
        InputError: the folder does not exist, or an unknown suffix.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(sentence(f"the folder of figures '{folder}'", expected="an existing folder"))
    if suffix not in SUFFIXES:
        raise InputError(sentence("`suffix`", expected=", ".join(SUFFIXES), got=repr(suffix)))
    paths = []
    for name, figure in _figures(model):
        paths.append(folder / f"{name}{suffix}")
        try:
            figure.savefig(paths[-1], dpi=300)
        except OSError as error:
            what = f"the figure '{paths[-1]}' cannot be written ({error.strerror})"
            raise InputError(sentence(what, fix="name another folder")) from error
    return paths


def _figures(model: Kinematics) -> Iterator[tuple[str, Figure]]:
    yield "figure_04_poses", _poses()
    yield "figure_06_07_surfaces", _surfaces(model)
    yield "figure_08_09_workspace", _workspaces(model)
    test = _test_rows()
    real = elastic_rr.real(test)
    errors = [_logarithm((kinematics(test) - real).norm(dim=1)) for kinematics in (elastic_rr.nominal, model)]
    yield "figure_10_11_heat_maps", _heat_maps(real.numpy(), errors)
    yield "figure_12_histograms", _histogram(errors)


def _test_rows() -> Tensor:
    generator = seeded(SEED)
    return pi * (2 * torch.rand(TEST_ROWS, 2, generator=generator, dtype=torch.float64, device=HOST) - 1)


def _new(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure  # noqa: PLC0415  # slow to import, needed for figures only

    return Figure(figsize=(width, height), layout="constrained")


def _poses() -> Figure:
    """Figure 4: the same joint angles make different arms."""
    figure = _new(5.6, 5.2)
    axes = figure.subplots()
    x = torch.tensor(POSES, dtype=torch.float64, device=HOST)
    elbow = elastic_rr.NOMINAL_LENGTHS[0] * torch.stack([x[:, 0].cos(), x[:, 0].sin()], 1)
    rigid = torch.stack([torch.zeros_like(elbow), elbow, elastic_rr.nominal(x)], 1).numpy()
    bent = elastic_rr.real_links(x).flatten(1, 2).numpy()
    for k in range(len(POSES)):
        axes.plot(*rigid[k].T, color=NOMINAL, lw=1.6, ls=(0, (4, 2)), marker="o", ms=4, mfc="white")
        axes.plot(*bent[k].T, color=REAL, lw=2.0)
        axes.plot(*bent[k][[0, bent.shape[1] // 2, -1]].T, color=REAL, ls="", marker="o", ms=4)
    axes.plot([], [], color=NOMINAL, ls=(0, (4, 2)), marker="o", ms=4, mfc="white", label="nominal")
    axes.plot([], [], color=REAL, marker="o", ms=4, label="real")
    axes.legend(frameon=False, loc="upper right")
    _plane(axes)
    return figure


def _surfaces(model: Kinematics) -> Figure:
    """Figures 6 and 7: both coordinates of the real arm over joint space, coloured by the error of each coordinate."""
    from matplotlib import colormaps  # noqa: PLC0415

    figure = _new(9.6, 8.2)
    side = torch.linspace(-pi, pi, FINE, dtype=torch.float64, device=HOST)
    x = torch.cartesian_prod(side, side)
    real = elastic_rr.real(x)
    X1, X2 = (x[:, k].view(FINE, FINE).numpy() for k in (0, 1))
    rows = (("nominal (figure 6)", elastic_rr.nominal), ("calibrated (figure 7)", model))
    for row, (name, kinematics) in enumerate(rows):
        errors = _logarithm((kinematics(x) - real).abs())
        low, high = np.quantile(errors, (0.02, 1.0))
        panels = [_surface_axes(figure, 2 * row + 1 + k) for k in (0, 1)]
        for k, axes in enumerate(panels):
            shade = np.clip((errors[:, k] - low) / max(high - low, SMALLEST), 0.0, 1.0).reshape(FINE, FINE)
            height = real[:, k].view(FINE, FINE).numpy()
            axes.plot_surface(X1, X2, height, facecolors=colormaps["viridis"](shade), rcount=FINE, ccount=FINE, lw=0)
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
    figure.colorbar(shown, ax=panels, label=COMPONENT, shrink=0.7, pad=0.06, extend="min")


def _workspaces(model: Kinematics) -> Figure:
    """Figures 8 and 9: the grid of joint space as the real arm sees it, and as nominal and calibrated model do."""
    figure = _new(9.6, 5.0)
    for axes, (name, kinematics, colour) in zip(
        figure.subplots(1, 2),
        (
            ("nominal (figure 8)", elastic_rr.nominal, NOMINAL),
            ("calibrated (figure 9)", model, CALIBRATED),
        ),
        strict=True,
    ):
        _mesh(axes, elastic_rr.real, REAL, 2.0)  # shows on both sides of an equal line
        _mesh(axes, kinematics, colour, 0.7)
        axes.plot([], [], color=REAL, lw=2.0, label="real")
        axes.plot([], [], color=colour, lw=0.7, label=name.split()[0])
        axes.legend(frameon=True, framealpha=0.9, edgecolor="none", loc="upper right", fontsize=8)
        axes.set_title(name, fontsize=10)
        _plane(axes)
    return figure


def _mesh(axes: Axes, kinematics: Kinematics, colour: str, width: float) -> None:
    """Images of the lines x1 = constant and x2 = constant; half of the latter, which cover the workspace once."""
    fine = torch.linspace(-pi, pi, 8 * FINE, dtype=torch.float64, device=HOST)
    for value in torch.linspace(0.0, pi, GRID // 2 + 1, dtype=torch.float64, device=HOST):
        axes.plot(*kinematics(torch.stack([fine, value.expand_as(fine)], 1)).T.numpy(), color=colour, lw=width)
    half = fine[fine >= 0]
    for value in torch.linspace(-pi, pi, GRID, dtype=torch.float64, device=HOST)[:-1]:
        axes.plot(*kinematics(torch.stack([value.expand_as(half), half], 1)).T.numpy(), color=colour, lw=width)


def _heat_maps(real: np.ndarray, errors: list[np.ndarray]) -> Figure:
    """Figures 10 and 11: errors of 3000 random configurations where the real arm's tip is."""
    figure = _new(10.4, 4.8)
    for axes, name, error in zip(
        figure.subplots(1, 2), ("nominal (figure 10)", "calibrated (figure 11)"), errors, strict=True
    ):
        order = np.argsort(error)  # large errors on top
        low = float(np.quantile(error, 0.01))
        shown = axes.scatter(*real[order].T, c=error[order], s=9, cmap="viridis", vmin=low, linewidths=0)
        figure.colorbar(shown, ax=axes, label=ERROR, shrink=0.85, extend="min")
        axes.set_title(name, fontsize=10)
        _plane(axes)
    return figure


def _histogram(errors: list[np.ndarray]) -> Figure:
    """Figure 12: how often errors of a size occur."""
    figure = _new(6.4, 3.8)
    axes = figure.subplots()
    bins = np.linspace(np.floor(min(e.min() for e in errors)), np.ceil(max(e.max() for e in errors)), 90)
    for name, error, colour in zip(("nominal", "calibrated"), errors, (NOMINAL, CALIBRATED), strict=True):
        label = f"{name}: mean {np.mean(10.0**error):.1e}"
        axes.hist(error, bins=list(bins), color=colour, alpha=0.85, label=label)
    axes.set(xlabel=ERROR, ylabel=f"of {len(errors[0])} random configurations")
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)
    return figure


def _plane(axes: Axes) -> None:
    axes.set(xlabel="$y_1$ [length units]", ylabel="$y_2$ [length units]", aspect="equal")
    axes.grid(alpha=0.2)


def _logarithm(errors: Tensor) -> np.ndarray:
    return errors.clamp(min=SMALLEST).log10().numpy()
