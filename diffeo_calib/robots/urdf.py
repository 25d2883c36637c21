"""Robots from URDF files: a chain from base to tip, or a tree with several tips and loads."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import MOST_NAMES, InputError, RobotError, as_written, few, sentence, warn_user
from diffeo_calib.common.files import as_path, read_regular
from diffeo_calib.robots.joint import KINDS, Joint
from diffeo_calib.robots.tree import BASE, Chain, Ends, Tree, along
from diffeo_calib.robots.urdf_elements import LARGEST_FILE, URDF, JointElement, harmless_faults, joint_of

Names = str | Sequence[str]
MOVING = frozenset(KINDS) - {"fixed"}


@outside_inference_mode
def load_urdf(path: str | PathLike[str], base: str | None = None, tip: Names | None = None, load: Names = ()) -> Tree:
    """Read the robot between link ``base`` and link ``tip``; the poses are those of ``tip`` in ``base`` [m, rad].

    Base and tips may be any links, also on different branches (from hand to hand): joints between the base and the
    link that is common to their branches then move what is on the base's side. The joints are those on the paths from
    the base to all tips and loads. A joint with <mimic> is driven by the joint that it names; where this one is not on
    these paths, its value is still a column of ``q``. Other joints may be of any kind. Meshes are not read.

    Args:
        path: the URDF file (expand xacro files first).
        base: name of a link; by default the first one.
        tip: name of a link, or names of several; with several, ``robot(q)`` is (N, tips, 4, 4). By default the last
            link, if the file has a single one.
        load: names of links at which nothing is measured, but whose weight bends the robot, such as the other arm's
            hand. Gravity is constant in the link that is nearest to the root of the file on the paths: where that link
            turns in turn, name the root as a load as well.

    Returns:
        A :class:`Chain` if one tip is below the base and there is no load, else a :class:`Tree`.

    Raises:
        RobotError: file missing, larger than 100 MB or not a URDF; unknown links, or links that are not connected; no
            moving joint between base and tip; a floating or planar joint between them; a joint that mimics an unknown
            one; an axis of length zero.
        InputError: no tip, or one name twice.

    Warns:
        DiffeoCalibWarning: harmless faults that are ignored: lower limits above upper ones (PyBullet's files write a
            joint without limits like this), <mimic> of a fixed joint, an odd XML declaration; joints on the way to the
            tip that carry other branches, whose weight is left out.
    """
    path = as_path(path)
    content = read_regular(path, "URDF", LARGEST_FILE, RobotError)
    robot, urdf, steps = _read(content, path, base, tip, load)
    ignored = urdf.ignored + [fault for step in steps for fault in harmless_faults(step.joint)]
    if ignored:
        warn_user(sentence(f"'{path}': ignored {few(ignored, MOST_NAMES)}", fix="correct the file if this is wrong"))
    _warn_of_branches(urdf, robot, steps)
    return robot


def read_urdf(content: bytes, base: str, tip: Names, path: Path, load: Names = ()) -> Tree:
    """As :func:`load_urdf`, from the content of a file, without warnings; ``path`` is its name in messages."""
    return _read(content, path, base, tip, load)[0]


def moving_joints_below(content: bytes, links: Iterable[str]) -> list[tuple[str, str]]:
    """Names and child links of the moving joints below links of a URDF, the nearest first."""
    joints = URDF.parse(content, Path("the URDF")).joints
    moving, reached = [], set(links)
    while below := [joint for joint in joints if joint.parent in reached and joint.child not in reached]:
        reached |= {joint.child for joint in below}
        moving += [(joint.name, joint.child) for joint in below if joint.kind != "fixed" and joint.driver is None]
    return moving


def chains_in(path: Path) -> list[list[JointElement]]:
    """The joints of every path from the root of a URDF to a leaf.

    Raises RobotError: file missing, larger than 100 MB or not a URDF, one with macros, or a link with two parents.
    """
    urdf = URDF.parse(read_regular(path, "URDF", LARGEST_FILE, RobotError), path)
    urdf.check_whole("tip")
    above, parents = _parents(urdf), {joint.parent for joint in urdf.joints}
    leaves = [joint.child for joint in urdf.joints if joint.child not in parents]
    return [[step.joint for step in reversed(_climb(urdf, above, leaf))] for leaf in leaves]


def _only_end(urdf: URDF, role: str) -> str:
    """The link before, or behind, all others."""
    inner = {joint.parent if role == "tip" else joint.child for joint in urdf.joints}
    ends = [link for link in urdf.links if link not in inner]
    if len(ends) == 1:
        return ends[0]
    urdf.check_whole(role)
    got, fix = few(ends, MOST_NAMES) or "none", "name the one that is meant; `diffeo-calib init` proposes it"
    raise RobotError.of(f"`{role}` of '{urdf.path}'", expected="one link at this end", got=got, fix=fix)


def _names(what: str, given: Names) -> tuple[str, ...]:
    """One name or several, checked."""
    names = (given,) if isinstance(given, str) else tuple(given)
    if not all(isinstance(name, str) for name in names) or (what == "tip" and not names):
        raise InputError.of(f"`{what}`", expected="the name of a link, or a list of names", got=as_written(given))
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError.of(f"`{what}` names {twice} twice", fix="name every link once")
    return names


class _Step(NamedTuple):
    """A joint on the way from the base, from one of its links to the other: down to its child, or up to its parent."""

    joint: JointElement
    start: str
    end: str

    @property
    def up(self) -> bool:
        return self.end == self.joint.parent


def _read(
    content: bytes, path: Path, base: str | None, tip: Names | None, load: Names
) -> tuple[Tree, URDF, list[_Step]]:
    """The robot between links, its file, and the steps from the base to all tips and loads; every joint once.

    Raises RobotError: unknown links, links that are not connected, a link with two parents.
    """
    urdf = URDF.parse(content, path)
    tips = _names("tip", _only_end(urdf, "tip") if tip is None else tip)
    base, loads = _only_end(urdf, "base") if base is None else base, _names("load", load)
    for role, names in (("base", (base,)), ("tip", tips), ("load", loads)):
        for name in names:
            urdf.check_link(role, name)
    if both := sorted(set(tips) & set(loads)):
        raise InputError.of(f"`load` names {both}, which `tip` names too", fix="leave tips out of the loads")
    above, passed = _parents(urdf), dict[str, _Step]()
    for end in (*tips, *loads):
        for step in _way(urdf, above, base, end):
            passed.setdefault(step.joint.child, step)  # names may be given twice, which the robot refuses
    steps = list(passed.values())
    top = [base, *(step.end for step in steps if step.up)][-1]  # nearest to the root, where gravity is constant
    joints, parents, last = along([(joint_of(step.joint, path), step.start, step.end, step.up) for step in steps], base)
    given = {"drivers": _drivers(urdf, joints), "source": content.decode("utf-8", "surrogateescape")}
    if len(tips) == 1 and not loads and top == base:
        return Chain(urdf.name, base, tips[0], joints, **given), urdf, steps
    places, weights = ({link: last[link] for link in links} for links in (tips, loads))
    if top != base:
        weights[base] = BASE  # it moves as seen from the ground
    return Tree(urdf.name, base, joints, parents, Ends(places, weights, last[top]), **given), urdf, steps


def _parents(urdf: URDF) -> dict[str, JointElement]:
    """The joint above every link."""
    above: dict[str, JointElement] = {}
    for joint in urdf.joints:
        if joint.child in above:
            both = f"'{above[joint.child].name}' and '{joint.name}'"
            what = f"link '{joint.child}' in '{urdf.path}' has two parent joints ({both})"
            raise RobotError.of(what, fix="a URDF is a tree: every link has one parent")
        above[joint.child] = joint
    return above


def _climb(urdf: URDF, above: dict[str, JointElement], link: str) -> list[_Step]:
    """The steps from a link up to the root of the file."""
    steps: list[_Step] = []
    while link in above:
        steps.append(_Step(above[link], link, above[link].parent))
        link = above[link].parent
        if len(steps) > len(urdf.joints):
            passed = " <- ".join([step.start for step in steps][: len(urdf.joints) + 1])
            what, fix = f"joints of '{urdf.path}' make a loop", "correct the file"
            raise RobotError.of(what, got=f"the path {passed}", fix=fix)
    return steps


def _way(urdf: URDF, above: dict[str, JointElement], base: str, end: str) -> list[_Step]:
    """The steps from the base up to the first link that is also above ``end``, and from there down to it."""
    up, down = _climb(urdf, above, base), _climb(urdf, above, end)
    reached, passed = ([link, *(step.end for step in steps)] for link, steps in ((base, up), (end, down)))
    common = next((link for link in reached if link in passed), None)
    if common is None:
        roots = f"'{base}' below '{reached[-1]}', '{end}' below '{passed[-1]}'"
        what = f"links '{base}' and '{end}' are not connected in '{urdf.path}'"
        raise RobotError.of(what, got=roots, fix="choose links of one robot")
    back = reversed(down[: passed.index(common)])
    return [*up[: reached.index(common)], *(_Step(step.joint, step.end, step.start) for step in back)]


def _drivers(urdf: URDF, joints: Sequence[Joint]) -> list[Joint]:
    """Joints off the paths that drive mimic joints, and those that drive these."""
    elements, names = {joint.name: joint for joint in urdf.joints}, {joint.name for joint in joints}
    drivers: list[Joint] = []
    waiting = [name for joint in joints for name in joint.mimic or {}]
    while waiting:
        name = waiting.pop(0)
        if name not in names and name in elements:
            names.add(name)
            drivers.append(joint_of(elements[name], urdf.path))
            waiting += list(drivers[-1].mimic or {})
    return drivers


def _warn_of_branches(urdf: URDF, robot: Tree, steps: Sequence[_Step]) -> None:
    """Warn if joints hang on moving links before the tips and are left out: their weight bends the robot."""
    above, passed, bodies = _parents(urdf), {step.joint.name for step in steps}, dict[str, str]()

    def body(link: str) -> str:
        """The topmost link that is fixed to a link."""
        way = list[str]()  # links may make a loop
        while link not in bodies and link in above and above[link].kind == "fixed" and len(way) < len(above):
            way.append(link)
            link = above[link].parent
        bodies.update(dict.fromkeys((*way, link), bodies.get(link, link)))
        return bodies[link]

    top = [step.end for step in steps if step.up][-1:]
    carried = {body(step.end) for step in steps} - {body(link) for link in (robot.base, *robot.ends, *top)}
    hanging = [joint for joint in urdf.joints if joint.name not in passed and body(joint.parent) in carried]
    left_out = [joint for joint in hanging if joint.kind in MOVING and joint.driver not in passed]
    if left_out:
        names = few([f"'{joint.name}'" for joint in left_out], MOST_NAMES)
        what = f"'{urdf.path}': joints that hang on links between '{robot.base}' and '{robot.tip}' are "
        what += f"left out: {names}; where they move, their weight bends the robot in ways that its model does not know"
        loads = [*(load for load in robot.loads if load != robot.base), *(_farthest(urdf, joint) for joint in left_out)]
        fix = f"pass load={loads} (on the command line --load) if the measurements have their values"
        warn_user(sentence(what, fix=fix))


def _farthest(urdf: URDF, joint: JointElement) -> str:
    """The link below a joint that most moving joints lead to."""
    reached = [(1, 1, joint.child)]  # moving joints and links on the way
    for moving, links, link in reached:
        below = [(moving + (j.kind != "fixed"), links + 1, j.child) for j in urdf.joints if j.parent == link]
        reached += [child for child in below if child not in reached]
    return max(reached)[2]
