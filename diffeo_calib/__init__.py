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
    from diffeo_calib.calibration.calibrate import CalibrationResult as CalibrationResult
    from diffeo_calib.calibration.calibrate import calibrate as calibrate
    from diffeo_calib.calibration.diagnostics.judged_rows import evaluate as evaluate
    from diffeo_calib.calibration.planning.candidates import Tracker as Tracker
    from diffeo_calib.calibration.planning.candidates import candidates as candidates
    from diffeo_calib.calibration.planning.plan import Plan as Plan
    from diffeo_calib.calibration.planning.plan import plan as plan
    from diffeo_calib.calibration.planning.sensors import Sensor as Sensor
    from diffeo_calib.calibration.recalibration.recalibrate import Comparison as Comparison
    from diffeo_calib.calibration.recalibration.recalibrate import Recalibration as Recalibration
    from diffeo_calib.calibration.recalibration.recalibrate import compare as compare
    from diffeo_calib.calibration.recalibration.recalibrate import recalibrate as recalibrate
    from diffeo_calib.campaign.campaign import Campaign as Campaign
    from diffeo_calib.common.errors import DiffeoCalibError as DiffeoCalibError
    from diffeo_calib.common.errors import DiffeoCalibWarning as DiffeoCalibWarning
    from diffeo_calib.fitting.fit import fit as fit
    from diffeo_calib.fitting.gauss_newton import GaussNewton as GaussNewton
    from diffeo_calib.fitting.lbfgs import LBFGS as LBFGS
    from diffeo_calib.fitting.problem import Problem as Problem
    from diffeo_calib.fitting.result import Fit as Fit
    from diffeo_calib.fitting.scales import choose_scales as choose_scales
    from diffeo_calib.flows.integrators import RK4 as RK4
    from diffeo_calib.flows.integrators import RK8 as RK8
    from diffeo_calib.flows.torchdiffeq import TorchDiffEq as TorchDiffEq
    from diffeo_calib.interop.model_file import load as load
    from diffeo_calib.interop.model_file import save as save
    from diffeo_calib.kernels.base import Kernel as Kernel
    from diffeo_calib.kernels.radial import Cauchy as Cauchy
    from diffeo_calib.kernels.radial import Gaussian as Gaussian
    from diffeo_calib.kernels.radial import Matern as Matern
    from diffeo_calib.kernels.radial import PerJoint as PerJoint
    from diffeo_calib.kernels.radial import VonMises as VonMises
    from diffeo_calib.kernels.spaces import Space as Space
    from diffeo_calib.kinematics.calibrated import CalibratedKinematics as CalibratedKinematics
    from diffeo_calib.kinematics.compensation.compensate import Compensation as Compensation
    from diffeo_calib.kinematics.compensation.compensate import compensate as compensate
    from diffeo_calib.kinematics.evaluation import joints_outside_range as joints_outside_range
    from diffeo_calib.kinematics.evaluation import rows_used_in_fit as rows_used_in_fit
    from diffeo_calib.measurements.csv.files import read_measurements as read_measurements
    from diffeo_calib.measurements.csv.sensors import ReadingColumns as ReadingColumns
    from diffeo_calib.measurements.observations import Observations as Observations
    from diffeo_calib.measurements.readings import Readings as Readings
    from diffeo_calib.measurements.table import Measurements as Measurements
    from diffeo_calib.paper.gradient_descent import GradientDescent as GradientDescent
    from diffeo_calib.process.scales import Hyperparameters as Hyperparameters
    from diffeo_calib.reports import plots as plots
    from diffeo_calib.reports.report import write_report as write_report
    from diffeo_calib.robots.cartesian import cartesian as cartesian
    from diffeo_calib.robots.cartesian import pose_inputs as pose_inputs
    from diffeo_calib.robots.dh import DHRow as DHRow
    from diffeo_calib.robots.dh import from_dh as from_dh
    from diffeo_calib.robots.tree import Chain as Chain
    from diffeo_calib.robots.tree import Tree as Tree
    from diffeo_calib.robots.urdf import load_urdf as load_urdf

__version__ = "0.1.0"

logging.getLogger(__name__).addHandler(logging.NullHandler())  # the program that imports this decides what is shown

if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names
    __getattr__, __dir__, __all__ = lazy_names(__name__)
