"""Registration with rows of devices that measure no positions, and what the devices of a model will read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import again_bank
import numpy as np
import pytest
import torch
from again_bank import positions
from kind_bank import Kind, kind_named, marked
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.recalibration.register import weighed
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.kinematics.device_readings import PredictedReadings
from diffeo_calib.measurements.rows import with_attributes


@pytest.fixture(scope="module")
def kind() -> Kind:
    return kind_named("distances")


def of_device(rows: Any, name: str) -> Any:
    return rows.rows([number for number, own in enumerate(rows.device_names) if own == name])


def placement(model: dc.CalibratedKinematics) -> dict[str, torch.Tensor]:
    return {name: place for own in model.placement for name, place in zip(own.names, own.constants, strict=True)}


def test_devices_without_new_rows_stay(kind: Kind) -> None:
    name = kind.new.device_names[0]
    before, rows = placement(kind.model), of_device(kind.new, name)
    after = placement(kind.model.registered(rows))
    assert after.keys() == before.keys()
    for other in set(before) - {name}:
        assert_close(after[other], before[other], rtol=0, atol=0)
    assert 0.0 < float((after[name] - before[name]).norm()) < 2e-3


def test_only_unknown_devices_are_placed(kind: Kind) -> None:
    """Rows of two devices under each other's names are wrong, also beside a third one that the model does not know."""
    first, second, third = dict.fromkeys(kind.new.device_names)
    new = with_attributes(kind.new, names=tuple({third: "new"}.get(name, name) for name in kind.new.names))
    found = dc.evaluate(kind.model, new)
    assert found.numbers == 3
    known = dc.evaluate(kind.model, kind.new)
    assert found.rms < 1.2 * known.rms
    exchanged = {first: second, second: first, third: "new"}
    wrong = with_attributes(kind.new, names=tuple(exchanged[name] for name in kind.new.names))
    assert dc.evaluate(kind.model, wrong).rms > 0.1


def test_another_ball_is_no_registration(kind: Kind) -> None:
    q = kind.new.q.roll(1, 0)
    with pytest.raises(MeasurementError, match="recalibrate, which finds another ball"):
        kind.model.registered(with_attributes(kind.new, q=q))


@pytest.mark.parametrize("learn", [True, False])
def test_sockets_follow_every_registration(*, learn: bool) -> None:
    """Of rows that are shifted twice they are where the second ones are; the ball stays on the tool."""
    kind, found = kind_named("mixture"), kind_named("mixture").model
    rows, shift = kind.new.parts[0], torch.tensor([0.3, 0.0, 0.1], dtype=torch.float64)
    for times in (1, 2):
        found = found.registered(with_attributes(rows, points=rows.points + times * shift), learn=learn)
        record: Any = found.registration
        assert record.same
        assert_close(record.markers[-1], kind.model.geometry.tool[-1], rtol=0, atol=1e-4 if learn else 1e-12)
        assert float(record.marker_deviations[-1].max()) == 0.0
    before, after = (placement(model) for model in (kind.model, found))
    sockets = [name for own in kind.model.placement if own.kind == "socket" for name in own.names]
    assert sockets
    rows, size = weighed(kind.placed_again, "same"), kind.model.map.noise.covariance.diagonal(dim1=1, dim2=2)
    noise = rows.noise.diagonal(dim1=1, dim2=2)[rows.visible].median()  # which the fit knows
    assert float(noise / size[kind.model.map.noise.visible].median()) > 0.5
    for name in sockets:
        assert_close(after[name][:3], before[name][:3] + 2 * shift, rtol=0, atol=2e-3)


@pytest.mark.parametrize("name", marked("images of a board", "hidden markers"))
def test_rows_teach_a_registered_model_what_they_teach_a_recalibrated_one(name: str) -> None:
    """Of a robot that has not changed both are conditioned on old and new rows."""
    kind = kind_named(name)
    q, again = kind.q(40), dc.recalibrate(kind.model, kind.moved, drift="none").model
    (mean, covariance), (other, expected) = (one.predict(q, noise=False) for one in (kind.registered, again))
    usual = float(expected.diagonal(dim1=-2, dim2=-1).mean().sqrt())
    assert float((mean - other).square().mean().sqrt()) < usual
    assert float(covariance.diagonal(dim1=-2, dim2=-1).mean().sqrt()) == pytest.approx(usual, rel=0.5)


def test_a_registered_robot_carries_its_payload() -> None:
    kind = kind_named("payloads")
    assert kind.model.with_payload(3.0).registered(kind.moved).payload == 3.0


# --- markers of new rows in another order than in the fit -----------------------------------------------------------


@pytest.mark.parametrize(
    ("verb", "order", "named"),
    [
        (dc.CalibratedKinematics.registered, [1, 0, 2], "0, 1"),
        (dc.CalibratedKinematics.registered, [1, 2, 0], "0, 1, 2"),
        (dc.recalibrate, [1, 0, 2], "0, 1"),
        (dc.compare, [1, 0, 2], "0, 1"),
    ],
)
def test_exchanged_markers_are_named(verb: Callable[[Any, Any], Any], order: list[int], named: str) -> None:
    model, new = again_bank.model(3), positions(again_bank.arm(3), 24, 7)
    with pytest.warns(DiffeoCalibWarning, match=f"markers {named}, or.* seem to be exchanged"):
        verb(model, with_attributes(new, points=new.points[:, order]))


def test_markers_that_moved_are_not_exchanged() -> None:
    arm, model = again_bank.arm(3), again_bank.model(3)
    new = positions(arm, 24, 7)
    turns = again_bank.ELSEWHERE[:3, :3] @ arm.truth.marker_poses(new.q)[..., :3, :3]
    shifts = torch.tensor([[2e-3, 1e-3, 0.0], [-1e-3, 3e-3, 2e-3], [3e-2, -4e-2, 1e-2]], dtype=torch.float64)
    moved = with_attributes(new, points=new.points + (turns @ shifts[None, ..., None])[..., 0])
    assert model.registered(moved).registration.exchanged == ()
    assert model.registered(new).registration.exchanged == ()


KINDS = ("distances", "heights", "images", "several kinds")


def readings(kind: Kind) -> list[Any]:
    return [part for part in kind.new.parts if isinstance(part, dc.Readings)]


def of_rows(model: dc.CalibratedKinematics, part: Any, **options: bool) -> list[PredictedReadings]:
    """The prediction of the device of every row."""
    found = {(own.kind, own.device): own for own in model.predict_readings(part.q, **options)}
    return [found[part.kind, name] for name in part.device_names]


def squares(kind: Kind, model: dc.CalibratedKinematics) -> list[float]:
    """Squared errors of new readings in units of what is expected, relative to the border of the 95 % region."""
    found = []
    for part in readings(kind):
        unit, scale, zero = part.shown
        seen = part.values * part.values.new_tensor(scale) + part.values.new_tensor(zero)
        for row, own in enumerate(of_rows(model, part)):
            assert own.unit == unit
            away = seen[row] - own.mean[row]
            found.append(float(away @ torch.linalg.solve(own.covariance[row], away)) / chi2_above(0.05, len(away)))
    return found


@pytest.mark.parametrize("name", marked(*KINDS))
def test_regions_hold_new_readings(name: str) -> None:
    """Of 24 new rows of each kind: all but a few, and the squares have the size of a chi-squared number's."""
    found = squares(kind_named(name), kind_named(name).model)
    assert sum(each < 1.0 for each in found) >= 0.85 * len(found)
    assert 0.1 < float(np.mean(found)) < 0.6  # 0.26 of one number, 0.33 of two


@pytest.mark.parametrize("name", marked("heights", "images"))
def test_devices_placed_on_new_rows(name: str) -> None:
    """Their errors are added to the model's: regions hold the rows, and are no smaller than those of the fit."""
    kind = kind_named(name)
    found = squares(kind, kind.model.registered(kind.new))
    assert sum(each < 1.0 for each in found) >= 0.9 * len(found)


def test_the_place_of_the_whole_scene_moves_no_reading() -> None:
    """Devices are known to half a millimetre, their readings to a tenth."""
    kind = kind_named("distances")
    part = readings(kind)[0]
    bare = [float(own.deviations[row, 0]) for row, own in enumerate(of_rows(kind.model, part, noise=False))]
    whole = [float(own.deviations[row, 0]) for row, own in enumerate(of_rows(kind.model, part))]
    assert max(bare) < 0.3
    short = replace(kind.model.map, unresolved=1e-8 * part.q.new_ones(part.q.shape[1]))
    wide = of_rows(kind.model.changed(map=short), part, noise=False)  # to errors that the fields do not resolve
    assert all(float(own.deviations[row, 0]) > bare[row] for row, own in enumerate(wide))
    assert all(0.0 < one < other for one, other in zip(bare, whole, strict=True))
    (placed,) = kind.model.placement
    assert float(1e3 * placed.deviations[:, :3].median()) > 2 * float(np.median(bare))
    old = kind.model.changed(placement=(replace(placed, shown=None),))  # of a file that does not say the unit: metres
    for one, own in zip(of_rows(old, part), of_rows(kind.model, part), strict=True):
        assert_close(1e3 * one.mean, own.mean)


def test_means_are_the_observations_of_the_model(tmp_path: Any) -> None:
    kind = kind_named("images")
    dc.save(kind.model, tmp_path / "m.safetensors")
    model: Any = dc.load(tmp_path / "m.safetensors")
    (placed,) = model.placement
    q = kind.q(3)
    for number, own in enumerate(model.predict_readings(q)):
        camera = placed.poses[number]
        seen = model(q).detach()[:, -1] @ camera[:3, :3].mT + camera[:3, 3]
        fx, fy, cx, cy = readings(kind)[0].intrinsics
        expected = seen[:, :2] / seen[:, 2:] * torch.tensor([fx, fy]) + torch.tensor([cx, cy])
        assert_close(own.mean, expected, rtol=0, atol=1e-6)
        assert own.unit == "px"
    assert kind_named("positions").model.predict_readings(kind_named("positions").q(2)) == []
