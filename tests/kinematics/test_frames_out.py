"""Results as data frames of pandas."""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd
import pytest
import torch
from product_bank import Case
from scipy.spatial.transform import Rotation

import diffeo_calib as dc


@pytest.mark.parametrize("name", ["arm", "pair"])
def test_errors_of_every_row(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    data = case.test[5:25]
    found = dc.evaluate(case.model, data)
    frame = found.to_frame()
    away = (data.points - case.model(data.q)).numpy()
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


def test_predictions_keep_the_index(arm: Case) -> None:
    frame = pd.DataFrame(arm.test.q[:3].numpy(), columns=list(arm.robot.joint_names), index=["a", "b", "c"])
    found = arm.model.to_frame(frame)
    mean, covariance = arm.model.predict(arm.test.q[:3])
    assert list(found.index) == ["a", "b", "c"]
    np.testing.assert_allclose(found[["x", "y", "z"]], mean[:, 0])
    np.testing.assert_allclose(found[["std_x", "std_y", "std_z"]] ** 2, covariance[:, 0].diagonal(dim1=1, dim2=2))


def test_plans(arm: Case) -> None:
    frame = dc.plan(arm.model, arm.test.q[:30], 4).to_frame()
    assert list(frame.columns) == [*arm.robot.joint_names, "rank"]
    assert sorted(frame["rank"]) == [1, 2, 3, 4]


def test_without_pandas_there_is_one_sentence(arm: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    for call in (arm.test.to_frame, dc.evaluate(arm.model, arm.test).to_frame, lambda: arm.model.to_frame(arm.test.q)):
        with pytest.raises(ImportError, match=r"data frames need pandas: pip install .diffeo_calib\[notebooks\]"):
            call()
