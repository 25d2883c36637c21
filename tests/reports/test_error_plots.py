"""The plot of errors by stage: its curves and points are the errors, for any data, and files are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from image_bank import png_size
from matplotlib.axes import Axes
from product_bank import Case
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import write_figure
from diffeo_calib.sensors.errors import Evaluation


def errors(rows: int, scale: float, seed: int, markers: int = 1) -> Evaluation:
    return Evaluation(scale * torch.from_numpy(np.random.default_rng(seed).exponential(size=(rows, markers))))


def panels(stages: dict[str, Evaluation]) -> tuple[Axes, Axes]:
    left, right = dc.plots.stages(stages, "title").axes
    return left, right


def millimetres(evaluation: Evaluation) -> np.ndarray:
    return 1e3 * evaluation.errors.flatten().numpy()


def points(axes: Axes) -> np.ndarray:
    """The points of a scatter plot: (N, 2)."""
    (scatter,) = axes.collections
    return np.asarray(scatter.get_offsets())


FIVE = {f"stage {k}": errors(30, 10.0**-k, k, markers=2) for k in range(3, 8)}


def test_every_stage_has_the_distribution_of_its_errors() -> None:
    left, _ = panels(FIVE)
    assert len(left.lines) == 5
    assert len({line.get_color() for line in left.lines}) == 5
    for line, (name, evaluation) in zip(left.lines, FIVE.items(), strict=True):
        np.testing.assert_allclose(np.asarray(line.get_xdata()), np.sort(millimetres(evaluation)), rtol=1e-12)
        np.testing.assert_allclose(np.asarray(line.get_ydata()), 100 * np.arange(1, 61) / 60, rtol=1e-12)
        assert line.get_label() == f"{name}: {1e3 * evaluation.rms:.3g} mm RMS"
    assert (left.get_xlabel(), left.get_ylabel()) == ("position error [mm]", "measurements [%]")
    assert left.get_xscale() == "log"
    assert left.get_ylim()[1] > 100.0
    legend = left.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [line.get_label() for line in left.lines]


def test_the_last_stage_is_drawn_against_the_one_before() -> None:
    _, right = panels(FIVE)
    before, after = millimetres(FIVE["stage 6"]), millimetres(FIVE["stage 7"])
    np.testing.assert_allclose(points(right), np.stack([before, after], 1), rtol=1e-12)
    assert (right.get_xlabel(), right.get_ylabel()) == ("stage 6: error [mm]", "stage 7: error [mm]")
    assert right.get_title() == f"better for {100 * (after < before).mean():.0f} % of the measurements"
    (diagonal,) = right.lines
    np.testing.assert_array_equal(diagonal.get_xdata(), diagonal.get_ydata())
    for low, high in (right.get_xlim(), right.get_ylim()):
        assert low < min(before.min(), after.min())
        assert high > max(before.max(), after.max())


def test_stages_of_a_calibration(arm: Case, tmp_path: Path) -> None:
    stages = {name: dc.evaluate(kinematics, arm.test) for name, kinematics in arm.result.stages.items()}
    left, right = panels(stages)
    assert len(left.lines) == len(stages) == 3
    assert points(right).shape == (len(arm.test), 2)
    geometry, diffeomorphic = points(right).T
    assert right.get_title() == f"better for {100 * (diffeomorphic < geometry).mean():.0f} % of the measurements"
    write_figure(dc.plots.stages(stages, "simulated arm: errors on 300 held-out rows"), tmp_path / "stages.png")
    assert png_size(tmp_path / "stages.png") == (1408, 544)


def test_the_title_names_the_measurements() -> None:
    assert dc.plots.stages(FIVE, "errors on 30 rows").get_suptitle() == "errors on 30 rows"


@pytest.mark.parametrize("rows", [1, 2])
def test_hardly_any_rows(rows: int, tmp_path: Path) -> None:
    stages = {"before": errors(rows, 1e-3, 0), "after": errors(rows, 1e-4, 1)}
    left, right = panels(stages)
    assert [len(np.atleast_1d(line.get_xdata())) for line in left.lines] == [rows, rows]
    assert points(right).shape == (rows, 2)
    write_figure(dc.plots.stages(stages, "few rows"), tmp_path / "few.png")


def same(value: float) -> Tensor:
    return torch.full((5, 1), value, dtype=torch.float64)


def test_equal_errors() -> None:
    _, right = panels({"before": Evaluation(same(1e-4)), "after": Evaluation(same(1e-4))})
    assert right.get_title() == "better for 0 % of the measurements"
    np.testing.assert_allclose(points(right), 0.1, rtol=1e-12)


def test_errors_of_zero(tmp_path: Path) -> None:
    """A logarithmic axis has no zero: they are drawn as tiny errors, without a warning."""
    stages = {"before": Evaluation(same(1e-3)), "after": Evaluation(same(0.0))}
    left, right = panels(stages)
    drawn = np.asarray(left.lines[1].get_xdata())
    assert bool((drawn > 0).all())
    assert float(drawn.max()) < 1e-6
    np.testing.assert_allclose(points(right)[:, 1], drawn, rtol=1e-12)
    write_figure(dc.plots.stages(stages, "perfect"), tmp_path / "zero.png")


def test_long_titles_are_drawn(tmp_path: Path) -> None:
    write_figure(
        dc.plots.stages(FIVE, "five stages of two markers, with a title longer than usual " * 2),
        str(tmp_path / "many.png"),
    )
    assert png_size(tmp_path / "many.png") == (1408, 544)


def test_other_formats_by_suffix(tmp_path: Path) -> None:
    stages = {"before": errors(9, 1e-3, 0), "after": errors(9, 1e-4, 1)}
    write_figure(dc.plots.stages(stages, "vector"), tmp_path / "stages.svg")
    assert "<svg" in (tmp_path / "stages.svg").read_text()
    write_figure(dc.plots.stages(stages, "vector"), tmp_path / "stages.pdf")
    assert (tmp_path / "stages.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("name", ["stages.xyz", "none/stages.png"])
def test_a_place_that_cannot_be_written_is_an_input_error(name: str, tmp_path: Path) -> None:
    stages = {"before": errors(9, 1e-3, 0), "after": errors(9, 1e-4, 1)}
    with pytest.raises(InputError, match="stages"):
        write_figure(dc.plots.stages(stages, "nowhere"), tmp_path / name)
