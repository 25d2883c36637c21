"""The poses of calibrated kinematics: their fit to three points, covariances and inverse."""

from __future__ import annotations

import pytest
import torch
from product_bank import Case
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.poses import angle_between, mark_jacobian, mark_points


def test_poses_fit_the_points_of_the_model(posed: Case) -> None:
    model, q = posed.model, posed.test.q
    assert (model.lever, model.markers) == (0.1, 3)
    assert "poses, fitted to 30 poses" in repr(model)
    poses, points = model.poses(q), model(q)
    assert_close(poses[:, :3, 3], points.mean(1), rtol=0, atol=1e-14)
    eye = torch.eye(3, dtype=torch.float64).expand(len(q), 3, 3)
    assert_close(poses[:, :3, :3].mT @ poses[:, :3, :3], eye, rtol=0, atol=1e-14)
    change = (mark_points(poses, 0.1) - points).norm(dim=-1)
    assert float(change.max()) < 1e-3  # the deformation changes the triangle of points only slightly
    measured = posed.test.poses
    assert measured is not None
    assert float(angle_between(poses[:, :3, :3], measured[:, :3, :3]).max()) < 5e-3
    assert_close(model.predict_poses(q)[0], poses, rtol=0, atol=1e-12)


def test_covariance_of_poses_is_that_of_their_points(posed: Case) -> None:
    """Position: the mean of the points. Rotation vectors: in the measuring frame."""
    model, q = posed.model, posed.test.q[:40]
    whole = model.map.predict(q)[1]
    poses, covariance = model.predict_poses(q)
    mean = torch.cat([torch.eye(3, dtype=torch.float64)] * 3, 1) / 3
    assert_close(covariance[:, :3, :3], mean @ whole @ mean.T, rtol=1e-9, atol=1e-20)
    back = torch.linalg.inv(mark_jacobian(poses, 0.1).mT @ mark_jacobian(poses, 0.1)) @ mark_jacobian(poses, 0.1).mT
    assert_close(covariance, back @ whole @ back.mT, rtol=1e-6, atol=1e-16)
    without = model.predict_poses(q, noise=False)[1]
    assert bool((without.diagonal(dim1=1, dim2=2) < covariance.diagonal(dim1=1, dim2=2)).all())


def test_inverse_reaches_poses(posed: Case) -> None:
    q = posed.test.q[:10]
    targets = mark_points(posed.model.poses(q), 0.1)
    found = posed.model.inverse(targets, start=q + 0.01)
    assert_close(posed.model.poses(found), posed.model.poses(q), rtol=0, atol=2e-4)


def test_predicted_deviations_of_poses_are_of_the_right_size(posed: Case) -> None:
    poses, covariance = posed.model.predict_poses(posed.test.q)
    measured = posed.test.poses
    assert measured is not None
    error = poses[:, :3, 3] - measured[:, :3, 3]
    ratio = error.square().mean() / covariance.diagonal(dim1=1, dim2=2)[:, :3].mean()
    assert 0.2 < float(ratio) < 5.0


def test_points_have_no_poses(arm: Case) -> None:
    for ask in (arm.model.poses, arm.model.predict_poses):
        with pytest.raises(InputError, match=r"calibrated with points: it has no poses; .*from_poses"):
            ask(arm.test.q)


def test_wrong_configurations_of_poses(posed: Case) -> None:
    for ask in (posed.model.poses, posed.model.predict_poses):
        with pytest.raises(InputError, match=r"`q` must have shape"):
            ask(posed.test.q[:, :5])


def test_a_lever_belongs_to_three_points(arm: Case, posed: Case) -> None:
    with pytest.raises(InputError, match=r"a model of poses: expected three points for each, got 1"):
        dc.CalibratedKinematics(arm.robot, arm.model.map, lever=0.1)
    with pytest.raises(InputError, match=r"`lever`.*above 0, got -0.1"):
        dc.CalibratedKinematics(posed.robot, posed.model.map, lever=-0.1)
    assert dc.CalibratedKinematics(arm.robot, arm.model.map).lever is None
