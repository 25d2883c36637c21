"""Model files, and exports of calibrated models to formats of other programs.

Names are loaded when they are first used, as those of the package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffeo_calib.common.lazy import lazy_names

if TYPE_CHECKING:
    from diffeo_calib.interop.c_source import CFiles as CFiles
    from diffeo_calib.interop.c_source import write_c as write_c
    from diffeo_calib.interop.dh import DHTable as DHTable
    from diffeo_calib.interop.dh import dh_table as dh_table
    from diffeo_calib.interop.dh import write_dh as write_dh
    from diffeo_calib.interop.dh import write_ur_kinematics as write_ur_kinematics
    from diffeo_calib.interop.numpy_model import NumpyKinematics as NumpyKinematics
    from diffeo_calib.interop.numpy_model import load_numpy as load_numpy
    from diffeo_calib.interop.rigid import JointOffsets as JointOffsets
    from diffeo_calib.interop.rigid import RigidKinematics as RigidKinematics
    from diffeo_calib.interop.rigid import best_joint_offsets as best_joint_offsets
    from diffeo_calib.interop.rigid import rigid_kinematics as rigid_kinematics
    from diffeo_calib.interop.sklearn import DiffeoRegressor as DiffeoRegressor
    from diffeo_calib.interop.tables import CorrectionTable as CorrectionTable
    from diffeo_calib.interop.tables import correction_tables as correction_tables
    from diffeo_calib.interop.tables import write_correction_tables as write_correction_tables
    from diffeo_calib.interop.tables import write_joint_offsets as write_joint_offsets
    from diffeo_calib.interop.torch_program import TorchProgram as TorchProgram
    from diffeo_calib.interop.torch_program import export_onnx as export_onnx
    from diffeo_calib.interop.torch_program import export_torch as export_torch
    from diffeo_calib.interop.urdf import write_mjcf as write_mjcf
    from diffeo_calib.interop.urdf import write_urdf as write_urdf

if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names
    __getattr__, __dir__, __all__ = lazy_names(__name__)
