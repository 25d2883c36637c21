"""The figure of a calibration: an image of the right size, for any data, without a warning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from image_bank import png_size
from matplotlib.colors import to_rgb
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.reports.figures import COLOURS, stages_figure


def drawn(path: Path, colour: str | np.ndarray, left: bool) -> int:
    """How many pixels of one half of the image have exactly this colour."""
    from matplotlib.image import imread

    wanted = to_rgb(colour) if isinstance(colour, str) else colour
    pixels = np.split(imread(path)[..., :3], 2, axis=1)[0 if left else 1]
    return int((np.abs(pixels - np.array(wanted)) < 0.003).all(-1).sum())


def errors(rows: int, scale: float, seed: int) -> Evaluation:
    return Evaluation(scale * torch.from_numpy(np.random.default_rng(seed).exponential(size=(rows, 1))))


def test_stages_of_a_calibration(arm: Case, tmp_path: Path) -> None:
    stages = {name: dc.evaluate(kinematics, arm.test) for name, kinematics in arm.result.stages.items()}
    stages_figure(stages, tmp_path / "stages.png", "simulated arm: errors on 300 held-out rows")
    assert png_size(tmp_path / "stages.png") == (1600, 768)
    assert (tmp_path / "stages.png").stat().st_size > 20_000
    for colour in COLOURS[:3]:  # a curve for each stage
        assert drawn(tmp_path / "stages.png", colour, left=True) > 300
    assert drawn(tmp_path / "stages.png", COLOURS[0], left=False) > 300  # the line of no change
    dots = 0.6 * np.array(to_rgb(COLOURS[2])) + 0.4  # 60 % of the colour on white
    assert drawn(tmp_path / "stages.png", dots, left=False) > 300


@pytest.mark.parametrize("rows", [1, 2])
def test_hardly_any_rows(rows: int, tmp_path: Path) -> None:
    stages = {"before": errors(rows, 1e-3, 0), "after": errors(rows, 1e-4, 1)}
    stages_figure(stages, tmp_path / "few.png", "few rows")
    assert png_size(tmp_path / "few.png") == (1600, 768)


def test_many_stages_and_markers(tmp_path: Path) -> None:
    stages = {f"stage {k}": Evaluation(errors(60, 10.0**-k, k).errors.reshape(30, 2)) for k in range(3, 8)}
    stages_figure(
        stages, str(tmp_path / "many.png"), "five stages of two markers, with a title that is longer than usual " * 2
    )
    assert png_size(tmp_path / "many.png") == (1600, 768)


def test_equal_errors(tmp_path: Path) -> None:
    same = Evaluation(torch.full((5, 1), 1e-4, dtype=torch.float64))
    stages_figure({"before": same, "after": same}, tmp_path / "same.png", "nothing gained")
    assert png_size(tmp_path / "same.png") == (1600, 768)


def test_errors_of_zero(tmp_path: Path) -> None:
    """A logarithmic axis has no place for them; the figure must still be drawn, silently."""
    nothing = Evaluation(torch.zeros(4, 1, dtype=torch.float64))
    stages_figure({"before": errors(4, 1e-3, 0), "after": nothing}, tmp_path / "zero.png", "perfect")
    assert png_size(tmp_path / "zero.png") == (1600, 768)


def test_other_formats_by_suffix(tmp_path: Path) -> None:
    stages = {"before": errors(9, 1e-3, 0), "after": errors(9, 1e-4, 1)}
    stages_figure(stages, tmp_path / "stages.svg", "vector")
    assert "<svg" in (tmp_path / "stages.svg").read_text()
    stages_figure(stages, tmp_path / "stages.pdf", "vector")
    assert (tmp_path / "stages.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("name", ["stages.xyz", "none/stages.png"])
def test_a_place_that_cannot_be_written_is_an_input_error(name: str, tmp_path: Path) -> None:
    stages = {"before": errors(9, 1e-3, 0), "after": errors(9, 1e-4, 1)}
    with pytest.raises(InputError, match="stages"):
        stages_figure(stages, tmp_path / name, "nowhere")
