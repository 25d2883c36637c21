"""The paper's section 5: the elastic RR arm is calibrated, and the figures 4 and 6 to 12 are drawn of it.

    python benchmarks/paper_arm/paper_figures.py --out FOLDER

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025:
poses (figure 4), surfaces coloured by the error (6, 7), grids in the workspace (8, 9), heat maps (10, 11) and
histograms (12).
"Real" is the elastic arm, "nominal" the model (22), "calibrated" the fitted model. Errors are in the test bed's
length units; the arm's reach is 1.5.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
from collections.abc import Callable
from math import log10, pi
from typing import Any

import numpy as np
import torch
from harness import guarded
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from rr_bed import TEST_ROWS, held_out
from section_5 import section_5
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import elastic_rr

Kinematics = Callable[[Tensor], Tensor]
GRID_LINES, SURFACE_POINTS = 25, 61
"""Lines of the workspace's grid and points of the surfaces, per joint."""
POSES = ((0.3, 0.9), (1.3, 0.8), (2.4, -0.9), (3.7, 0.7), (4.9, 1.1))
"""Joint angles of the arms in figure 4 [rad]."""
REAL_COLOUR, NOMINAL_COLOUR, CALIBRATED_COLOUR = "#b5525c", "#5c6773", "#1f6f8b"
SMALLEST_ERROR = 1e-12
"""Smaller errors are drawn as this one [length units]."""
DISTANCE_LABEL, COMPONENT_LABEL = "log10 of the distance / length unit", "log10 of the |error| / length unit"


def paper_figures(model: Kinematics, folder: Path) -> list[Path]:
    """Draw all figures of calibrated kinematics, (N, 2) rad -> (N, 2) length units, into an existing folder."""
    if not folder.is_dir():
        raise InputError.of(f"the folder of figures '{folder}'", expected="an existing folder")
    paths = []
    for name, draw in DRAWINGS.items():
        paths.append(folder / f"{name}.png")
        draw(model).savefig(paths[-1], dpi=300)
    return paths


def _distances(model: Kinematics) -> Tensor:
    """Distances from the real arm at the random configurations of figures 10 to 12: (3000,)."""
    x = held_out()
    return (model(x) - elastic_rr.real(x)).norm(dim=1)


def poses_figure() -> Figure:
    """Figure 4: nominal and real arm at the same joint angles."""
    figure = Figure(figsize=(5.6, 5.2), layout="constrained")
    axes = figure.subplots()
    x = torch.tensor(POSES, dtype=torch.float64)
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
    figure = Figure(figsize=(9.6, 8.2), layout="constrained")
    side = torch.linspace(-pi, pi, SURFACE_POINTS, dtype=torch.float64)
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

    shown = ScalarMappable(Normalize(*limits), "viridis")
    figure.colorbar(shown, ax=panels, label=COMPONENT_LABEL, shrink=0.7, pad=0.06, extend="min")


def workspaces_figure(model: Kinematics) -> Figure:
    """Figures 8 and 9: images of a grid of joint space, by the real arm and by the nominal or calibrated model."""
    figure = Figure(figsize=(9.6, 5.0), layout="constrained")
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
    fine = torch.linspace(-pi, pi, 8 * SURFACE_POINTS, dtype=torch.float64)
    for value in torch.linspace(0.0, pi, GRID_LINES // 2 + 1, dtype=torch.float64):
        axes.plot(*kinematics(torch.stack([fine, value.expand_as(fine)], 1)).T.numpy(), color=colour, lw=width)
    half = fine[fine >= 0]
    for value in torch.linspace(-pi, pi, GRID_LINES, dtype=torch.float64)[:-1]:
        axes.plot(*kinematics(torch.stack([value.expand_as(half), half], 1)).T.numpy(), color=colour, lw=width)


def heat_maps_figure(model: Kinematics) -> Figure:
    """Figures 10 and 11: errors at 3000 random configurations, drawn at the real arm's tip."""
    figure = Figure(figsize=(10.4, 4.8), layout="constrained")
    real = elastic_rr.real(held_out()).numpy()
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
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
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


def main() -> None:
    """Fit the paper's arm, print how accurate it is, and draw its figures."""
    parser = argparse.ArgumentParser(description="Calibrate the arm of the paper's section 5 and draw its figures.")
    parser.add_argument("--out", type=Path, metavar="FOLDER", required=True, help="existing folder for the figures")
    folder = parser.parse_args().out
    fit = dc.fit(section_5())
    print(f"256 measurements of the elastic RR arm, sigma 0.01: energy (16) {fit.energy:.6e}, {fit.status}")
    print(f"coupling residual {fit.coupling_residual:.1e}, end residual {fit.end_residual:.1e}, {fit.seconds:.2f} s")
    nominal, calibrated = (float(_distances(model).mean()) for model in (elastic_rr.nominal, fit.model))
    print(
        f"mean error in {TEST_ROWS} other configurations: nominal {nominal:.2e}, calibrated {calibrated:.2e}, "
        f"{log10(nominal / calibrated):.2f} orders of magnitude less"
    )
    for path in paper_figures(fit.model, folder):
        print(f"figure: {path}")


if __name__ == "__main__":
    guarded(main)
