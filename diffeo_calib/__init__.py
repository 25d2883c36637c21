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
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffeo_calib import interop as interop
    from diffeo_calib.calibration.calibrate import CalibrationResult, calibrate
    from diffeo_calib.calibration.planning.candidates import Tracker, candidates
    from diffeo_calib.calibration.planning.plan import Plan, plan
    from diffeo_calib.calibration.planning.sensors import Sensor
    from diffeo_calib.calibration.recalibration.compare import Comparison, ModelComparison, compare
    from diffeo_calib.calibration.recalibration.recalibrate import Recalibration, recalibrate
    from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
    from diffeo_calib.campaign.campaign import Campaign
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
    from diffeo_calib.kernels.base import Kernel
    from diffeo_calib.kernels.radial import Cauchy, Gaussian, Matern, PerJoint, VonMises
    from diffeo_calib.kernels.spaces import Space
    from diffeo_calib.kinematics.calibrated import CalibratedKinematics
    from diffeo_calib.kinematics.compensation.compensate import Compensation, compensate
    from diffeo_calib.kinematics.evaluation import evaluate, joints_outside_range, rows_used_in_fit
    from diffeo_calib.measurements.csv.files import read_measurements, read_readings
    from diffeo_calib.measurements.observations import Observations
    from diffeo_calib.measurements.readings import Readings
    from diffeo_calib.measurements.table import Measurements
    from diffeo_calib.reports import plots as plots
    from diffeo_calib.reports.report import write_report
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
    "ModelComparison",
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
    "compare",
    "compensate",
    "evaluate",
    "fit",
    "from_dh",
    "joints_outside_range",
    "load",
    "load_urdf",
    "plan",
    "read_measurements",
    "read_readings",
    "recalibrate",
    "rows_used_in_fit",
    "save",
    "write_report",
]

_MODULE_OF = {
    "LBFGS": "fitting.lbfgs",
    "RK4": "flows.integrators",
    "RK8": "flows.integrators",
    "CalibratedKinematics": "kinematics.calibrated",
    "CalibrationResult": "calibration.calibrate",
    "Campaign": "campaign.campaign",
    "Cauchy": "kernels.radial",
    "Chain": "robots.tree",
    "Comparison": "calibration.recalibration.compare",
    "Compensation": "kinematics.compensation.compensate",
    "ModelComparison": "calibration.recalibration.compare",
    "Recalibration": "calibration.recalibration.recalibrate",
    "compare": "calibration.recalibration.compare",
    "recalibrate": "calibration.recalibration.recalibrate",
    "DHRow": "robots.dh",
    "DiffeoCalibError": "common.errors",
    "DiffeoCalibWarning": "common.errors",
    "Fit": "fitting.result",
    "GaussNewton": "fitting.gauss_newton",
    "Gaussian": "kernels.radial",
    "GradientDescent": "fitting.gradient_descent",
    "Kernel": "kernels.base",
    "Hyperparameters": "calibration.scales.hyperparameters",
    "Matern": "kernels.radial",
    "Measurements": "measurements.table",
    "Observations": "measurements.observations",
    "PerJoint": "kernels.radial",
    "Plan": "calibration.planning.plan",
    "Problem": "fitting.problem",
    "Readings": "measurements.readings",
    "Sensor": "calibration.planning.sensors",
    "Space": "kernels.spaces",
    "TorchDiffEq": "flows.torchdiffeq",
    "Tracker": "calibration.planning.candidates",
    "Tree": "robots.tree",
    "VonMises": "kernels.radial",
    "calibrate": "calibration.calibrate",
    "candidates": "calibration.planning.candidates",
    "compensate": "kinematics.compensation.compensate",
    "evaluate": "kinematics.evaluation",
    "joints_outside_range": "kinematics.evaluation",
    "rows_used_in_fit": "kinematics.evaluation",
    "fit": "fitting.fit",
    "from_dh": "robots.dh",
    "load": "interop.model_file",
    "load_urdf": "robots.urdf",
    "plan": "calibration.planning.plan",
    "read_measurements": "measurements.csv.files",
    "read_readings": "measurements.csv.files",
    "save": "interop.model_file",
    "write_report": "reports.report",
}
"""The module that defines each public name, as in the imports above."""
_FOLDERS = (
    "calibration",
    "cameras",
    "campaign",
    "cli",
    "common",
    "fitting",
    "flows",
    "interop",
    "kernels",
    "kinematics",
    "maps",
    "measurements",
    "paper",
    "regression",
    "reports",
    "robots",
    "runtime",
    "sensors",
)

if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names

    def __getattr__(name: str) -> object:
        """Load a public name, or a folder of this package, when it is first used."""
        if name in _MODULE_OF:
            value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        elif name == "plots":
            value = import_module(f"{__name__}.reports.plots")
        elif name in _FOLDERS:
            value = import_module(f"{__name__}.{name}")
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """All names of the package, whether they are loaded yet or not."""
    dunder = {name for name in globals() if name.startswith("__")}
    return sorted({*dunder, *__all__, *_FOLDERS, "plots"})
