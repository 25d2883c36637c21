"""Data frames of pandas and polars wherever joints are passed: columns by name, in any order, among others."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pytest
import torch
from math_bank import constant_kernel
from product_bank import Case
from scipy.spatial.transform import Rotation
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc

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
def test_data_frames_that_cannot_be_taken(table: Table, arm: Case) -> None:
    names, model = arm.robot.joint_names, arm.model
    columns = {name: arm.test.q[:4, k].numpy() for k, name in enumerate(names)}
    missing = table({name: columns[name] for name in names[:-1]} | {"last": columns[names[-1]]})
    words, gaps = table(columns | {names[0]: ["far"] * 4}), table({name: [0.0, None] for name in names})
    twice: Any = pd.DataFrame([[0.0] * 7], columns=pd.Index([*names, names[0]]))
    kernel: Any = {"joint_kernel": constant_kernel(1.0), "task_kernel": constant_kernel(1.0), "noise": 0.1}
    plain = "`x` is a data frame, but the inputs of this map have no names"
    refused(
        (rf"has no column \['{names[-1]}'\]: expected columns .* got .*'last'", lambda: model(missing)),
        ("has no column", lambda: dc.Measurements(missing, arm.test.points[:4], names)),
        ("`q`: expected a data frame or an array, got Series", lambda: model(table(columns)[names[0]])),
        (f"column '{names[0]}' of the data frame `q` cannot be read as numbers", lambda: model(words)),
        (r"6 value\(s\) that are not finite, the first at index \[1, 0\]", lambda: model(gaps)),
        (plain, lambda: dc.Problem(lambda x: x, table({"a": [0.0, 1.0]}), [[0.0], [1.0]], **kernel)),
        (f"has several columns named \\['{names[0]}'\\]", lambda: model(twice)),
    )


def test_errors_of_every_row(pair: Case) -> None:
    data = pair.test[5:25]
    found = dc.evaluate(pair.model, data)
    frame = found.to_frame()
    away = (data.points - pair.model(data.q)).numpy()
    assert list(frame.columns) == ["row", "marker", "x", "y", "z", "error"]
    assert list(frame["row"]) == [row for row in range(5, 25) for _ in range(data.markers)]
    assert frame.groupby("marker").size().tolist() == [20] * data.markers
    np.testing.assert_allclose(frame[["x", "y", "z"]], away.reshape(-1, 3), atol=1e-15)
    np.testing.assert_allclose(frame["error"], np.linalg.norm(frame[["x", "y", "z"]], axis=1), rtol=1e-12)
    assert np.sqrt((frame["error"] ** 2).mean()) == pytest.approx(found.rms)
    some = found.rows(torch.tensor([3, 1])).to_frame()
    assert list(some["row"]) == [row for row in (8, 6) for _ in range(data.markers)]


def test_poses_have_angles_and_rotation_vectors(posed: Case) -> None:
    data = posed.test[:6]
    frame = dc.evaluate(posed.model, data).to_frame()
    assert list(frame.columns)[-2:] == ["error", "angle"]
    turns = Rotation.from_matrix(posed.model.poses(data.q)[:, :3, :3].detach().numpy())
    measured = Rotation.from_matrix(data.poses[:, :3, :3].numpy())  # pyright: ignore[reportOptionalSubscript]
    np.testing.assert_allclose(frame["angle"], (turns.inv() * measured).magnitude(), atol=1e-9)
    table, predicted = data.to_frame(), posed.model.to_frame(data.q)
    for found, expected in ((table, measured), (predicted, turns)):
        again = Rotation.from_rotvec(found[["rx", "ry", "rz"]].to_numpy(copy=True))
        np.testing.assert_allclose(again.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-9)
    _, covariance = posed.model.predict_poses(data.q)
    std = predicted[[f"std_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")]]
    np.testing.assert_allclose(std**2, covariance.diagonal(dim1=1, dim2=2), rtol=1e-9)


def test_measurements_come_back(pair: Case) -> None:
    data = pair.train[[4, 2, 9]].with_joint_names(pair.robot.joint_names)
    frame = data.to_frame()
    assert list(frame.index) == [4, 2, 9]
    assert list(frame.columns)[6:] == [f"marker{k}_{axis}" for k in (1, 2) for axis in "xyz"]
    again = dc.Measurements(frame, frame.iloc[:, 6:].to_numpy().reshape(3, 2, 3), pair.robot.joint_names)
    assert torch.equal(again.q, data.q)
    assert torch.equal(again.points, data.points)
    known = dc.Measurements(data.q, data.points, std=1e-5).to_frame()
    assert (known[[f"std_marker{k}_{axis}" for k in (1, 2) for axis in "xyz"]] == 1e-5).all(axis=None)
