"""Joint values in the other unit of angles are refused by every verb that compares rows with a model."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from kind_bank import Kind, kind_named, marked

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.kinematics.joint_ranges import joints_outside_range, refuse_other_angles
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.sockets import Sockets

VERBS: dict[str, Callable[[Any, Any], Any]] = {
    "evaluate": dc.evaluate,
    "registered": lambda model, rows: model.registered(rows),
    "recalibrate": dc.recalibrate,
    "compare": dc.compare,
}


def in_other_unit(rows: Any, factor: float) -> Any:
    if isinstance(rows, dc.Observations):
        return dc.Observations([in_other_unit(part, factor) for part in rows.parts], rows.index)
    return with_attributes(rows, q=factor * rows.q)


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize(("factor", "unit"), [(math.pi / 180, "radians"), (180 / math.pi, "degrees")])
@pytest.mark.parametrize("name", marked("ball in sockets", "positions", "heights", "several kinds"))
def test_rows_in_another_unit_of_angles_are_named(name: str, factor: float, unit: str, verb: str) -> None:
    """Refused; small values of some joints lie in the ranges of the fit, too, and are warned of."""
    kind = kind_named(name)
    words = f"the joint values seem to be {unit}.*check the angle unit"
    with pytest.raises((MeasurementError, dc.DiffeoCalibWarning), match=words):
        VERBS[verb](kind.model, in_other_unit(kind.new, factor))


def test_rows_of_another_region_are_not_taken_for_degrees() -> None:
    """All of them are outside the joint ranges of the fit, and within these if divided by 57."""
    kind = kind_named("positions")
    q = kind.new.q.clone()
    low, high = kind.model.configurations[:, 1].amin(), kind.model.configurations[:, 1].amax()
    q[:, 1] = 0.5 * (low + high) + math.pi  # on the other side of the axis, whatever turns it has made
    assert bool(joints_outside_range(kind.model, q).any(1).all())
    refuse_other_angles(kind.model, q)


def without_distances(kind: Kind) -> Any:
    data = kind.data
    return with_attributes(data, sockets=Sockets(data.sockets.names))


MISTAKES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "seem to be radians that were converted": lambda q: q * math.pi / 180,
    "seem to be degrees": lambda q: q * 180 / math.pi,
    "with joints=.waist_joint,elbow_joint,shoulder_joint,forearm_roll_joint,": lambda q: q[:, [0, 2, 1, 3, 4, 5]],
}


@pytest.mark.parametrize("words", MISTAKES)
@pytest.mark.filterwarnings("ignore:no distance between sockets", "ignore:shoulder_joint. hardly moved")
def test_rows_in_sockets_with_wrong_joint_values_are_refused(words: str) -> None:
    kind = kind_named("ball in sockets")
    data = without_distances(kind)
    with pytest.raises(MeasurementError, match=words):
        dc.calibrate(kind.robot, with_attributes(data, q=MISTAKES[words](data.q)), hyperparameters=kind.scales)
