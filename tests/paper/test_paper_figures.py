"""The paper's figures: all of them, of the right size, without a warning, of any model."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from image_bank import png_size
from matplotlib.figure import Figure

from diffeo_calib.common.errors import InputError
from diffeo_calib.paper.figures import paper_figures
from diffeo_calib.robots import elastic_rr


def test_every_figure_is_drawn(tmp_path: Path) -> None:
    """Of a model that is off by a millionth of the nominal error."""
    paths = paper_figures(lambda x: elastic_rr.real(x) + 1e-6 * (elastic_rr.nominal(x) - elastic_rr.real(x)), tmp_path)
    assert [path.name.split("_")[1] for path in paths] == ["04", "06", "08", "10", "12"]
    assert sorted(paths) == sorted(tmp_path.iterdir())
    for path in paths:
        width, height = png_size(path)
        assert width >= 890
        assert height >= 600
        assert path.stat().st_size > 20_000


@pytest.mark.slow
def test_an_exact_model_has_no_logarithm_of_zero(tmp_path: Path) -> None:
    assert len(paper_figures(elastic_rr.real, tmp_path)) == 5


def test_other_formats_and_folders_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffeo_calib.paper.figures._figures", lambda model: [("one", Figure())])
    assert paper_figures(elastic_rr.real, str(tmp_path), ".pdf")[0].read_bytes()[:4] == b"%PDF"
    with pytest.raises(InputError, match=r"`suffix`: expected .png, .pdf, .svg, got '.gif'"):
        paper_figures(elastic_rr.real, tmp_path, ".gif")


def test_a_folder_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"folder of figures.*expected an existing folder"):
        paper_figures(torch.zeros_like, tmp_path / "none")
