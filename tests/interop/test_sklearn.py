"""The estimator of scikit-learn: its own checks, and on a robot's table everything that those need other tables for."""

import pickle
from typing import Any

import numpy as np
import pandas as pd
import pytest
from product_bank import Case
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.utils.estimator_checks import check_estimator
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError

JOINTS = "fits a random table of other columns than the robot's six joints"
OTHER_TABLES = (
    *("check_fit_score_takes_y", "check_estimators_overwrite_params", "check_dont_overwrite_parameters"),
    *("check_estimators_fit_returns_self", "check_readonly_memmap_input", "check_n_features_in_after_fitting"),
    *("check_positive_only_tag_during_fit", "check_estimators_dtypes", "check_dtype_object"),
    *("check_pipeline_consistency", "check_estimators_nan_inf", "check_estimators_pickle"),
    *("check_f_contiguous_array_estimator", "check_regressors_train", "check_regressor_data_not_an_array"),
    *("check_regressor_multioutput", "check_regressors_no_decision_function", "check_regressors_int"),
    *("check_methods_sample_order_invariance", "check_methods_subset_invariance", "check_fit2d_1sample"),
    *("check_fit2d_1feature", "check_dict_unchanged", "check_fit_idempotent", "check_fit_check_is_fitted"),
    *("check_n_features_in", "check_fit2d_predict1d"),
)


@pytest.fixture(scope="module")
def table(arm: Case) -> tuple[np.ndarray, np.ndarray]:
    data = arm.train[:40]
    return data.q.numpy(), data.points.flatten(1).numpy()


@pytest.fixture(scope="module")
def fitted(arm: Case, table: tuple[np.ndarray, np.ndarray]) -> Any:
    return with_scales(arm).fit(*table)


def test_the_checks_of_scikit_learn(arm: Case) -> None:
    reasons = dict.fromkeys(OTHER_TABLES, JOINTS)
    estimator = dc.interop.DiffeoRegressor(arm.robot)
    found = check_estimator(estimator, expected_failed_checks=reasons, on_skip=None, on_fail=None)
    failed = [one["check_name"] for one in found if one["status"] == "failed"]
    assert failed == []
    assert {one["check_name"] for one in found if one["status"] == "xfail"} == set(reasons)
    assert sum(one["status"] == "passed" for one in found) >= 20


@pytest.mark.slow
def test_it_is_the_calibration(arm: Case, fitted: Any, table: tuple[np.ndarray, np.ndarray]) -> None:
    result = dc.calibrate(arm.robot, arm.train[:40], hyperparameters=arm.result.selection.scales)
    np.testing.assert_array_equal(fitted.predict(arm.test.q.numpy()), result.model(arm.test.q).flatten(1).numpy())
    mean, deviations = fitted.predict(arm.test.q.numpy(), return_std=True)
    _, covariance = result.model.predict(arm.test.q)
    np.testing.assert_array_equal(deviations, covariance.diagonal(dim1=-2, dim2=-1).sqrt().flatten(1).numpy())
    assert mean.shape == deviations.shape == (len(arm.test), 3)
    assert fitted.score(arm.test.q.numpy(), arm.test.points.flatten(1).numpy()) > 0.9999999
    assert fitted.n_features_in_ == 6
    again = clone(fitted).fit(*table)
    np.testing.assert_array_equal(again.predict(table[0]), fitted.predict(table[0]))


def test_rows_are_independent_and_inputs_are_kept(fitted: Any, table: tuple[np.ndarray, np.ndarray]) -> None:
    q = table[0]
    whole = fitted.predict(q)
    order = np.random.default_rng(0).permutation(len(q))
    np.testing.assert_allclose(fitted.predict(q[order]), whole[order], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.concatenate([fitted.predict(row[None]) for row in q]), whole, rtol=0, atol=1e-12)
    frozen = q.copy(order="F")
    frozen.setflags(write=False)
    np.testing.assert_allclose(fitted.predict(frozen), whole, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(frozen, q)
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.predict(q), whole)


def test_data_frames_by_name(arm: Case, fitted: Any, table: tuple[np.ndarray, np.ndarray]) -> None:
    names = list(arm.robot.joint_names)
    frame = pd.DataFrame(table[0], columns=names)[names[::-1]]
    named = with_scales(arm).fit(frame, pd.DataFrame(table[1]))
    np.testing.assert_allclose(named.predict(frame), fitted.predict(table[0]), rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="feature names"):
        named.predict(frame[names])
    with pytest.raises(MeasurementError, match="waist_joint"):
        dc.interop.DiffeoRegressor(arm.robot).fit(frame.rename(columns={"waist_joint": "a1"}), table[1])


def with_scales(arm: Case) -> dc.interop.DiffeoRegressor:
    return dc.interop.DiffeoRegressor(arm.robot, hyperparameters=arm.result.selection.scales)


def test_bad_arguments(arm: Case, table: tuple[np.ndarray, np.ndarray]) -> None:
    q, y = table
    make = dc.interop.DiffeoRegressor
    with pytest.raises(NotFittedError):
        make(arm.robot).predict(q)
    refused(
        ("robot", lambda: make().fit(q, y)),
        ("6 joints", lambda: make(arm.robot).fit(q[:, :4], y)),
        (r"3 P", lambda: make(arm.robot).fit(q, y[:, :2])),
        ("devices whose places are found from all rows", lambda: make(arm.robot).fit(q, y[:, 0])),
    )
    bad = q.copy()
    bad[3, 2] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        make(arm.robot).fit(bad, y)
