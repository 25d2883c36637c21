"""Calibrate robot kinematics by diffeomorphisms: k1 = psi o k0 o phi^-1.

Start with :func:`load_urdf`, :func:`read_measurements`, :func:`calibrate` and :func:`evaluate`. :class:`Problem` and
:func:`fit` deform any other smooth map. Method: LDDMM geodesics in kernel spaces (R. Orozco, A. Ratajczak,
"Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025).

Every name is loaded when it is first used (PEP 562), so that ``import diffeo_calib`` loads neither torch nor SciPy.

The steps of long work are logged at level INFO below the logger "diffeo_calib": tables read, registration, geometry,
scales, fits, rows that look wrong. ``logging.basicConfig(level=logging.INFO)`` shows them.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from diffeo_calib.common.lazy import lazy_names

if TYPE_CHECKING:
    from diffeo_calib import interop as interop
    from diffeo_calib.calibration.calibrate import CalibrationResult, calibrate
    from diffeo_calib.calibration.planning.candidates import Tracker, candidates
    from diffeo_calib.calibration.planning.plan import Plan, plan
    from diffeo_calib.calibration.planning.sensors import Sensor
    from diffeo_calib.calibration.recalibration.compare import Comparison, compare
    from diffeo_calib.calibration.recalibration.recalibrate import Recalibration, recalibrate
    from diffeo_calib.campaign.campaign import Campaign
    from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning
    from diffeo_calib.fitting.fit import fit
    from diffeo_calib.fitting.gauss_newton import GaussNewton
    from diffeo_calib.fitting.lbfgs import LBFGS
    from diffeo_calib.fitting.problem import Problem
    from diffeo_calib.fitting.result import Fit
    from diffeo_calib.flows.integrators import RK4, RK8
    from diffeo_calib.flows.torchdiffeq import TorchDiffEq
    from diffeo_calib.interop.model_file import load, save
    from diffeo_calib.kernels.base import Kernel
    from diffeo_calib.kernels.radial import Cauchy, Gaussian, Matern, PerJoint, VonMises
    from diffeo_calib.kernels.spaces import Space
    from diffeo_calib.kinematics.calibrated import CalibratedKinematics
    from diffeo_calib.kinematics.compensation.compensate import Compensation, compensate
    from diffeo_calib.kinematics.evaluation import evaluate, rows_used_in_fit
    from diffeo_calib.kinematics.joint_ranges import joints_outside_range
    from diffeo_calib.measurements.csv.files import read_measurements, read_readings
    from diffeo_calib.measurements.observations import Observations
    from diffeo_calib.measurements.readings import Readings
    from diffeo_calib.measurements.table import Measurements
    from diffeo_calib.paper.gradient_descent import GradientDescent
    from diffeo_calib.process.scales import Hyperparameters
    from diffeo_calib.reports import plots as plots
    from diffeo_calib.reports.report import write_report
    from diffeo_calib.robots.cartesian import cartesian, pose_inputs
    from diffeo_calib.robots.dh import DHRow, from_dh
    from diffeo_calib.robots.tree import Chain, Tree
    from diffeo_calib.robots.urdf import load_urdf

__version__ = "0.1.0"

logging.getLogger(__name__).addHandler(logging.NullHandler())  # the program that imports this decides what is shown

__all__ = [
    "LBFGS",
    "RK4",
    "RK8",
    "CalibratedKinematics",
    "CalibrationResult",
    "Campaign",
    "Cauchy",
    "Chain",
    "Comparison",
    "Compensation",
    "DHRow",
    "DiffeoCalibError",
    "DiffeoCalibWarning",
    "Fit",
    "GaussNewton",
    "Gaussian",
    "GradientDescent",
    "Hyperparameters",
    "Kernel",
    "Matern",
    "Measurements",
    "Observations",
    "PerJoint",
    "Plan",
    "Problem",
    "Readings",
    "Recalibration",
    "Sensor",
    "Space",
    "TorchDiffEq",
    "Tracker",
    "Tree",
    "VonMises",
    "calibrate",
    "candidates",
    "cartesian",
    "compare",
    "compensate",
    "evaluate",
    "fit",
    "from_dh",
    "joints_outside_range",
    "load",
    "load_urdf",
    "plan",
    "pose_inputs",
    "read_measurements",
    "read_readings",
    "recalibrate",
    "rows_used_in_fit",
    "save",
    "write_report",
]

if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "calibration.calibrate": "CalibrationResult calibrate",
            "calibration.planning.candidates": "Tracker candidates",
            "calibration.planning.plan": "Plan plan",
            "calibration.planning.sensors": "Sensor",
            "calibration.recalibration.compare": "Comparison compare",
            "calibration.recalibration.recalibrate": "Recalibration recalibrate",
            "process.scales": "Hyperparameters",
            "campaign.campaign": "Campaign",
            "common.errors": "DiffeoCalibError DiffeoCalibWarning",
            "fitting.fit": "fit",
            "fitting.gauss_newton": "GaussNewton",
            "fitting.lbfgs": "LBFGS",
            "fitting.problem": "Problem",
            "fitting.result": "Fit",
            "flows.integrators": "RK4 RK8",
            "flows.torchdiffeq": "TorchDiffEq",
            "interop.model_file": "load save",
            "kernels.base": "Kernel",
            "kernels.radial": "Cauchy Gaussian Matern PerJoint VonMises",
            "kernels.spaces": "Space",
            "kinematics.calibrated": "CalibratedKinematics",
            "kinematics.compensation.compensate": "Compensation compensate",
            "kinematics.evaluation": "evaluate rows_used_in_fit",
            "kinematics.joint_ranges": "joints_outside_range",
            "measurements.csv.files": "read_measurements read_readings",
            "measurements.observations": "Observations",
            "measurements.readings": "Readings",
            "measurements.table": "Measurements",
            "paper.gradient_descent": "GradientDescent",
            "reports": "plots",
            "reports.report": "write_report",
            "robots.cartesian": "cartesian pose_inputs",
            "robots.dh": "DHRow from_dh",
            "robots.tree": "Chain Tree",
            "robots.urdf": "load_urdf",
        },
    )
