"""The paper's figures of any model: their curves, points and limits are positions and errors; files are written."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from matplotlib.image import imread
from paper_figures import main, paper_figures

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import elastic_rr

GAIN = 1e-6


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
        assert min(imread(path).shape[:2]) >= 600
