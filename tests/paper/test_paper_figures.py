"""The paper's figures of any model: their curves, points and limits are positions and errors; files are written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from image_bank import png_size
from paper_figures import (
    heat_maps_figure,
    histogram_figure,
    main,
    paper_figures,
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
