"""A robot's URDF with corrected joint origins: everything else in the file stays as it is, byte for byte.

Every moving joint l of the chain has a rigid error E_l between its frame and its motion (:class:`Geometry`),

    T(q) = prod_l [ O_l E_l J_l(q_l) ] O_tip,

so that the corrected origin of a joint is its own origin times E_l. Axes, fixed joints, mimic joints and joints beside
the chain stay as they are. The attributes are edited in place in the text of the file, so that comments, meshes,
quotes, order and white space are kept.

And the same kinematics as MJCF, the format of MuJoCo: bodies, joints, inertias, and a site at every tip.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Any
from xml.parsers import expat

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, NumericalError, RobotError
from diffeo_calib.common.files import read_regular, write_whole
from diffeo_calib.interop.rigid import geometry_of
from diffeo_calib.interop.tables import origin_numbers
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import roll_pitch_yaw
from diffeo_calib.robots.tree import BASE, Tree
from diffeo_calib.robots.urdf import read_urdf
from diffeo_calib.robots.urdf_elements import LARGEST_FILE, xml_of

SAME_ROBOT_TOLERANCE = 1e-9  # largest difference, m or rad, between two descriptions of one robot
READ_BACK = 1e-12  # largest difference, per metre of reach, between poses by the written file and by the geometry
ATTRIBUTE = re.compile(rb"""\s+([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")


def write_urdf(
    kinematics: CalibratedKinematics | Geometry, path: str | PathLike[str], robot: str | PathLike[str] | None = None
) -> None:
    """Write the robot's own URDF with corrected origins of the joints between base and tip.

    The base in the measuring frame and the markers are not part of a URDF: see ``geometry.base``. Gravity sag,
    transmission errors and other deformations cannot be written either.

    Args:
        kinematics: a calibrated model, see :func:`rigid_kinematics`, or a geometry. path: the file to write.
        robot: the URDF to correct, by default the one that the model was fitted with.

    Raises InputError: the model does not hold its URDF and ``robot`` is missing, or the file cannot be written.
    Raises RobotError: ``robot`` is another robot or not a URDF; a joint's origin that cannot be found in the text.
    """
    geometry = geometry_of(kinematics)
    write_whole(path, corrected_urdf(geometry, urdf_of(geometry.chain, robot)))


def urdf_of(chain: Tree, robot: str | PathLike[str] | None = None) -> bytes:
    """The content of the URDF that describes a chain: a file that is checked against it, or its own.

    Raises InputError: no file is given, and the chain has none. RobotError: the file describes another robot.
    """
    if robot is None:
        if chain.source is None:
            what = f"the model of robot '{chain.name}' does not hold the URDF that it was fitted with"
            fix = "pass the file: `robot`, or --robot URDF; for a robot of a DH table write --dh, --mjcf or --c"
            raise InputError.of(what, fix=fix)
        return chain.source.encode("utf-8", "surrogateescape")
    path = Path(robot)
    content = read_regular(path, "URDF", LARGEST_FILE, RobotError)
    _check_same(chain, read_urdf(content, chain.base, chain.tips, path, chain.loads), path)
    return content


def corrected_urdf(geometry: Geometry, content: bytes) -> bytes:
    """The content of a URDF after its joints' origins were corrected; see :func:`write_urdf`."""
    chain = geometry.chain
    if chain.ground_place is not None:
        what = f"robot '{chain.name}' was calibrated from '{chain.base}', which is not above its other links"
        raise InputError.of(what, fix="a URDF can be corrected for a base above all tips and loads")
    moving = (joint for joint in chain.joints if joint.kind != "fixed")
    origins = {
        joint.name: joint.origin @ error
        for joint, error in zip(moving, geometry.joint_errors, strict=True)
        if not torch.equal(error, torch.eye(4, dtype=error.dtype, device=error.device))
    }
    elements = _joint_elements(content)
    edits: list[tuple[slice, bytes]] = []
    for name, origin in origins.items():
        matches = [element for element in elements if element.name == name]
        if len(matches) != 1:
            what, expected = f"the joint '{name}' in the URDF of robot '{chain.name}'", "one <joint> with this name"
            raise RobotError.of(what, expected=expected, got=len(matches), fix="pass its own URDF")
        edits += _origin_edits(content, matches[0], origin)
    for place, text in sorted(edits, key=lambda edit: edit[0].start, reverse=True):  # so that places stay right
        content = content[: place.start] + text + content[place.stop :]
    _check_read_back(geometry, content)
    return content


@dataclass
class _Element:
    """A <joint> in the text: its name, where its tag begins, and that of its first <origin>; None without one."""

    name: str
    start: int
    origin: int | None = None


def _joint_elements(content: bytes) -> list[_Element]:
    """The joints of a robot, at the places that the parser reports: comments and CDATA cannot mislead it."""
    elements: list[_Element] = []
    path: list[str] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        if path[1:] == ["joint"]:
            elements.append(_Element(attributes.get("name", ""), parser.CurrentByteIndex))
        elif path[1:] == ["joint", "origin"] and elements[-1].origin is None:
            elements[-1].origin = parser.CurrentByteIndex

    def end(_: str) -> None:
        path.pop()

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise RobotError.of(f"the URDF is not well-formed XML ({error})", fix="pass a URDF file") from error
    return elements


def _origin_edits(content: bytes, joint: _Element, origin: Tensor) -> Iterator[tuple[slice, bytes]]:
    """Places in the text, and what replaces them, to give a joint another origin."""
    numbers = dict(zip((b"xyz", b"rpy"), origin_numbers(origin), strict=True))
    texts = {
        name: " ".join(map(repr, values)).encode() for name, values in numbers.items()
    }  # read back to the last bit
    if joint.origin is None:
        inside = content.index(b">", _attributes(content, joint.start, b"joint")[1]) + 1
        space = re.compile(rb"\s*").match(content, inside)
        attributes = b"".join(b' %b="%b"' % named for named in texts.items())
        yield slice(inside, inside), (space[0] if space else b"") + b"<origin" + attributes + b"/>"
        return
    places, stop = _attributes(content, joint.origin, b"origin")
    for name, place in places.items():
        if name in numbers and [float(word) for word in content[place].split()] != numbers[name]:
            yield place, texts[name]
    yield slice(stop, stop), b"".join(b' %b="%b"' % named for named in texts.items() if named[0] not in places)


def _attributes(content: bytes, start: int, tag: bytes) -> tuple[dict[bytes, slice], int]:
    """Where the values of a tag's attributes are, without quotes, and where the last attribute ends."""
    stop = start + 1 + len(tag)
    if content[start:stop] != b"<" + tag:
        what = f"the <{tag.decode()}> tags of the URDF cannot be found in its text"
        raise RobotError.of(what, fix="save the file in UTF-8, without entities, and pass it: `robot`, or --robot URDF")
    places = {}
    while match := ATTRIBUTE.match(content, stop):
        places[match[1]] = slice(match.start(2) + 1, match.end(2) - 1)
        stop = match.end()
    return places, stop


def _check_same(chain: Tree, other: Tree, path: Path) -> None:
    """Raise RobotError unless a file describes the nominal robot of a model."""
    names, kinds = (chain.moving_names, other.moving_names), (chain.kinds, other.kinds)
    for what, (mine, theirs) in (("joints", names), ("kinds of joints", kinds)):
        if mine != theirs:
            expected, fix = ", ".join(mine), "pass the URDF that the model was fitted with"
            raise RobotError.of(f"the {what} of '{path}'", expected=expected, got=", ".join(theirs), fix=fix)
    ends = (*chain.moving_names, *chain.ends)
    for numbers in ("place_offsets", "axes", "coupling", "coupling_offset"):
        for joint, mine, theirs in zip(ends, getattr(chain, numbers), getattr(other, numbers), strict=False):
            if float((mine - theirs).abs().max()) > SAME_ROBOT_TOLERANCE:
                what = f"'{path}' is not the URDF that the model was fitted with: it differs at '{joint}'"
                raise RobotError.of(what, fix="pass the nominal URDF of the fit")


def _check_read_back(geometry: Geometry, content: bytes) -> None:
    """Raise NumericalError unless the text gives the poses of the geometry: a check of the edits, at random joints."""
    chain = geometry.chain
    again = read_urdf(content, chain.base, chain.tips, Path("the corrected URDF"), chain.loads)
    q = 4 * torch.rand(16, chain.n, dtype=torch.float64, device=HOST, generator=seeded(0)) - 2
    expected = replace(Geometry.nominal(chain), joint_errors=geometry.joint_errors).poses(q)
    size = 1.0 + float(expected[..., :3, 3].norm(dim=-1).max())
    error = float((again(q) - expected).abs().max()) / size
    if not error < READ_BACK:
        what = f"the corrected URDF gives other poses than the corrected geometry, by {error:.1e} per metre"
        raise NumericalError.of(what, fix="report this file: its joints were not written")


etree = import_module("lxml.etree")  # compiled, without type stubs

SMALLEST_MASS_KG, SMALLEST_INERTIA = 1e-3, 1e-9
"""Of bodies without <inertial>: MuJoCo refuses moving bodies without mass."""


def write_mjcf(kinematics: CalibratedKinematics | Geometry, path: str | PathLike[str]) -> None:
    """Write the best rigid kinematics for MuJoCo.

    There is a body for every link, whose frame is at ``O_l E_l`` in the body before it. Masses and inertias are those
    of the URDF. Meshes, actuators and contacts are not written: take these bodies' places over into a model that has
    them.

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
        if inertial is not None and (inertia := _inertial(link, inertial)):
            etree.SubElement(body, "inertial", **inertia)
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
    attributes = {"type": "slide" if joint.kind == "prismatic" else "hinge", "axis": _text(joint.axis)}
    if isfinite(joint.lower) and isfinite(joint.upper) and joint.kind != "continuous" and joint.lower < joint.upper:
        attributes["range"] = f"{joint.lower!r} {joint.upper!r}"
    return attributes


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
