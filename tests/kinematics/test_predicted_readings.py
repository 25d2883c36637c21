"""What devices will read: means as their readings, regions that hold new ones, units, and the command's columns."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from kind_bank import Kind, kind_named, marked
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.kinematics.device_readings import PredictedReadings

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
