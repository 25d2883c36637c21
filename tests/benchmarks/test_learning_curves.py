"""Means and learning curves of the benchmark on real robots."""

from __future__ import annotations

from pathlib import Path

import learning_curves
import numpy as np
import pytest
from harness import Record
from numpy.testing import assert_allclose

from diffeo_calib.common.errors import InputError


def made(method: str, size: str, seed: int, rms: float | None, dataset: str = "arm") -> Record:
    train = 142.0 if size == "all" else float(size)
    record: Record = {"dataset": dataset, "protocol": "curve", "size": size, "method": method, "fold_or_seed": seed}
    return (
        record | {"train": train, "test": 60} | ({"note": "failed"} if rms is None else {"rms_mm": rms, "note": None})
    )


RECORDS = [
    made(method, size, seed, level * (1 + 0.1 * seed) / 10**shrink, dataset)
    for dataset in ("arm", "other")
    for method, level in (("geometry", 0.4), ("diffeo_calib", 0.2), ("unheard of", 0.3))
    for shrink, size in ((0.0, "60"), (0.2, "120"), (0.3, "all"))
    for seed in range(3)
]


def test_means_over_seeds() -> None:
    rows = learning_curves.summary([*reversed(RECORDS), made("geometry", "60", 3, None)])
    names = [(row["dataset"], row["size"], row["method"]) for row in rows]
    methods = ("geometry", "diffeo_calib", "unheard of")
    assert names == [(d, s, m) for d in ("arm", "other") for s in ("60", "120", "all") for m in methods]
    assert (rows[0]["runs"], rows[0]["failed"]) == (3, 1)
    assert rows[0]["rms_mm"] == pytest.approx(0.44)
    assert rows[0]["coverage_95"] is None


def test_nothing_but_failures() -> None:
    (row,) = learning_curves.summary([made("geometry", "60", 0, None)])
    assert (row["runs"], row["failed"], row["rms_mm"]) == (0, 1, None)


def test_curves_show_the_means_and_the_range_of_seeds() -> None:
    figure = learning_curves.curves(RECORDS)
    panels = {axes.get_title(): axes for axes in figure.axes}
    assert list(panels) == ["arm", "other"]
    lines = {str(line.get_label()): line for line in panels["arm"].get_lines()}
    assert list(lines) == ["geometry", "diffeo_calib", "unheard of"]
    shrinks = (1.0, 10**-0.2, 10**-0.3)
    for name, level in (("geometry", 0.4), ("diffeo_calib", 0.2), ("unheard of", 0.3)):
        assert_allclose(np.asarray(lines[name].get_xdata()), [60, 120, 142])
        means = [1.1 * level * shrink for shrink in shrinks]  # of 3 seeds
        assert_allclose(np.asarray(lines[name].get_ydata()), means)
    bars = [np.asarray(path.vertices)[:, 1] for bars in panels["arm"].collections for path in bars.get_paths()]
    assert_allclose(bars[0], [0.4, 0.48])  # of geometry at 60 poses
    assert sorted(panels["arm"].get_xticks()) == [60, 120, 142]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["geometry", "diffeo_calib", "unheard of"]


def test_a_method_far_above_is_written_in_numbers() -> None:
    records = [made("registration", "60", 0, 0.8), made("geometry", "60", 0, 0.4), made("GP alone", "60", 0, 38.6)]
    (axes,) = learning_curves.curves(records).axes
    assert [text.get_text() for text in axes.texts] == ["GP alone: 38.6 mm"]
    assert axes.get_ylim()[1] == pytest.approx(1.6)  # twice the registration's error


def test_the_figure_is_written(tmp_path: Path) -> None:
    learning_curves.draw(RECORDS, tmp_path / "curves.svg")
    assert "<!-- diffeo_calib -->" in (tmp_path / "curves.svg").read_text()


def test_figures_that_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="protocol curve"):
        learning_curves.draw([record | {"protocol": "kfold"} for record in RECORDS], tmp_path / "curves.png")
    for place in (tmp_path / "curves.xyz", tmp_path / "none" / "curves.png"):
        with pytest.raises(InputError, match="curves"):
            learning_curves.draw(RECORDS, place)
