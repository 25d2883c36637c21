"""Model files, and exports of calibrated models to formats of other programs.

Names are loaded when they are first used, as those of the package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffeo_calib.common.lazy import lazy_names

if TYPE_CHECKING:
    from diffeo_calib.interop.c_source import CFiles, write_c
    from diffeo_calib.interop.dh import DHTable, dh_table, write_dh
    from diffeo_calib.interop.joint_tables import (
        CorrectionTable,
        correction_tables,
        write_correction_tables,
        write_joint_offsets,
    )
    from diffeo_calib.interop.mjcf import write_mjcf
    from diffeo_calib.interop.numpy_model import NumpyKinematics, load_numpy
    from diffeo_calib.interop.rigid import JointOffsets, RigidKinematics, best_joint_offsets, rigid_kinematics
    from diffeo_calib.interop.sklearn import DiffeoRegressor
    from diffeo_calib.interop.torch_program import TorchProgram, export_onnx, export_torch
    from diffeo_calib.interop.ur_kinematics import write_ur_kinematics
    from diffeo_calib.interop.urdf import write_urdf

__all__ = [
    "CFiles",
    "CorrectionTable",
    "DHTable",
    "DiffeoRegressor",
    "JointOffsets",
    "NumpyKinematics",
    "RigidKinematics",
    "TorchProgram",
    "best_joint_offsets",
    "correction_tables",
    "dh_table",
    "export_onnx",
    "export_torch",
    "load_numpy",
    "rigid_kinematics",
    "write_c",
    "write_correction_tables",
    "write_dh",
    "write_joint_offsets",
    "write_mjcf",
    "write_ur_kinematics",
    "write_urdf",
]

if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "c_source": "CFiles write_c",
            "dh": "DHTable dh_table write_dh",
            "joint_tables": "CorrectionTable correction_tables write_correction_tables write_joint_offsets",
            "mjcf": "write_mjcf",
            "numpy_model": "NumpyKinematics load_numpy",
            "rigid": "JointOffsets RigidKinematics best_joint_offsets rigid_kinematics",
            "sklearn": "DiffeoRegressor",
            "torch_program": "TorchProgram export_onnx export_torch",
            "ur_kinematics": "write_ur_kinematics",
            "urdf": "write_urdf",
        },
    )
