"""Harmless faults of URDF files, which other programs load too, cause a warning; numbers without bounds do not pass."""

from __future__ import annotations

import os
import re
import warnings
from math import inf
from pathlib import Path

import pytest
import torch

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, RobotError
from diffeo_calib.robots import load_urdf

LINKS = '<link name="a"/><link name="b"/><link name="c"/>'


def joint(inside: str = "", kind: str = "revolute", name: str = "j", ends: str = "ab") -> str:
    parent, child = ends
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def robot(body: str, attributes: str = ' name="r"') -> str:
    return f"<robot{attributes}>{LINKS}{body}</robot>"


def turning(inside: str) -> str:
    """A robot of one joint, with more in it."""
    return robot(joint('<origin xyz="0 0 1"/><axis xyz="0 1 0"/>' + inside))


TURN = joint('<origin xyz="0 0 1"/><axis xyz="0 1 0"/>')
Q = torch.tensor([[0.3]], dtype=torch.float64)


def load(folder: Path, content: str | bytes, tip: str = "b") -> dc.Chain:
    file = folder / "r.urdf"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_urdf(file, "a", tip)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<?xml version="0.0" ?>' + robot(TURN), "ignored the version in its XML declaration"),
        ('<?xml version="1.1" ?>' + robot(TURN), "ignored the version in its XML declaration"),
        ('\n<?xml version="1.0" ?>' + robot(TURN), "ignored an XML declaration that is not at its very beginning"),
        (robot("<!-- a -- b -->" + TURN), "ignored two hyphens inside a comment"),
        (
            turning('<limit lower="1" upper="-1"/>'),
            r"the limits of joint 'j' \(lower 1, upper -1\); correct the file if",
        ),
        (turning('<limit lower="nan" upper="1"/>'), r"lower nan, upper 1"),
    ],
)
def test_harmless_faults_are_ignored_with_a_warning(content: str, message: str, tmp_path: Path) -> None:
    plain = load(tmp_path, robot(TURN))
    with pytest.warns(DiffeoCalibWarning, match=message):
        chain = load(tmp_path, content)
    assert torch.equal(chain(Q), plain(Q))
    assert chain.limits.tolist() == [[-inf, inf]]


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf" + robot(TURN).encode(),  # a byte order mark
        '<?xml version="1.0" encoding="utf-16"?>'.encode("utf-16") + robot(TURN).encode("utf-16-le"),
        robot(TURN, ' name="r" xmlns="http://drake.mit.edu" xmlns:xacro="http://www.ros.org/wiki/xacro"'),
        robot("<sensor:camera/><material name='m'/><material name='m'/><gazebo/><transmission/>" + TURN),
        turning('<limit lower="-inf" upper="inf"/>'),
        turning('<limit effort="1"/>'),
        robot(joint('<origin xyz="0 0 1"/><axis xyz="0 3e-200 0"/>')),  # its square is not representable
    ],
)
def test_what_is_read_without_a_word(content: str | bytes, tmp_path: Path) -> None:
    plain = load(tmp_path, robot(TURN))
    assert torch.equal(load(tmp_path, content)(Q), plain(Q))


def test_a_fixed_joint_that_mimics(tmp_path: Path) -> None:
    fixed = joint('<axis xyz="0 0 0"/><mimic joint="j"/><limit lower="1" upper="0"/>', "fixed", "k", "bc")
    with pytest.warns(DiffeoCalibWarning, match="ignored <mimic> of joint 'k', which is fixed") as caught:
        chain = load(tmp_path, robot(TURN + fixed), "c")
    assert len(caught) == 1
    assert chain.joint_names == ("j",)
    assert torch.equal(chain(Q), load(tmp_path, robot(TURN))(Q))


def test_faults_off_the_path_are_not_mentioned(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(tmp_path, robot(TURN + joint('<limit lower="1" upper="0"/>', "revolute", "k", "bc")))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (robot(joint('<axis xyz="0 0 0"/>')), "the axis of joint 'j': expected a non-zero vector"),
        (robot(joint('<axis xyz="0 inf 0"/>')), "xyz of <axis> of joint 'j'"),
        (robot(joint('<origin xyz="0 0 1e308"/>')), "the origin of joint 'j'"),
        (robot(joint('<origin xyz="1e400 0 0"/>')), "xyz of <origin> of joint 'j'"),
        (
            robot(TURN + joint('<mimic joint="j" multiplier="1e200"/>', "revolute", "k", "bc")),
            "the multiplier of 'j' in joint 'k': expected a number of at most 1e+06, got 1e+200",
        ),
        (robot(joint('<limit lower="${-pi}" upper="1"/>')), "expand the xacro file first"),
        (
            '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="x"/></robot>',
            "but macros that may make it; expand the xacro file first",
        ),
        (robot(TURN.replace('name="j"', 'name="j" name="k"')), "is not well-formed XML"),
        ('<robot name="r" xmlns="x"><links/></robot>', "has no link 'a'"),
    ],
)
def test_what_cannot_be_ignored_safely(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        load(tmp_path, content, "c" if "mimic" in content else "b")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device without an end")
def test_files_that_are_no_files(tmp_path: Path) -> None:
    for place in ("/dev/zero", tmp_path):
        with pytest.raises(RobotError, match=f"'{place}' is no file; check the path of the URDF"):
            load_urdf(place, "a", "b")
    large = tmp_path / "large.urdf"
    large.touch()
    os.truncate(large, 200_000_000)  # takes no space
    with pytest.raises(RobotError, match=r"too large for a URDF: expected at most 100 MB"):
        load_urdf(large, "a", "b")
    with pytest.warns(dc.DiffeoCalibWarning, match="inf m"), pytest.raises(InputError, match="the origin of joint"):
        dc.from_dh([(1e308, 0.0, 0.0)])
