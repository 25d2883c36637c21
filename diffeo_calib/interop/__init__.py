"""Model files, and exports of calibrated models to formats of other programs.

Names are loaded when they are first used, as those of the package.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffeo_calib.interop.rigid import RigidKinematics, best_joint_offsets, rigid_kinematics
    from diffeo_calib.interop.urdf import write_urdf

__all__ = [
    "RigidKinematics",
    "best_joint_offsets",
    "rigid_kinematics",
    "write_urdf",
]

_MODULE_OF = {
    "RigidKinematics": "rigid",
    "best_joint_offsets": "rigid",
    "rigid_kinematics": "rigid",
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
