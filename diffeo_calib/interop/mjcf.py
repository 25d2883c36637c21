"""A calibrated robot as MJCF, the format of MuJoCo: bodies, joints, inertias, and a site at every tip.

The rigid kinematics are those of the corrected URDF (:mod:`~diffeo_calib.interop.urdf`),

    T(q) = prod_l [ O_l E_l J_l(q_l) ] O_tip,

with a body for every link, whose frame is at ``O_l E_l`` in the body before it. Masses and inertias are those of the
URDF. Meshes, actuators and contacts are not written: take these bodies' places over into a model that has them.
"""

from __future__ import annotations

from importlib import import_module
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Any

from torch import Tensor

from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.common.files import write_whole
from diffeo_calib.interop.rigid import geometry_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import roll_pitch_yaw
from diffeo_calib.robots.tree import BASE, Tree
from diffeo_calib.robots.urdf_elements import xml_of

etree = import_module("lxml.etree")  # compiled, without type stubs

SMALLEST_MASS_KG, SMALLEST_INERTIA = 1e-3, 1e-9
"""Of bodies without <inertial>: MuJoCo refuses moving bodies without mass."""


def write_mjcf(kinematics: CalibratedKinematics | Geometry, path: str | PathLike[str]) -> None:
    """Write the best rigid kinematics for MuJoCo.

    Args:
        kinematics: a calibrated model, see :func:`rigid_kinematics`, or a geometry. path: the file to write.

    Raises InputError: a base that is not above all other links, a mimic joint that several joints drive, or one that is
    not in the chain, or the file cannot be written. RobotError: masses or inertias in the URDF that are no numbers.
    """
    write_whole(path, mjcf_text(geometry_of(kinematics)).encode())


def mjcf_text(geometry: Geometry) -> str:
    """The content of the file; errors as of :func:`write_mjcf`."""
    chain = geometry.chain
    if chain.ground_place is not None:
        what = f"robot '{chain.name}' was calibrated from '{chain.base}', which is not above its other links"
        raise InputError.of(what, fix="choose a base above all tips and loads, then MJCF can be written")
    root = etree.Element("mujoco", model=chain.name)
    limits = {"boundmass": repr(SMALLEST_MASS_KG), "boundinertia": repr(SMALLEST_INERTIA)}
    etree.SubElement(root, "compiler", angle="radian", autolimits="true", **limits)
    world = etree.SubElement(root, "worldbody")
    bodies: dict[int, Any] = {BASE: etree.SubElement(world, "body", name=chain.base)}
    errors, links = iter(geometry.joint_errors), _links(chain)
    for number, (joint, parent) in enumerate(zip(chain.joints, chain.parents, strict=True)):
        link, inertial = links.get(joint.name, (joint.name, None))
        placed = joint.origin if joint.kind == "fixed" else joint.origin @ next(errors)
        turn = rotation_numbers(placed[None, :3, :3], "quat_wxyz", angle="rad")[0]
        place = {"pos": _text(placed[:3, 3]), "quat": _text(turn)}
        bodies[number] = body = etree.SubElement(bodies[parent], "body", name=link, **place)
        if inertial is not None and (found := _inertial(link, inertial)):
            etree.SubElement(body, "inertial", **found)
        if joint.kind != "fixed":
            etree.SubElement(body, "joint", name=joint.name, **_motion(joint))
    for tip in chain.tips:
        etree.SubElement(bodies[chain.ends[tip]], "site", name=tip)
    if mimics := [joint for joint in chain.joints if joint.mimic is not None]:
        together = etree.SubElement(root, "equality")
        for joint in mimics:
            (driver, factor), *others = (joint.mimic or {"": 0.0}).items()
            if others or driver not in chain.moving_names:
                fix, expected = "write a URDF, or the whole model as a program", "one joint of the chain that drives it"
                raise InputError.of(f"mimic joint '{joint.name}'", expected=expected, got=joint.mimic, fix=fix)
            follows = {"joint2": driver, "polycoef": f"{joint.mimic_offset!r} {factor!r} 0 0 0"}
            etree.SubElement(together, "joint", joint1=joint.name, **follows)
    return etree.tostring(root, pretty_print=True, encoding="unicode")


def _motion(joint: Joint) -> dict[str, str]:
    """A joint's kind, axis and, where it has both, limits."""
    found = {"type": "slide" if joint.kind == "prismatic" else "hinge", "axis": _text(joint.axis)}
    if isfinite(joint.lower) and isfinite(joint.upper) and joint.kind != "continuous" and joint.lower < joint.upper:
        found["range"] = f"{joint.lower!r} {joint.upper!r}"
    return found


def _links(chain: Tree) -> dict[str, tuple[str, Any]]:
    """Joint -> name of the link below it and its <inertial>, from the robot's URDF; empty without one."""
    if chain.source is None:
        return {}
    root = xml_of(chain.source.encode("utf-8", "surrogateescape"), Path("the URDF"))[0]
    inertials = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    children = {joint.get("name"): joint.find("child") for joint in root.findall("joint")}
    links = {joint: child.get("link") for joint, child in children.items() if child is not None}
    return {joint: (link, inertials.get(link)) for joint, link in links.items()}


def _inertial(link: str, element: Any) -> dict[str, str]:
    """Mass [kg], centre [m] and inertia [kg m^2] in the link's axes; nothing where the URDF lacks one of them."""
    mass, inertia, origin = (element.find(part) for part in ("mass", "inertia", "origin"))
    if mass is None or inertia is None:
        return {}
    xyz, rpy = ("0 0 0" if origin is None else origin.get(name, "0 0 0") for name in ("xyz", "rpy"))
    try:
        kilograms, R = float(mass.get("value", "")), roll_pitch_yaw(*map(float, rpy.split()))
        names = ("ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")
        tensor = R.new_tensor([float(inertia.get(name, "0")) for name in names]).view(3, 3)
    except (TypeError, ValueError) as error:
        what = f"<inertial> of link '{link}' in the URDF"
        raise RobotError.of(what, expected="numbers", got=str(error), fix="correct the file") from None
    moments = (R @ tensor @ R.mT)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return {"mass": repr(kilograms), "pos": xyz, "fullinertia": _text(moments)}


def _text(numbers: Tensor) -> str:
    """Numbers that are read back to the last bit."""
    return " ".join(repr(value + 0.0) for value in numbers.tolist())
