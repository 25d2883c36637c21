"""Markers that are mounted anew between sessions of one measuring frame: found, fitted, judged, predicted, saved."""

from pathlib import Path
from typing import Any

import pytest
import torch
from product_bank import usual_scales
from source_bank import remounted

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation

ARM = SimulatedArm(seed=1)
SHIFTS = torch.tensor([[0.0, 0.0, 0.0], [3e-3, 4e-3, 0.0], [0.0, -3e-3, 4e-3]], dtype=torch.float64)  # 5 mm each
ROWS = 120


def table(rows: int, seed: int) -> dc.Measurements:
    return dc.Measurements(*ARM.measure(rows, seed=seed), ARM.nominal.joint_names)


def calibrated(data: dc.Measurements) -> Any:
    return dc.calibrate(ARM.nominal, data, hyperparameters=usual_scales(ARM.nominal))


@pytest.fixture(scope="module")
def result() -> Any:
    return calibrated(remounted(ARM, table(ROWS, 1), SHIFTS))


def test_the_shifts_are_found(result: Any) -> None:
    found = result.sessions.devices
    order = ["abc".index(name) for name in found.names]
    away = (found.constants - SHIFTS[order]).abs()
    assert bool((away < 5 * found.deviations + 1e-9).all())
    assert float(found.deviations.max()) < 3e-5
    assert [text.split("'")[1] for text in result.placement.sentences()] == ["b", "c"]
    assert all("5.0" in text and " mm" in text for text in result.placement.sentences())


def test_rows_of_known_and_of_new_sessions_are_judged(result: Any, tmp_path: Path) -> None:
    dc.save(result.model, tmp_path / "arm.safetensors")
    model: Any = dc.load(tmp_path / "arm.safetensors")
    rows = table(40, 5)
    plain, new = dc.evaluate(model, rows), remounted(ARM, rows, SHIFTS)
    known: Any = dc.evaluate(model, new)
    assert known.numbers == 0
    assert known.rms < 1.2 * plain.rms
    renamed = new.with_sessions([f"{name} again" for name in new.device_names], remounted=True)
    placed: Any = dc.evaluate(model, renamed)
    assert placed.numbers == 9
    assert placed.rms < 1.2 * plain.rms
    assert any("session 'b again': its marker is" in text for text in placed.placed)
    alone: Any = dc.evaluate(model, new.rows(slice(1, None, 5)))  # the second session, whose name the others keep
    assert (alone.count, alone.numbers) == (8, 0)
    assert alone.rms < 1.5 * plain.rms
    assert dc.evaluate(model, new.with_sessions(None)).rms > 2e-3
    with pytest.raises(InputError, match="mounted anew"):
        dc.evaluate(result.identification.geometry.points, new)


def test_the_marker_of_each_session_is_predicted(result: Any) -> None:
    """Its errors are those that are expected."""
    q = ARM.sample(200, seed=11)
    rows = dc.Measurements(q, ARM.true_points(q), ARM.nominal.joint_names)
    turns = ARM.truth.marker_poses(q)[:, 0, :3, :3]
    found = {one.device: one for one in result.model.predict_readings(q)}
    assert set(found) == {"b", "c"}
    for number, name in ((1, "b"), (2, "c")):
        own = found[name]
        assert own.unit == "mm"
        error = own.mean - 1e3 * (rows.points[:, 0] + turns @ SHIFTS[number])
        squares = (error[:, None] @ torch.linalg.solve(own.covariance, error[..., None])).flatten()
        assert float((squares < 7.81).double().mean()) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("said", [False, True])
def test_the_other_account_is_named_where_it_fits_far_better(said: bool) -> None:
    """Frames are taken for markers, and markers for frames."""
    rows = table(60, 1)
    names = remounted(ARM, rows).device_names
    if said:
        T = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
        T[[name == "b" for name in names], :3, :3] = rotation(torch.tensor([2e-3, 1e-3, -2e-3], dtype=torch.float64))
        data = rows.in_frames(T)
    else:
        data = remounted(ARM, rows).with_sessions(None)
    with pytest.warns(DiffeoCalibWarning) as caught:
        calibrated(data.with_sessions(names, remounted=said))
    assert sum("--remounted" in str(one.message) for one in caught) == 1
