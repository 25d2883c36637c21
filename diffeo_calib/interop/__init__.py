"""Model files, and exports of calibrated models to formats of other programs.

Names are loaded when they are first used, as those of the package.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffeo_calib.interop.c_source import CFiles, write_c
    from diffeo_calib.interop.dh import DHTable, dh_table, write_dh
    from diffeo_calib.interop.joint_tables import (
        CorrectionTable,
        correction_tables,
        write_correction_tables,
        write_joint_offsets,
    )
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
    "write_ur_kinematics",
    "write_urdf",
]

_MODULE_OF = {
    "CFiles": "c_source",
    "CorrectionTable": "joint_tables",
    "DHTable": "dh",
    "DiffeoRegressor": "sklearn",
    "JointOffsets": "rigid",
    "NumpyKinematics": "numpy_model",
    "RigidKinematics": "rigid",
    "TorchProgram": "torch_program",
    "best_joint_offsets": "rigid",
    "correction_tables": "joint_tables",
    "dh_table": "dh",
    "export_onnx": "torch_program",
    "export_torch": "torch_program",
    "load_numpy": "numpy_model",
    "rigid_kinematics": "rigid",
    "write_c": "c_source",
    "write_correction_tables": "joint_tables",
    "write_dh": "dh",
    "write_joint_offsets": "joint_tables",
    "write_ur_kinematics": "ur_kinematics",
    "write_urdf": "urdf",
}
"""The module that defines each name."""


if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names

    def __getattr__(name: str) -> object:
        """Load a name when it is first used."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF})
