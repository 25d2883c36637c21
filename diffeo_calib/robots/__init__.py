"""Robots: chains of joints, their geometric errors and gravity sag, and two arms whose true errors are known."""

from diffeo_calib.robots.dh import DHRow, from_dh
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.payload import with_load
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.robots.tree import Chain
from diffeo_calib.robots.urdf import load_urdf

__all__ = ["Chain", "DHRow", "Geometry", "Joint", "SimulatedArm", "from_dh", "load_urdf", "with_load"]
