"""Calibrate robot kinematics by diffeomorphisms: k1 = psi o k0 o phi^-1.

Start with :func:`load_urdf`, :func:`read_measurements`, :func:`calibrate` and :func:`evaluate`; below
them, :class:`Problem` and :func:`fit` deform any smooth map. Method: LDDMM geodesics in kernel spaces
(R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel
approach", 2025).
"""

from diffeo_calib.calibration.calibrate import CalibrationResult, calibrate
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.gradient_descent import GradientDescent
from diffeo_calib.fitting.lbfgs import LBFGS
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import Fit
from diffeo_calib.flows.integrators import RK4, RK8
from diffeo_calib.flows.torchdiffeq import TorchDiffEq
from diffeo_calib.interop.model_file import load, save
from diffeo_calib.kernels.named import Cauchy, Gaussian, Matern, PerJoint, VonMises
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import evaluate
from diffeo_calib.measurements.csv_files import read_measurements
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.chain import Chain
from diffeo_calib.robots.dh import DHRow, from_dh
from diffeo_calib.robots.urdf import load_urdf

__version__ = "0.1.0"

__all__ = [
    "LBFGS",
    "RK4",
    "RK8",
    "CalibratedKinematics",
    "CalibrationResult",
    "Cauchy",
    "Chain",
    "DHRow",
    "DiffeoCalibError",
    "DiffeoCalibWarning",
    "Fit",
    "GaussNewton",
    "Gaussian",
    "GradientDescent",
    "Hyperparameters",
    "Matern",
    "Measurements",
    "PerJoint",
    "Problem",
    "Space",
    "TorchDiffEq",
    "VonMises",
    "calibrate",
    "evaluate",
    "fit",
    "from_dh",
    "load",
    "load_urdf",
    "read_measurements",
    "save",
]
