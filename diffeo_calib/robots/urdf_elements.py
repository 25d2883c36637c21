"""Links and joints of URDF files.

Only the names of links and the kinematics of joints are read. Meshes, materials, plug-ins and unknown tags are ignored,
so that none of them can be missing or wrong. Harmless leftovers of exporters, which other programs load as well, are
ignored with a warning.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from math import inf, isfinite
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import MOST_NAMES, RobotError, as_written, few, shown
from diffeo_calib.robots.joint import KINDS, Joint
from diffeo_calib.robots.se3 import roll_pitch_yaw, transforms

AXIS = (1.0, 0.0, 0.0)  # axis of a joint without <axis>, by the URDF specification
LARGEST_FILE = 100_000_000  # bytes of a file that no URDF has; meshes are files of their own
HARMLESS = {
    "ERR_UNKNOWN_VERSION": "the version in its XML declaration",
    "WAR_UNKNOWN_VERSION": "the version in its XML declaration",
    "ERR_RESERVED_XML_NAME": "an XML declaration that is not at its very beginning",
    "ERR_HYPHEN_IN_COMMENT": "two hyphens inside a comment",
}
"""Faults of XML behind which everything is read as it stands, by their names in libxml2."""


@dataclass(frozen=True)
class JointElement:
    """A <joint> of the file."""

    # name, kind, parent, child: its attributes and links; any ``kind``
    name: str
    kind: str
    parent: str
    child: str
    origin: Tensor  # (4, 4) pose in the parent link's frame [m]
    axis: tuple[float, ...]  # in its own frame, of any length
    # lower and upper [rad or m], infinite where the file gives none and NaN where it says NaN
    limits: tuple[float, float]
    driver: str | None  # name of the joint that it mimics, empty if the file forgets it; None without <mimic>
    # multiplier, offset: of the mimic
    multiplier: float
    offset: float


@dataclass(frozen=True)
class URDF:
    """The kinematics of a robot in a file."""

    path: Path  # the file, for messages
    name: str  # the robot's
    links: list[str]  # names of its links
    joints: list[JointElement]  # all of them, in order
    ignored: list[str]  # harmless faults of the file
    macros: bool  # whether xacro macros are left in it

    @classmethod
    def parse(cls, content: bytes, path: Path) -> URDF:
        """Read the content of a file. Raises RobotError: not a URDF, or a joint whose description is broken."""
        root, ignored = xml_of(content, path)
        links = [_attribute(link, "name", "a <link>", path) for link in root.findall("link")]
        joints = [_read_joint(element, path) for element in root.findall("joint")]
        macros = any(element.prefix == "xacro" or str(element.tag).startswith("xacro:") for element in root)
        return cls(path, root.get("name") or path.stem, links, joints, ignored, macros)

    def check_link(self, role: str, name: str) -> None:
        """Raise RobotError unless there is a link of this name; ``role`` is the argument that names it."""
        if name in self.links:
            return
        self.check_whole(role, f" '{name}'")
        near = get_close_matches(str(name), self.links, n=3)
        hint = f"did you mean {' or '.join(map(repr, near))}? " * bool(near)
        links = few(self.links, MOST_NAMES) or "(none)"
        raise RobotError.of(f"`{role}`: '{self.path}' has no link '{name}'", fix=f"{hint}its links are {links}")

    def check_whole(self, role: str, name: str = "") -> None:
        """Raise RobotError for macros, in a file in which no link, or none of this name, is the one for a role."""
        if self.macros:
            what = f"`{role}`: '{self.path}' has no link{name}, but macros that may make it"
            raise RobotError.of(what, fix="expand the xacro file first (`xacro FILE > robot.urdf`) and pass the result")


def xml_of(content: bytes, path: Path) -> tuple[Any, list[str]]:
    """Root element of the file, and which harmless faults it has.

    Undeclared name spaces, common in old files, are accepted. A default name space is dropped.
    """
    etree = import_module("lxml.etree")  # compiled, without type stubs
    parser = etree.XMLParser(recover=True, remove_comments=True, remove_pis=True, resolve_entities=False)
    problems = []
    try:
        root = etree.fromstring(content, parser)
        problems = [entry for entry in parser.error_log if entry.domain_name != "NAMESPACE"]
    except etree.XMLSyntaxError as error:
        root, problems = None, [error]
    faults = [HARMLESS.get(getattr(problem, "type_name", "")) for problem in problems]
    serious = [problem for problem, fault in zip(problems, faults, strict=True) if fault is None]
    if root is None or serious:
        why = getattr(serious[0], "message", serious[0]) if serious else "no element in it"
        line = getattr(serious[0], "line", "?") if serious else 1
        raise RobotError.of(f"'{path}' is not well-formed XML (line {line}: {why})", fix="pass a URDF file")
    name = etree.QName(root)
    if name.localname != "robot":
        expected, got = "<robot> as its root element", f"<{root.tag}>"
        raise RobotError.of(f"'{path}' is not a URDF", expected=expected, got=got, fix="pass a URDF file")
    if name.namespace is not None:
        for element in root.iter(f"{{{name.namespace}}}*"):
            element.tag = etree.QName(element).localname
    return root, sorted({fault for fault in faults if fault is not None})


def _read_joint(joint: Any, path: Path) -> JointElement:
    """Read one <joint>, wherever it is in the robot."""
    name = _attribute(joint, "name", "a <joint>", path)
    what, where = f"joint '{name}'", f"of joint '{name}' in '{path}'"
    kind, ends = _attribute(joint, "type", what, path), []
    for part in ("parent", "child"):
        if (element := joint.find(part)) is None:
            raise RobotError.of(f"{what} in '{path}' has no <{part}>", fix=f"add <{part} link=.../>")
        ends.append(_attribute(element, "link", f"<{part}> of {what}", path))
    parent, child = ends
    (lower,) = _numbers(joint, "limit", "lower", (-inf,), where, finite=False)
    (upper,) = _numbers(joint, "limit", "upper", (inf,), where, finite=False)
    (multiplier,) = _numbers(joint, "mimic", "multiplier", (1.0,), where)
    (offset,) = _numbers(joint, "mimic", "offset", (0.0,), where)
    mimic = joint.find("mimic")
    driver = None if mimic is None else mimic.get("joint", "")
    # An <axis> without xyz is no axis: parsers differ in what they make of it.
    axis = _numbers(joint, "axis", "xyz", AXIS if joint.find("axis") is None else (0.0, 0.0, 0.0), where)
    xyz, rpy = (_numbers(joint, "origin", name, (0.0, 0.0, 0.0), where) for name in ("xyz", "rpy"))
    origin = transforms(roll_pitch_yaw(*rpy), torch.tensor(xyz, dtype=torch.float64, device="cpu"))
    return JointElement(name, kind, parent, child, origin, axis, (lower, upper), driver, multiplier, offset)


def _numbers(
    joint: Any, part: str, name: str, default: tuple[float, ...], where: str, *, finite: bool = True
) -> tuple[float, ...]:
    """The numbers in an attribute of a joint's part, checked; ``default`` where the file does not give them."""
    element = joint.find(part)
    text = None if element is None else element.get(name)
    if text is None:
        return default
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) != len(default) or (finite and not all(map(isfinite, numbers))):
        fix = "expand the xacro file first" if "$" in text else "correct the file"
        expected = "a finite number" if len(default) == 1 else f"{len(default)} finite numbers"
        raise RobotError.of(f"{name} of <{part}> {where}", expected=expected, got=shown(repr(text)), fix=fix)
    return numbers


def _attribute(element: Any, name: str, what: str, path: Path) -> str:
    value = element.get(name)
    if not value:
        raise RobotError.of(f"{what} in '{path}' has no attribute '{name}'", fix="add it")
    return value


def harmless_faults(joint: JointElement) -> list[str]:
    """Parts of a joint that have no effect, or that cannot be meant as they stand and are left out."""
    faults = []
    lower, upper = joint.limits
    if joint.kind in ("revolute", "prismatic") and not lower <= upper:
        faults.append(f"the limits of joint '{joint.name}' (lower {lower:g}, upper {upper:g})")
    if joint.kind == "fixed" and joint.driver is not None:
        faults.append(f"<mimic> of joint '{joint.name}', which is fixed")
    return faults


def joint_of(joint: JointElement, path: Path) -> Joint:
    """A joint between base and tip, as part of a chain."""
    what = f"joint '{joint.name}' in '{path}'"
    if joint.kind not in KINDS:
        expected = f"one of {', '.join(KINDS)}"
        fix = "choose a base and a tip that leave it out"
        raise RobotError.of(f"the type of {what}", expected=expected, got=as_written(joint.kind), fix=fix)
    if joint.kind == "fixed":  # exporters write axes of length zero, limits and mimics of fixed joints
        return Joint(joint.name, joint.kind, joint.origin)
    if joint.driver == "":
        raise RobotError.of(f"<mimic> of {what} has no attribute 'joint'", fix="add it")
    lower, upper = joint.limits
    if joint.kind == "continuous" or not lower <= upper:  # exporters write limits of continuous joints
        lower, upper = -inf, inf
    direction = torch.tensor(joint.axis, dtype=torch.float64, device="cpu")
    mimic = None if joint.driver is None else {joint.driver: joint.multiplier}
    return Joint(joint.name, joint.kind, joint.origin, direction, lower, upper, mimic, joint.offset)
