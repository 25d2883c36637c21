"""What a comparison with new rows says where the old model knows little of them."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from again_bank import arm, model, positions

from diffeo_calib.calibration.recalibration.changes import Change, Changes
from diffeo_calib.calibration.recalibration.compare import Comparison
from diffeo_calib.calibration.recalibration.new_set_up import place_again
from diffeo_calib.calibration.recalibration.recalibrate import weighed

GRAVITY = Change("gravity", 1e-3, angle=False, displacement=1e-3, probability=1e-4)


class Rms(dict[str, SimpleNamespace]):
    """Errors of positions, m."""

    def __init__(self, rms: float) -> None:
        super().__init__(position=SimpleNamespace(rms=rms))
        self.rms_text = f"{1e3 * rms:g} mm"


@pytest.mark.parametrize(
    ("expected", "found", "words"),
    [
        (0.0289, (), r"cannot tell .*28\.9 mm.*0\.2 mm"),
        (3e-4, (), "no change"),
        (0.0289, (GRAVITY,), "gravity has changed"),
    ],
)
def test_rows_of_which_the_old_model_knows_little(expected: float, found: tuple[Change, ...], words: str) -> None:
    changes = Changes(found, {"gravity": 1.0}, 1.0, 20, 0.01)
    compared = Comparison(None, changes, *[cast("Any", Rms(rms)) for rms in (3.4e-3, expected, 2e-4)])
    assert compared.telling == (expected < 1e-3)
    assert re.search(words, str(compared))


def test_errors_that_other_places_explain_are_none() -> None:
    """However unsure a model is, device and marker are where the rows fit best, and that much is expected of them."""
    rows = weighed(place_again(model(positions), positions(arm(), 12, seed=5)), "evidence")
    flat = rows.shifts.flatten(0, 1)
    unsure = rows.with_posterior(rows.posterior + 25.0 * flat @ flat.T)  # errors of the model look like other places
    away = flat @ torch.linspace(-0.02, 0.02, flat.shape[1], dtype=torch.float64)
    for one in (rows, unsure):
        assert float((one.after_placing @ away).norm()) < 0.02 * float(away.norm())
        errors, expected = (float(each.square().mean().sqrt()) for each in (one.placed_residual, one.expected_residual))
        assert 0.4 < errors / expected < 2.5
