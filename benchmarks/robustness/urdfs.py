"""Fuzzing of robot descriptions: elements, attributes, numbers and bytes of a URDF that are wrong in one or two ways.

    python benchmarks/robustness/urdfs.py --count 2000

An accepted file must give finite poses that are rigid, and the forward kinematics that Pinocchio finds in the same file
where Pinocchio loads it; where it does not, those of the unchanged file if the mutation touches no kinematics.
"""

from __future__ import annotations

import copy
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from fuzzing import Work, run

import diffeo_calib as dc

BASE, TIP, CONFIGURATIONS, TOLERANCE = "base", "tip", 5, 1e-9
ROBOT = f"""<?xml version="1.0"?>
<robot name="fuzzed">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="{BASE}"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
  <link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/><link name="{TIP}"/><link name="jaw"/>
  <joint name="pan" type="revolute"><parent link="{BASE}"/><child link="a"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.1 0.2 -0.3"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/><dynamics damping="0.1"/></joint>
  <joint name="tilt" type="continuous"><parent link="a"/><child link="b"/>
    <origin xyz="0 0.4 0" rpy="1.5707963267948966 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/>
    <origin xyz="0.05 0 0.1" rpy="0 0 0.7"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.5" effort="1" velocity="1"/></joint>
  <joint name="weld" type="fixed"><parent link="c"/><child link="d"/><origin xyz="0 0 0.2" rpy="0 -0.4 0"/></joint>
  <joint name="roll" type="revolute"><parent link="d"/><child link="e"/>
    <origin xyz="0.3 0 0"/><axis xyz="0.6 0 0.8"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="flange" type="fixed"><parent link="e"/><child link="{TIP}"/>
    <origin xyz="0 0.1 0.05" rpy="0 0 3.0"/></joint>
  <joint name="grip" type="prismatic"><parent link="{TIP}"/><child link="jaw"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.05" effort="1" velocity="1"/><mimic joint="slide" multiplier="0.5" offset="0"/></joint>
  <transmission name="drive"><joint name="pan"/></transmission>
</robot>
"""
Rng = np.random.Generator
etree: Any = import_module("lxml.etree")  # compiled, without type stubs

ODD_TEXTS = (
    *(
        "",
        " ",
        "nan",
        "inf",
        "-inf",
        "1e308",
        "1e200",
        "-1e-320",
        "abc",
        "0",
        "0 0 0",
        "1 2",
        "1 2 3 4",
        "1,2,3",
        "0x10",
    ),
    *(
        "${x}",
        "$(arg y)",
        "１ ２ ３",
        "1_0 0 0",
        "9" * 500,
        "0 0 1e-30",
        "0 0 1e300",
        "3 4 5",
        "-1 0 0",
        "1e-8 0 0",
        "\t1 0 0\n",
    ),
    *("pan", "base", "tip", "a", "revolute", "fixed", "floating", "planar", "ball", "Revolute", "é", "\x7f", "1e9 0 0"),
)


def _pick(rng: Rng, items: Any) -> Any:
    return items[int(rng.integers(len(items)))]


def odd_attribute(root: Any, rng: Rng) -> None:
    """An attribute with a value that is strange."""
    element = _pick(rng, [one for one in root.iter("*") if one.attrib])
    element.set(_pick(rng, list(element.attrib)), _pick(rng, ODD_TEXTS))


def odd_number(root: Any, rng: Rng) -> None:
    """One number of an attribute: another number."""
    places = [(e, k) for e in root.iter("origin", "axis", "limit", "mimic") for k in e.attrib if k != "joint"]
    element, key = _pick(rng, places)
    words = element.get(key).split()
    words[int(rng.integers(len(words)))] = _pick(
        rng, ("0", "-1", "7.5", "1e-3", "1e6", "1e15", "-3.14159", "nan", "1e400", "x")
    )
    element.set(key, " ".join(words))


def missing_attribute(root: Any, rng: Rng) -> None:
    """An attribute that is not there."""
    element = _pick(rng, [one for one in root.iter("*") if one.attrib])
    del element.attrib[_pick(rng, list(element.attrib))]


def missing_element(root: Any, rng: Rng) -> None:
    """An element that is not there."""
    element = _pick(rng, list(root.iter("*"))[1:])
    element.getparent().remove(element)


def repeated_element(root: Any, rng: Rng) -> None:
    """An element that is there twice, or also at another place."""
    element = _pick(rng, list(root.iter("*"))[1:])
    place = element.getparent() if rng.random() < 0.5 else _pick(rng, list(root.iter("*")))
    place.append(copy.deepcopy(element))


def renamed_element(root: Any, rng: Rng) -> None:
    """An element under another tag."""
    _pick(rng, list(root.iter("*"))).tag = _pick(
        rng, ("joint", "link", "axis", "origin", "robot", "x", "Joint", "mimic")
    )


def swapped_links(root: Any, rng: Rng) -> None:
    """Joints between other links: circles, two parents, loose ends."""
    end = _pick(rng, list(root.iter("parent", "child")))
    end.set("link", _pick(rng, [link.get("name") for link in root.iter("link") if link.get("name")] or ["a"]))


def other_kind(root: Any, rng: Rng) -> None:
    """A joint of another kind."""
    _pick(rng, root.findall("joint")).set(
        "type", _pick(rng, ("revolute", "continuous", "prismatic", "fixed", "floating", ""))
    )


def mimic(root: Any, rng: Rng) -> None:
    """A joint that mimics another one, itself, or none."""
    joint = _pick(rng, root.findall("joint"))
    driver = _pick(rng, ("pan", "tilt", "slide", "roll", "weld", "grip", "nobody", ""))
    etree.SubElement(
        joint, "mimic", joint=driver, multiplier=_pick(rng, ("1", "-0.5", "0", "1e300", "x")), offset="0.1"
    )


def remarks(root: Any, rng: Rng) -> None:
    """Comments, texts, unknown elements: harmless."""
    element = _pick(rng, list(root.iter("*")))
    how = int(rng.integers(4))
    if how == 0:
        element.append(etree.Comment(" a comment "))
    elif how == 1:
        etree.SubElement(element, "gazebo", reference="a")
    elif how == 2:
        element.tail = " words "
    else:
        element.set("unknown", "1")


HARMLESS = (remarks,)
MUTATIONS = (
    *(odd_attribute, odd_attribute, odd_number, odd_number, missing_attribute, missing_element, repeated_element),
    *(renamed_element, swapped_links, other_kind, mimic, remarks),
)


def broken_text(content: bytes, rng: Rng) -> bytes:
    """Bytes that are flipped, cut off or put in; deep nesting; entities; another encoding."""
    place = int(rng.integers(len(content)))
    bomb = b"".join(b'<!ENTITY e%d "%s">' % (k, b"&e%d;" % (k - 1) * 10 if k else b"ha") for k in range(9))
    secret = b'<!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/hostname">]><robot'
    encoding = f' encoding="{_pick(rng, ("UTF-16", "latin-1", "nonsense"))}"?>'
    changes = (
        content[:place],
        content[:place] + bytes([int(rng.integers(256))]) + content[place + 1 :],
        content.replace(b"</robot>", b"<x>" * 3000 + b"</x>" * 3000 + b"</robot>"),
        content.replace(b"<robot", b"<!DOCTYPE robot [" + bomb + b"]><robot", 1).replace(b'"fuzzed"', b'"&e8;"'),
        content.replace(b"<robot", secret, 1).replace(b'"fuzzed"', b'"&f;"'),
        content.decode().replace("?>", encoding, 1).encode("utf-16"),
        content[:place] + content[place:][::-1],
    )
    return _pick(rng, changes)


def mutated(seed: int) -> tuple[str, bytes, bool]:
    """Names of the mutations, the file, and whether its kinematics are as before."""
    rng = np.random.default_rng([seed, 1])
    root, names, harmless = etree.fromstring(ROBOT.encode()), [], True
    for _ in range(1 + int(rng.integers(2))):
        mutation = _pick(rng, MUTATIONS)
        try:
            mutation(root, rng)
        except ValueError:  # XML cannot hold this value
            continue
        names.append(mutation.__name__)
        harmless &= mutation in HARMLESS
    content = etree.tostring(root, xml_declaration=True, encoding="UTF-8")
    if rng.random() < 0.2:
        return " and ".join([*names, "broken_text"]), broken_text(content, rng), False
    return " and ".join(names) or "none", content, harmless


@cache
def unchanged() -> dc.Chain:
    """The robot of the unchanged file."""
    return loaded(ROBOT.encode())


def loaded(content: bytes) -> dc.Chain:
    """The chain in a file with this content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_bytes(content)
        return dc.load_urdf(path, BASE, TIP)


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Nothing that compiled code writes to standard error is seen."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def pinocchio_poses(content: bytes, chain: dc.Chain, q: np.ndarray) -> np.ndarray | None:
    """Poses (N, 4, 4) of the tip in the base by Pinocchio; None where it does not load the file."""
    pin = import_module("pinocchio")  # the tests' second opinion, not a dependency

    try:
        with silent_stderr():
            model = pin.buildModelFromXML(content.decode())
    except (ValueError, RuntimeError, UnicodeDecodeError, IndexError):
        return None
    if not (model.existFrame(BASE) and model.existFrame(TIP)):
        return None
    data, poses = model.createData(), []
    for row in q:
        values = chain.moving_values(torch.from_numpy(row[None]))[0].numpy()
        at = pin.neutral(model)
        for name, value in zip(chain.moving_names, values, strict=True):
            if not model.existJointName(name):
                return None
            joint = model.joints[model.getJointId(name)]
            at[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        pin.framesForwardKinematics(model, data, at)
        base, tip = (data.oMf[model.getFrameId(name)] for name in (BASE, TIP))
        poses.append((base.inverse() * tip).homogeneous)
    return np.stack(poses)


def tried(content: bytes, harmless: bool) -> str:
    """Load the file and compare its kinematics; what is wrong with them, or nothing."""
    chain = loaded(content)
    q = np.random.default_rng(0).uniform(-1, 1, (CONFIGURATIONS, chain.n))
    poses = chain(torch.from_numpy(q)).numpy()
    if not np.isfinite(poses).all() or not np.isfinite(chain.jacobian(torch.from_numpy(q)).numpy()).all():
        return "poses that are not finite"
    if np.abs(poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2) - np.eye(3)).max() > TOLERANCE:
        return "rotations that are none"
    expected = pinocchio_poses(content, chain, q)
    if expected is None and harmless:
        expected = unchanged()(torch.from_numpy(q)).numpy()
    if expected is None:
        return ""
    away = np.abs(poses - expected).max() / max(1.0, np.abs(expected).max())
    return f"poses differ by {away:.2g}" if away > TOLERANCE else ""


def case(seed: int) -> tuple[str, Work]:
    """The file of a seed."""
    name, content, harmless = mutated(seed)
    return name, lambda: tried(content, harmless)


if __name__ == "__main__":
    run("urdfs.py", case, __doc__, 2000)
