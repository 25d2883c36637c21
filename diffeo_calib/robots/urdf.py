"""Chains from URDF files.

Only links and joints matter here. Everything else in the file (meshes, materials, plug-ins, unknown tags) is
cut away before ``yourdfpy`` reads it, so that none of it can fail or be missing.
"""

from __future__ import annotations

from difflib import get_close_matches
from importlib import import_module
from io import BytesIO
from math import inf, isfinite
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffeo_calib.common.errors import MOST_NAMES, RobotError, few, sentence
from diffeo_calib.robots.chain import KINDS, Chain, Joint

JOINT_PARTS = ("origin", "parent", "child", "axis", "limit", "mimic")
"""The parts of a <joint> that decide its kinematics."""


def load_urdf(path: str | PathLike[str], base: str, tip: str) -> Chain:
    """Read the chain from link ``base`` to link ``tip``; the poses are those of ``tip`` in ``base`` [m, rad].

    A joint with <mimic> is passive: the joint that it names moves it, which must be between ``base`` and ``tip`` too.
    Joints off that path (grippers, other arms) may be of any kind. Meshes are neither needed nor read.

    Args:
        path: the URDF file (expand xacro files first).
        base: name of a link.
        tip: name of a link below ``base``.

    Raises:
        RobotError: file missing or not a URDF; unknown links; ``tip`` not below ``base``; no moving joint between
            them; a floating or planar joint between them, or a joint that mimics one that is not; an axis of length
            zero.
    """
    path = Path(path)
    robot = _read(path)
    links = [link.name for link in robot.links]
    for role, name in (("base", base), ("tip", tip)):
        _known(role, name, links, path)
    joints = [_joint(joint, path) for joint in _path_between(robot.joints, base, tip, path)]
    return Chain(robot.name, base, tip, joints)


def _read(path: Path) -> Any:
    """The file as a yourdfpy Robot of links and joints only."""
    from yourdfpy import URDF  # noqa: PLC0415  # half a second, for those who read a URDF only

    xml = _kinematic_xml(path)
    try:
        return URDF.load(BytesIO(xml), build_scene_graph=False, load_meshes=False).robot
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        fix = "check it against the URDF specification"
        raise RobotError(sentence(f"'{path}' cannot be read as a URDF ({error})", fix=fix)) from error


def _kinematic_xml(path: Path) -> bytes:
    """Cut the file down to <robot>, <link> names and the :data:`JOINT_PARTS`, checking them on the way."""
    etree = import_module("lxml.etree")  # comes with yourdfpy
    root = _parse(path, etree)
    kept = etree.Element("robot", name=root.get("name") or path.stem)
    for link in root.findall("link"):
        etree.SubElement(kept, "link", name=_attribute(link, "name", "a <link>", path))
    for joint in root.findall("joint"):
        name = _attribute(joint, "name", "a <joint>", path)
        what = f"joint '{name}'"
        copy = etree.SubElement(kept, "joint", name=name, type=_attribute(joint, "type", what, path))
        for part in JOINT_PARTS:
            element = joint.find(part)
            if element is None and part in ("parent", "child"):
                raise RobotError(sentence(f"{what} in '{path}' has no <{part}>", fix=f"add <{part} link=.../>"))
            if element is not None:
                etree.SubElement(copy, part, attrib=dict(element.attrib))
                _check_part(element, part, what, path)
    return etree.tostring(kept)


def _parse(path: Path, etree: Any) -> Any:
    """Root element of the file. Undeclared name spaces, common in old files, are let pass; nothing else is."""
    if not path.is_file():
        raise RobotError(sentence(f"there is no file '{path}'", fix="check the path of the URDF"))
    parser = etree.XMLParser(recover=True, remove_comments=True, remove_pis=True, resolve_entities=False)
    problems = []
    try:
        root = etree.fromstring(path.read_bytes(), parser)
        problems = [entry for entry in parser.error_log if entry.domain_name != "NAMESPACE"]
    except etree.XMLSyntaxError as error:
        root, problems = None, [error]
    if root is None or problems:
        why = getattr(problems[0], "message", problems[0]) if problems else "no element in it"
        line = getattr(problems[0], "line", "?") if problems else 1
        raise RobotError(sentence(f"'{path}' is not well-formed XML (line {line}: {why})", fix="pass a URDF file"))
    if root.tag != "robot":
        expected, got = "<robot> as its root element", f"<{root.tag}>"
        raise RobotError(sentence(f"'{path}' is not a URDF", expected=expected, got=got, fix="pass a URDF file"))
    return root


def _check_part(element: Any, part: str, what: str, path: Path) -> None:
    """Check the attributes of one part of a joint, which yourdfpy would accept or drop without a word."""
    if part in ("parent", "child"):
        _attribute(element, "link", f"<{part}> of {what}", path)
    for name in {"origin": ("xyz", "rpy"), "axis": ("xyz",)}.get(part, ()):
        _check_numbers(element.get(name), 3, f"{name} of <{part}> of {what} in '{path}'")
    for name in {"limit": ("lower", "upper"), "mimic": ("multiplier", "offset")}.get(part, ()):
        _check_numbers(element.get(name), 1, f"{name} of <{part}> of {what} in '{path}'")


def _check_numbers(text: str | None, count: int, what: str) -> None:
    if text is None:
        return
    try:
        fine = len(text.split()) == count and all(isfinite(float(word)) for word in text.split())
    except ValueError:
        fine = False
    if not fine:
        fix = "expand the xacro file first" if "$" in text else "correct the file"
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        raise RobotError(sentence(what, expected=expected, got=repr(text), fix=fix))


def _attribute(element: Any, name: str, what: str, path: Path) -> str:
    value = element.get(name)
    if not value:
        raise RobotError(sentence(f"{what} in '{path}' has no attribute '{name}'", fix="add it"))
    return value


def _known(role: str, name: str, links: list[str], path: Path) -> None:
    if name in links:
        return
    near = get_close_matches(name, links, n=3)
    hint = f"did you mean {' or '.join(repr(link) for link in near)}? " if near else ""
    what = f"`{role}`: '{path}' has no link '{name}'"
    raise RobotError(sentence(what, fix=f"{hint}its links are {few(links, MOST_NAMES) or '(none)'}"))


def _path_between(joints: list[Any], base: str, tip: str, path: Path) -> list[Any]:
    """The joints from ``base`` down to ``tip``, found by climbing from ``tip``."""
    above: dict[str, Any] = {}
    for joint in joints:
        if joint.child in above:
            both = f"'{above[joint.child].name}' and '{joint.name}'"
            what = f"link '{joint.child}' in '{path}' hangs on two joints ({both})"
            raise RobotError(sentence(what, fix="a URDF is a tree: every link has one parent"))
        above[joint.child] = joint
    climbed, link = [], tip
    while link != base:
        if link not in above or len(climbed) > len(joints):
            passed = " <- ".join([tip, *(joint.parent for joint in climbed)][: len(joints) + 1])
            fix = "choose a base that is above the tip"
            raise RobotError(
                sentence(f"link '{tip}' is not below '{base}' in '{path}'", got=f"the path {passed}", fix=fix)
            )
        climbed.append(above[link])
        link = above[link].parent
    return climbed[::-1]


def _joint(joint: Any, path: Path) -> Joint:
    """One joint of the path as ours."""
    what = f"joint '{joint.name}' in '{path}'"
    if joint.type not in KINDS:
        expected = f"one of {', '.join(KINDS)}"
        fix = "choose a base and a tip that leave it out"
        raise RobotError(sentence(f"the type of {what}", expected=expected, got=repr(joint.type), fix=fix))
    origin = np.eye(4) if joint.origin is None else joint.origin
    # Exporters write a zero axis for fixed joints, which have none.
    axis = (0.0, 0.0, 1.0) if joint.type == "fixed" else joint.axis
    lower, upper = _limits(joint)
    moved_by, offset = _mimic(joint, what)
    return Joint(joint.name, joint.type, torch.as_tensor(origin), torch.as_tensor(axis), lower, upper, moved_by, offset)


def _mimic(joint: Any, what: str) -> tuple[dict[str, float] | None, float]:
    """Multiplier by the name of the joint that moves this one, and the offset; None and 0 for an active joint."""
    if joint.mimic is None:
        return None, 0.0
    if not joint.mimic.joint:
        raise RobotError(sentence(f"<mimic> of {what} has no attribute 'joint'", fix="add it"))
    return {joint.mimic.joint: joint.mimic.multiplier}, joint.mimic.offset


def _limits(joint: Any) -> tuple[float, float]:
    """Lower and upper limit, infinite where the file gives none or where they mean nothing."""
    if joint.limit is None or joint.type in ("continuous", "fixed"):
        return -inf, inf
    lower, upper = joint.limit.lower, joint.limit.upper
    return (-inf if lower is None else lower), (inf if upper is None else upper)
