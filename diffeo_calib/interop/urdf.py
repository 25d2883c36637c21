"""A robot's URDF with corrected joint origins: everything else in the file stays as it is, byte for byte.

Every moving joint l of the chain has a rigid error E_l between its frame and its motion (:class:`Geometry`),

    T(q) = prod_l [ O_l E_l J_l(q_l) ] O_tip,

so that the corrected origin of a joint is its own origin times E_l. Axes, fixed joints, mimic joints and joints beside
the chain stay as they are. The attributes are edited in place in the text of the file, so that comments, meshes,
quotes, order and white space are kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from xml.parsers import expat

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, NumericalError, RobotError
from diffeo_calib.common.files import read_regular, write_whole
from diffeo_calib.interop.rigid import geometry_of
from diffeo_calib.interop.tables import origin_numbers
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import read_urdf
from diffeo_calib.robots.urdf_elements import LARGEST_FILE

SAME_ROBOT_TOLERANCE = 1e-9
"""Largest difference, m or rad, between two descriptions of one robot."""
READ_BACK = 1e-12
"""Largest difference, per metre of reach, between poses by the written file and by the geometry."""
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
    RobotError: ``robot`` is another robot or not a URDF; a joint's origin that cannot be found in the text.
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
            raise InputError.of(what, fix="pass the file: `robot`, or --robot URDF")
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
        found = [element for element in elements if element.name == name]
        if len(found) != 1:
            what, expected = f"the joint '{name}' in the URDF of robot '{chain.name}'", "one <joint> with this name"
            raise RobotError.of(what, expected=expected, got=len(found), fix="pass its own URDF")
        edits += _origin_edits(content, found[0], origin)
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
    found: list[_Element] = []
    path: list[str] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        if path[1:] == ["joint"]:
            found.append(_Element(attributes.get("name", ""), parser.CurrentByteIndex))
        elif path[1:] == ["joint", "origin"] and found[-1].origin is None:
            found[-1].origin = parser.CurrentByteIndex

    def end(_: str) -> None:
        path.pop()

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise RobotError.of(f"the URDF is not well-formed XML ({error})", fix="pass a URDF file") from error
    return found


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
    while found := ATTRIBUTE.match(content, stop):
        places[found[1]] = slice(found.start(2) + 1, found.end(2) - 1)
        stop = found.end()
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
