"""Public robots with branches: forward kinematics of all pairs of leaves against pinocchio.

    python benchmarks/robustness/branched_urdfs.py FOLDER --out urdfs.json

FOLDER is searched for URDF files, such as those of the Python packages pybullet (its pybullet_data) and
example-robot-data, unpacked. A robot is branched if moving joints lead to more than one leaf. From every leaf, poses
of all other leaves are computed at random configurations and compared with pinocchio (`pip install pin`).

Fields of a record: `outcome` is "agrees", "differs", "refused" (by this package, with the reason) or "skipped"
(pinocchio cannot read it, or it reads a joint in another way); `joints` and `leaves` are their numbers, `pairs` those
that were compared, `largest` the largest difference of a matrix entry, in m or as it is.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import random
import warnings
from argparse import Namespace
from collections import Counter
from collections.abc import Iterator

import harness
import numpy as np
import pinocchio as pin
import torch
from harness import Record

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots.urdf import read_urdf
from diffeo_calib.robots.urdf_elements import URDF

ROWS = 3
MOST_BASES = 6
"""Leaves from which a robot is seen."""
MOST_LEAVES = 24
TOLERANCE = 1e-12
COLUMNS = ("file", "joints", "leaves", "pairs", "outcome", "largest", "note")


def leaves_of(urdf: URDF) -> list[str]:
    """Last links of the branches that move: those below at least one moving joint."""
    above, parents = {joint.child: joint for joint in urdf.joints}, {joint.parent for joint in urdf.joints}
    found = []
    for link in urdf.links:
        if link in parents or link not in above:
            continue
        moving, at = 0, link
        while at in above and moving <= len(urdf.joints):
            moving += above[at].kind != "fixed"
            at = above[at].parent
        found += [link] if moving else []
    return found


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every branched robot."""
    seen = set()
    for path in sorted(plan.folder.rglob("*.urdf")):
        content = path.read_bytes()
        if content in seen:
            continue
        seen.add(content)
        try:
            urdf = URDF.parse(content, path)
        except InputError as error:
            yield {"file": path.name, "outcome": "refused", "note": str(error)}
            continue
        moving, leaves = sum(joint.kind != "fixed" for joint in urdf.joints), leaves_of(urdf)
        if len(leaves) < 2:
            continue
        record: Record = {"file": str(path.relative_to(plan.folder)), "joints": moving, "leaves": len(leaves)}
        yield record | compared(content, path, leaves)


def compared(content: bytes, path: Path, leaves: list[str]) -> Record:
    """Poses of leaves in one another, against pinocchio."""
    draw = random.Random(0)
    leaves = leaves if len(leaves) <= MOST_LEAVES else sorted(draw.sample(leaves, MOST_LEAVES))
    try:
        model = pin.buildModelFromXML(content.decode("utf-8", "replace"))
    except Exception as error:  # whatever it throws
        return {"outcome": "skipped", "note": f"pinocchio: {str(error).splitlines()[0][:80]}"}
    largest, pairs = 0.0, 0
    for base in leaves[:MOST_BASES]:
        try:
            tips = [leaf for leaf in leaves if leaf != base and not rigid(content, base, leaf, path)]
            if not tips:
                continue
            robot = read_urdf(content, base, tips, path)
        except InputError as error:
            return {"outcome": "refused", "note": str(error)}
        q = torch.rand(ROWS, robot.n, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
        for row, poses in zip(q, robot.tip_poses(q), strict=True):
            values = dict(zip(robot.joint_names, row.tolist(), strict=True))
            values |= dict(zip(robot.moving_names, robot.moving_values(row[None])[0].tolist(), strict=True))
            places = pinocchio_places(model, values, [base, *tips])
            expected = np.linalg.inv(places[0]) @ np.array(places[1:])
            largest, pairs = max(largest, float(np.abs(expected - poses.numpy()).max())), pairs + len(tips)
    outcome = "agrees" if largest <= TOLERANCE else "differs"
    return {"outcome": outcome, "pairs": pairs, "largest": largest, "note": ""}


def rigid(content: bytes, base: str, leaf: str, path: Path) -> bool:
    """Whether no joint moves one link in the other."""
    try:
        read_urdf(content, base, leaf, path)
    except InputError as error:
        if "no moving joint" not in str(error):
            raise
        return True
    return False


def pinocchio_places(model: pin.Model, values: dict[str, float], links: list[str]) -> list[np.ndarray]:
    """Poses of links in the world."""
    data, configuration = model.createData(), pin.neutral(model)
    for name, value in values.items():
        joint = model.joints[model.getJointId(name)]
        turning = joint.nq == 2  # a continuous joint is a point of the circle
        configuration[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if turning else [value]
    pin.framesForwardKinematics(model, data, configuration)
    return [data.oMf[model.getFrameId(link, pin.FrameType.BODY)].homogeneous for link in links]


def run(plan: Namespace) -> None:
    """Compare, and count the outcomes."""
    warnings.simplefilter("ignore")
    records = harness.report(measure(plan), plan.out, COLUMNS)
    print(dict(Counter(record["outcome"] for record in records)))


def arguments() -> Namespace:
    """Parse the command line."""
    parser = harness.parser(__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    return parser.parse_args()


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
