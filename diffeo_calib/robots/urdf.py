"""Chains from URDF files.

Only the names of links and the kinematics of joints are read. Meshes, materials, plug-ins and unknown tags are ignored,
so that none of them can be missing or wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from math import inf, isfinite
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import MOST_NAMES, RobotError, as_written, few
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.robots.chain import Chain
from diffeo_calib.robots.joint import KINDS, Joint
from diffeo_calib.robots.se3 import roll_pitch_yaw, transforms

AXIS = (1.0, 0.0, 0.0)
"""Axis of a joint without <axis>, by the URDF specification."""


@dataclass(frozen=True)
class _JointElement:
    """A <joint> of the file.

    Args:
        name, kind, parent, child: its attributes and links; any ``kind``.
        origin: (4, 4) pose in the parent link's frame [m].
        axis: in its own frame, of any length.
        limits: lower and upper [rad or m], infinite where the file gives none.
        driver: name of the joint that it mimics, empty if the file forgets it; None without <mimic>.
        multiplier, offset: of the mimic.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Tensor
    axis: tuple[float, ...]
    limits: tuple[float, float]
    driver: str | None
    multiplier: float
    offset: float


@outside_inference_mode
def load_urdf(path: str | PathLike[str], base: str, tip: str) -> Chain:
    """Read the chain from link ``base`` to link ``tip``; the poses are those of ``tip`` in ``base`` [m, rad].

    A joint with <mimic> is driven by the joint that it names, which must be between ``base`` and ``tip`` too.
    Joints off that path (grippers, other arms) may be of any kind. Meshes are not read.

    Args:
        path: the URDF file (expand xacro files first).
        base: name of a link.
        tip: name of a link below ``base``.

    Raises:
        RobotError: file missing or not a URDF; unknown links; ``tip`` not below ``base``; no moving joint between
            them; a floating or planar joint between them; a joint that mimics one off the path; an axis of length
            zero.
    """
    path = Path(path)
    if not path.is_file():
        raise RobotError.of(f"there is no file '{path}'", fix="check the path of the URDF")
    return read_urdf(path.read_bytes(), base, tip, path)


def read_urdf(content: bytes, base: str, tip: str, path: Path) -> Chain:
    """As :func:`load_urdf`, from the content of a file; ``path`` is its name in messages."""
    root = _parse(content, path)
    links = [_attribute(link, "name", "a <link>", path) for link in root.findall("link")]
    joints = [_read_joint(element, path) for element in root.findall("joint")]
    for role, name in (("base", base), ("tip", tip)):
        _known(role, name, links, path)
    between = [_joint(joint, path) for joint in _path_between(joints, base, tip, path)]
    source = content.decode("utf-8", "surrogateescape")
    return Chain(root.get("name") or path.stem, base, tip, between, source=source)


def _parse(content: bytes, path: Path) -> Any:
    """Root element of the file. Undeclared name spaces, common in old files, are accepted; other faults are not."""
    etree = import_module("lxml.etree")  # compiled, without type stubs
    parser = etree.XMLParser(recover=True, remove_comments=True, remove_pis=True, resolve_entities=False)
    problems = []
    try:
        root = etree.fromstring(content, parser)
        problems = [entry for entry in parser.error_log if entry.domain_name != "NAMESPACE"]
    except etree.XMLSyntaxError as error:
        root, problems = None, [error]
    if root is None or problems:
        why = getattr(problems[0], "message", problems[0]) if problems else "no element in it"
        line = getattr(problems[0], "line", "?") if problems else 1
        raise RobotError.of(f"'{path}' is not well-formed XML (line {line}: {why})", fix="pass a URDF file")
    if root.tag != "robot":
        expected, got = "<robot> as its root element", f"<{root.tag}>"
        raise RobotError.of(f"'{path}' is not a URDF", expected=expected, got=got, fix="pass a URDF file")
    return root


def _read_joint(joint: Any, path: Path) -> _JointElement:
    """Read one <joint>, wherever it is in the robot."""
    name = _attribute(joint, "name", "a <joint>", path)
    what = f"joint '{name}'"
    kind = _attribute(joint, "type", what, path)
    parent, child = (_end(joint, part, what, path) for part in ("parent", "child"))
    where = f"of {what} in '{path}'"
    (lower,) = _numbers(joint, "limit", "lower", (-inf,), where)
    (upper,) = _numbers(joint, "limit", "upper", (inf,), where)
    (multiplier,) = _numbers(joint, "mimic", "multiplier", (1.0,), where)
    (offset,) = _numbers(joint, "mimic", "offset", (0.0,), where)
    mimic = joint.find("mimic")
    driver = None if mimic is None else mimic.get("joint", "")
    # An <axis> without xyz is no axis: parsers differ in what they make of it.
    axis = _numbers(joint, "axis", "xyz", AXIS if joint.find("axis") is None else (0.0, 0.0, 0.0), where)
    origin = _origin(joint, where)
    return _JointElement(name, kind, parent, child, origin, axis, (lower, upper), driver, multiplier, offset)


def _end(joint: Any, part: str, what: str, path: Path) -> str:
    """Name of the link at one end of a joint."""
    element = joint.find(part)
    if element is None:
        raise RobotError.of(f"{what} in '{path}' has no <{part}>", fix=f"add <{part} link=.../>")
    return _attribute(element, "link", f"<{part}> of {what}", path)


def _origin(joint: Any, where: str) -> Tensor:
    """Pose (4, 4) of a joint's frame in its parent link's frame [m]."""
    xyz, rpy = (_numbers(joint, "origin", name, (0.0, 0.0, 0.0), where) for name in ("xyz", "rpy"))
    return transforms(roll_pitch_yaw(*rpy), torch.tensor(xyz, dtype=torch.float64, device="cpu"))


def _numbers(joint: Any, part: str, name: str, default: tuple[float, ...], where: str) -> tuple[float, ...]:
    """The numbers in an attribute of a joint's part, checked; ``default`` where the file does not give them."""
    element = joint.find(part)
    text = None if element is None else element.get(name)
    if text is None:
        return default
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) != len(default) or not all(map(isfinite, numbers)):
        fix = "expand the xacro file first" if "$" in text else "correct the file"
        expected = "a finite number" if len(default) == 1 else f"{len(default)} finite numbers"
        raise RobotError.of(f"{name} of <{part}> {where}", expected=expected, got=as_written(text), fix=fix)
    return numbers


def _attribute(element: Any, name: str, what: str, path: Path) -> str:
    value = element.get(name)
    if not value:
        raise RobotError.of(f"{what} in '{path}' has no attribute '{name}'", fix="add it")
    return value


def _known(role: str, name: str, links: list[str], path: Path) -> None:
    if name in links:
        return
    near = get_close_matches(name, links, n=3)
    hint = f"did you mean {' or '.join(repr(link) for link in near)}? " if near else ""
    what = f"`{role}`: '{path}' has no link '{name}'"
    raise RobotError.of(what, fix=f"{hint}its links are {few(links, MOST_NAMES) or '(none)'}")


def _path_between(joints: list[_JointElement], base: str, tip: str, path: Path) -> list[_JointElement]:
    """The joints from ``base`` down to ``tip``, found by climbing from ``tip``."""
    above: dict[str, _JointElement] = {}
    for joint in joints:
        if joint.child in above:
            both = f"'{above[joint.child].name}' and '{joint.name}'"
            what = f"link '{joint.child}' in '{path}' has two parent joints ({both})"
            raise RobotError.of(what, fix="a URDF is a tree: every link has one parent")
        above[joint.child] = joint
    climbed: list[_JointElement] = []
    link = tip
    while link != base:
        if link not in above or len(climbed) > len(joints):
            passed = " <- ".join([tip, *(joint.parent for joint in climbed)][: len(joints) + 1])
            fix = "choose a base that is above the tip"
            raise RobotError.of(f"link '{tip}' is not below '{base}' in '{path}'", got=f"the path {passed}", fix=fix)
        climbed.append(above[link])
        link = above[link].parent
    return climbed[::-1]


def _joint(joint: _JointElement, path: Path) -> Joint:
    """A joint between base and tip, as part of a chain."""
    what = f"joint '{joint.name}' in '{path}'"
    if joint.kind not in KINDS:
        expected = f"one of {', '.join(KINDS)}"
        fix = "choose a base and a tip that leave it out"
        raise RobotError.of(f"the type of {what}", expected=expected, got=as_written(joint.kind), fix=fix)
    if joint.driver == "":
        raise RobotError.of(f"<mimic> of {what} has no attribute 'joint'", fix="add it")
    # Exporters write a zero axis for fixed joints, which have none, and limits for continuous ones.
    axis = (0.0, 0.0, 1.0) if joint.kind == "fixed" else joint.axis
    lower, upper = (-inf, inf) if joint.kind in ("continuous", "fixed") else joint.limits
    direction = torch.tensor(axis, dtype=torch.float64, device="cpu")
    mimic = None if joint.driver is None else {joint.driver: joint.multiplier}
    return Joint(joint.name, joint.kind, joint.origin, direction, lower, upper, mimic, joint.offset)
