"""The paper's figures of any model: their curves, points and limits are positions and errors; files are written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from image_bank import png_size
from paper_figures import (
    POSES,
    heat_maps_figure,
    histogram_figure,
    main,
    paper_figures,
    poses_figure,
    surfaces_figure,
    workspaces_figure,
)
from rr_bed import held_out
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import elastic_rr

GAIN = 1e-6


def model(x: Tensor) -> Tensor:
    """A model whose errors are a millionth of the nominal ones."""
    return elastic_rr.real(x) + GAIN * (elastic_rr.nominal(x) - elastic_rr.real(x))


def log_errors() -> np.ndarray:
    """log10 of the nominal errors at the random configurations: (3000,)."""
    x = held_out()
    return (elastic_rr.nominal(x) - elastic_rr.real(x)).norm(dim=1).log10().numpy()


def curve(line: Any) -> np.ndarray:
    """(N, 2)"""
    return np.stack([line.get_xdata(), line.get_ydata()], 1)


def test_random_configurations_cover_the_torus() -> None:
    x = held_out()
    assert x.shape == (3000, 2)
    assert 3.1 < float(x.abs().max()) <= torch.pi
    assert torch.equal(x, held_out())


def test_poses_show_both_arms() -> None:
    (axes,) = poses_figure().axes
    x = torch.tensor(POSES, dtype=torch.float64)
    drawn = [curve(line) for line in axes.lines]
    rigid = [line for line in drawn if len(line) == 3 and not line[0].any()]
    np.testing.assert_allclose(np.stack([line[-1] for line in rigid]), elastic_rr.nominal(x), atol=1e-12)
    np.testing.assert_allclose([np.linalg.norm(np.diff(line, axis=0), axis=1) for line in rigid], [[1.0, 0.5]] * 5)
    bent = [line for line in drawn if len(line) > 3]
    np.testing.assert_allclose(np.stack(bent), elastic_rr.real_links(x).flatten(1, 2), atol=1e-12)
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["nominal", "real"]


def test_surfaces_are_coloured_by_the_errors() -> None:
    """Four panels and two colour bars, whose limits are a million times smaller for the model."""
    drawn = surfaces_figure(model).axes
    surfaces, (nominal, calibrated) = [a for a in drawn if a.get_title()], [a for a in drawn if not a.get_title()]
    names = ("nominal (figure 6)", "calibrated (figure 7)")
    assert [a.get_title() for a in surfaces] == [f"{name}, $y_{k}$" for name in names for k in (1, 2)]
    assert nominal.get_ylabel() == calibrated.get_ylabel() == "log10 of the |error| / length unit"
    top = np.array([bar.get_ylim()[1] for bar in (nominal, calibrated)])
    assert top[0] - top[1] == pytest.approx(6.0, abs=1e-3)
    side = torch.linspace(-torch.pi, torch.pi, 61, dtype=torch.float64)
    x = torch.cartesian_prod(side, side)
    largest = float((elastic_rr.nominal(x) - elastic_rr.real(x)).abs().max().log10())
    assert top[0] == pytest.approx(largest, abs=1e-9)


def test_workspaces_are_images_of_one_grid() -> None:
    for axes, (name, distance) in zip(
        workspaces_figure(model).axes, (("nominal (figure 8)", 0.3), ("calibrated (figure 9)", GAIN)), strict=True
    ):
        assert axes.get_title() == name
        curves = [curve(line) for line in axes.lines if len(np.atleast_1d(line.get_xdata()))]
        half = len(curves) // 2
        assert half == 13 + 24
        gaps = [np.abs(a - b).max() for a, b in zip(curves[:half], curves[half:], strict=True)]
        assert max(gaps) < distance
        assert max(np.linalg.norm(points, axis=1).max() for points in curves) < 1.6  # the reach is 1.5


def test_heat_maps_show_every_error_where_the_tip_is() -> None:
    axes = [a for a in heat_maps_figure(model).axes if a.get_title()]
    assert [a.get_title() for a in axes] == ["nominal (figure 10)", "calibrated (figure 11)"]
    expected, real = log_errors(), elastic_rr.real(held_out()).numpy()
    order = np.argsort(expected)
    for panel, shift in zip(axes, (0.0, -6.0), strict=True):
        (scatter,) = panel.collections
        np.testing.assert_allclose(np.asarray(scatter.get_array()), expected[order] + shift, atol=1e-4)
        offsets = np.asarray(scatter.get_offsets())
        np.testing.assert_allclose(offsets[np.lexsort(offsets.T)], real[np.lexsort(real.T)], atol=1e-12)


def test_histograms_count_every_configuration() -> None:
    (axes,) = histogram_figure(model).axes
    counts = [sum(bar.get_height() for bar in bars) for bars in axes.containers]  # pyright: ignore
    assert counts == [3000, 3000]
    legend = axes.get_legend()
    assert legend is not None
    means = [f"mean {(10 ** (log_errors() + shift)).mean():.1e}" for shift in (0.0, -6.0)]
    names = [f"{name}: {mean}" for name, mean in zip(("nominal", "calibrated"), means, strict=True)]
    assert [text.get_text() for text in legend.get_texts()] == names
    assert axes.get_ylabel() == "of 3000 random configurations"


@pytest.mark.slow
def test_an_exact_model_has_no_logarithm_of_zero(tmp_path: Path) -> None:
    assert len(paper_figures(elastic_rr.real, tmp_path)) == 5


def test_a_folder_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"folder of figures.*expected an existing folder"):
        paper_figures(torch.zeros_like, tmp_path / "none")


@pytest.mark.slow
def test_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["paper_figures.py", "--out", str(tmp_path)])
    main()
    printed = capsys.readouterr().out
    assert "energy (16) 5.696" in printed
    assert "5.07 orders of magnitude less" in printed
    paths = sorted(tmp_path.iterdir())
    assert [path.name.split("_")[1] for path in paths] == ["04", "06", "08", "10", "12"]
    for path in paths:
        assert min(png_size(path)) >= 600
