"""Calibrate robot kinematics by diffeomorphisms."""

from diffeo_calib.calibration.fit import fit
from diffeo_calib.calibration.gauss_newton import GaussNewton
from diffeo_calib.calibration.lbfgs import LBFGS
from diffeo_calib.calibration.problem import Problem
from diffeo_calib.flows.integrate import RK4
from diffeo_calib.kernels import Cauchy, Constant, Gaussian, Matern, PerJoint, VonMises
