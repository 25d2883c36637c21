"""Data frames of pandas and polars wherever joints are passed: columns by name, in any order, among others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pandas as pd
import polars as pl
import pytest
import torch
from math_bank import constant_kernel
from product_bank import Case
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError, RobotError

LIBRARIES = [pytest.param(pd.DataFrame, id="pandas"), pytest.param(pl.DataFrame, id="polars")]
Table = Callable[[dict[str, Any]], Any]


def shuffled(table: Table, robot: dc.Chain, q: Tensor) -> Any:
    """A data frame whose joints are in another order, among other columns."""
    columns = {name: q[:, k].numpy() for k, name in enumerate(robot.joint_names)}
    order = sorted(columns, reverse=True)
    assert order != list(columns)
    others: dict[str, Any] = {"measured": ["yes"] * len(q), "x [mm]": range(len(q))}
    return table(others | {name: columns[name] for name in order})


@pytest.mark.parametrize("table", LIBRARIES)
def test_columns_are_taken_by_name(table: Table, arm: Case, posed: Case) -> None:
    model, q = arm.model, arm.test.q[:4]
    frame = shuffled(table, arm.robot, q)
    calls: list[Callable[[Any], Any]] = [
        model,
        model.jacobian,
        model.tool_poses,
        model.tool_jacobian,
        posed.model.poses,
        arm.robot,
        arm.robot.jacobian,
        lambda q: model.inverse(model(arm.test.q[:4]), q),
        lambda q: dc.joints_outside_range(model, q),
        lambda q: dc.compensate(model, arm.robot(arm.test.q[:4]), q).q,
        lambda q: dc.rows_used_in_fit(model, q),
        lambda q: dc.Measurements(q, arm.test.points[:4], arm.robot.joint_names).q,
    ]
    pairs: list[Callable[[Any], Any]] = [model.predict, model.predict_tool_poses, posed.model.predict_poses]
    for call in calls:
        assert torch.equal(call(frame), call(q))
    for call in pairs:
        for found, expected in zip(call(frame), call(q), strict=True):
            assert torch.equal(found, expected)
    for k, name in enumerate(arm.robot.joint_names):
        assert torch.equal(model.transmission(name, frame), model.transmission(name, q[:, k]))
        assert torch.equal(model.transmission(name, frame[name]), model.transmission(name, q[:, k]))


@pytest.mark.parametrize("table", LIBRARIES)
def test_every_joint_needs_its_column(table: Table, arm: Case) -> None:
    q, names = arm.test.q[:4], arm.robot.joint_names
    frame = table({name: q[:, k].numpy() for k, name in enumerate(names[:-1])} | {"last": q[:, -1].numpy()})
    with pytest.raises(InputError, match=rf"has no column \['{names[-1]}'\]: expected columns .* got .*'last'"):
        arm.model(frame)
    with pytest.raises(MeasurementError, match="has no column"):
        dc.Measurements(frame, arm.test.points[:4], names)


@pytest.mark.parametrize("table", LIBRARIES)
def test_a_row_or_a_column_is_no_configuration(table: Table, arm: Case) -> None:
    frame = shuffled(table, arm.robot, arm.test.q[:4])
    with pytest.raises(InputError, match=r"`q`: expected a data frame or an array, got Series"):
        arm.model(frame[arm.robot.joint_names[0]])


@pytest.mark.parametrize("table", LIBRARIES)
def test_cells_must_be_numbers(table: Table, arm: Case) -> None:
    first, *others = arm.robot.joint_names
    with pytest.raises(InputError, match=f"column '{first}' of the data frame `q` cannot be read as numbers"):
        arm.model(table({first: ["far"], **{name: [0.0] for name in others}}))
    with pytest.raises(InputError, match=r"6 value\(s\) that are not finite, the first at index \[1, 0\]"):
        arm.model(table({name: [0.0, None] for name in arm.robot.joint_names}))


def test_two_columns_of_one_name(arm: Case) -> None:
    frame = pd.DataFrame([[0.0] * 7], columns=pd.Index([*arm.robot.joint_names, arm.robot.joint_names[0]]))
    with pytest.raises(InputError, match=f"has several columns named \\['{arm.robot.joint_names[0]}'\\]"):
        arm.model(frame)


@pytest.mark.parametrize("table", LIBRARIES)
def test_measurements_of_a_data_frame_know_the_names(table: Table, arm: Case) -> None:
    """All columns are joints if none are named; another order than the robot's is refused later, not guessed."""
    q, points, names = arm.test.q[:4], arm.test.points[:4], arm.robot.joint_names
    data = dc.Measurements(table({name: q[:, k].numpy() for k, name in enumerate(names)}), points)
    assert data.joint_names == names
    assert torch.equal(data.q, q)
    turned = dc.Measurements(
        table({name: q[:, k].numpy() for k, name in reversed(list(enumerate(names)))}), points, doubt=False
    )
    assert turned.joint_names == names[::-1]
    with pytest.raises(InputError, match="put the columns in the robot's order"):
        dc.evaluate(arm.model, turned)
    with pytest.raises(RobotError, match="put the columns in the robot's order"):
        dc.calibrate(arm.robot, turned)
    with pytest.raises(MeasurementError, match="column 'measured' of the data frame `q` cannot be read"):
        dc.Measurements(shuffled(table, arm.robot, q), points)


@pytest.mark.parametrize("table", LIBRARIES)
def test_maps_without_names_refuse_data_frames(table: Table, arm: Case) -> None:
    frame, kernel = table({"a": [0.0, 1.0]}), constant_kernel(1.0)
    with pytest.raises(InputError, match="`x` is a data frame, but the inputs of this map have no names"):
        dc.Problem(lambda x: x, frame, [[0.0], [1.0]], joint_kernel=kernel, task_kernel=kernel, noise=0.1)
    with pytest.raises(InputError, match="`x` is a data frame"):
        arm.model.map(shuffled(table, arm.robot, arm.test.q))
