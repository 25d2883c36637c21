"""A calibration as an estimator of scikit-learn, which is needed for this module alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

try:
    from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError as error:  # scikit-learn, or one that is too old
    what = "DiffeoRegressor needs scikit-learn 1.6 or newer: pip install 'diffeo_calib[notebooks]'"
    raise ImportError(what) from error

from diffeo_calib.calibration.calibrate import Controls, calibrate
from diffeo_calib.calibration.result import CalibrationResult
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.poses import POINTS
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.robots.tree import Tree


class DiffeoRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Marker positions from joint values, for pipelines, cross-validation and comparisons with other regressors.

    X is (N, n), rad or m, columns in the robot's order; a data frame has columns named after the joints, in any order,
    but in the same one whenever the estimator is used. y is (N, 3 P) in m: x, y, z of every marker, NaN where hidden.
    ``score`` is R^2, as of every regressor of scikit-learn; in m use ``scoring="neg_root_mean_squared_error"``.

    Args:
        robot: nominal chain of n joints. on: names of the tips that carry the markers, for a robot with several.
        lever: of measured poses, m: y then holds three points for each, as of
            :func:`diffeo_calib.measurements.poses.mark_points`; None for markers.
        hyperparameters, controls, seed: see :func:`diffeo_calib.calibrate`.

    Attributes:
        result_: the :class:`CalibrationResult` of the fit. model_: its calibrated kinematics.
        n_features_in_: n. feature_names_in_: names of the columns if X was a data frame.
    """

    result_: CalibrationResult
    model_: CalibratedKinematics

    def __init__(
        self,
        robot: Tree | None = None,
        *,
        on: Sequence[str] | None = None,
        lever: float | None = None,
        hyperparameters: Hyperparameters | None = None,
        controls: Controls = "auto",
        seed: int = 0,
    ) -> None:
        self.robot, self.on, self.lever = robot, on, lever
        self.hyperparameters, self.controls, self.seed = hyperparameters, controls, seed

    def fit(self, X: Any, y: Any) -> DiffeoRegressor:
        """Calibrate the robot.

        Args:
            X: (N, n) joint values, rad or m. y: (N, 3 P) marker positions, m; or the rows themselves, a table of any
                kind of measurement with these joint values.

        Raises InputError: no robot, or tables that do not fit it. MeasurementError: see :func:`diffeo_calib.calibrate`.
        """
        robot = self.robot
        if not isinstance(robot, Tree):
            fix = "pass robot=dc.load_urdf(...) to the constructor"
            raise InputError.of("`robot`", expected="a dc.Tree", got=type(robot).__name__, fix=fix)
        data: Any = y if isinstance(y, RowGroups) else self._measured(robot, X, y)
        if data is y and not np.array_equal(self._joints(robot, validate_data(self, X, dtype=np.float64)), y.q.numpy()):
            raise MeasurementError.of("`X`", expected="the joint values of the rows in `y`", fix="pass y.q")
        how = {"hyperparameters": self.hyperparameters, "controls": self.controls, "seed": self.seed}
        self.result_ = calibrate(robot, data, **how)
        self.model_ = self.result_.model
        return self

    def _measured(self, robot: Tree, X: Any, y: Any) -> Measurements:
        """The rows as measurements."""
        hidden = {"ensure_2d": False, "ensure_all_finite": "allow-nan", "dtype": np.float64}
        each_as: Any = {"dtype": np.float64}, hidden
        checked: Any = validate_data(self, X, y, validate_separately=each_as)
        points, each = checked[1].reshape(len(checked[1]), -1), 1 if self.lever is None else POINTS
        if points.shape[1] % (3 * each):
            fix = "pass x, y and z of every marker, in m, or of three points for every pose; distances, heights and "
            fix += "images belong to devices whose places are found from all rows: dc.calibrate"
            raise MeasurementError.of("`y`", expected=f"{3 * each} P columns", got=points.shape[1], fix=fix)
        tips = None if self.on is None else [tip for tip in self.on for _ in range(each)]
        q, places = (torch.from_numpy(part.copy()) for part in (self._joints(robot, checked[0]), points))
        rows = Measurements.of_points(q, places.unflatten(1, (-1, 3)), tips, self.lever)
        return rows.with_joint_names(robot.joint_names).doubted(True)

    def score(self, X: Any, y: Any, sample_weight: Any = None) -> float:
        """R^2 of marker positions y (M, 3 P), m; InputError for rows of other kinds, which have no common unit."""
        if isinstance(y, RowGroups):
            raise InputError.of("`score` of a table of rows", fix="use diffeo_calib.evaluate(regressor.model_, rows)")
        return super().score(X, y, sample_weight)

    def predict(self, X: Any, return_std: bool = False) -> Any:
        """Marker positions, and the standard deviations that a new measurement would have.

        Args:
            X: (M, n) joint values, rad or m. return_std: whether to return the deviations as well.

        Returns (M, 3 P) m; with ``return_std`` also their standard deviations, (M, 3 P) m.
        """
        check_is_fitted(self, "model_")
        q = self._joints(self.model_.robot, validate_data(self, X, reset=False, dtype=np.float64))
        if not return_std:
            return self.model_(q).flatten(1).numpy()
        mean, covariance = self.model_.predict(q)
        return mean.flatten(1).numpy(), covariance.diagonal(dim1=-2, dim2=-1).sqrt().flatten(1).numpy()

    def __sklearn_tags__(self) -> Any:
        """A regressor of several outputs at once, whose input must be joint values of its robot."""
        tags = super().__sklearn_tags__()
        tags.target_tags.single_output = False
        tags.regressor_tags.poor_score = True  # on tables that are no robot's
        return tags

    def _joints(self, robot: Tree, q: Any) -> np.ndarray:
        """Columns in the robot's order, where they have names; MeasurementError unless they are its joints."""
        names, wanted = getattr(self, "feature_names_in_", None), robot.joint_names
        if names is not None and sorted(names) != sorted(wanted):
            raise MeasurementError.of("columns of `X`", expected=", ".join(wanted), got=", ".join(names))
        if q.shape[1] != len(wanted):
            raise MeasurementError.of("`X`", expected=f"{len(wanted)} joints", got=f"{q.shape[1]} columns")
        return q if names is None else q[:, [list(names).index(name) for name in wanted]]
