"""Random measurements, patterns of messages, and conventions of rotations that the tests of tables share."""

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from diffeo_calib.common.errors import DiffeoCalibError
from diffeo_calib.measurements.csv.files import read_observations
from diffeo_calib.measurements.poses import transforms
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat

T = TypeVar("T")
Reader = Callable[..., Measurements]
JOINTS, POSITION = ["q1", "q2"], ["x", "y", "z"]
HEADER = "q1,q2,x,y,z\n"
ROWS = "0.1,0.2,1.0,2.0,3.0\n0.3,0.4,1.5,2.5,3.5\n"
ORDERS = [a + b + c for axes in ("xyz", "XYZ") for a in axes for b in axes for c in axes if b not in (a, c)]
CONVENTIONS = ["rotvec", "quat_xyzw", "quat_wxyz", "matrix", *ORDERS]


def some(rows: int, n: int = 2, markers: int = 1, seed: int = 0) -> Measurements:
    """Distinct random measurements."""
    rng = np.random.default_rng(seed)
    return Measurements(rng.uniform(-3, 3, (rows, n)), rng.uniform(-2, 2, (rows, markers, 3)))


def read_table(path: Path, joints: Any, position: Any, table: TableFormat, **how: Any) -> Measurements:
    """Positions or poses in a format; options are those of the columns, and duplicates."""
    duplicates = how.pop("duplicates", "error")
    return read_observations(path, replace(table, joints=joints, position=position, **how), duplicates=duplicates)


def random_rotations(count: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(Rotation.from_quat(np.random.default_rng(seed).normal(size=(count, 4))).as_matrix())


def random_poses(count: int, seed: int = 0) -> Tensor:
    shifts = np.random.default_rng(seed).uniform(-2, 2, (count, 3))
    return transforms(random_rotations(count, seed), torch.from_numpy(shifts))


def held(tensor: Tensor | None) -> Tensor:
    """A tensor that must be there."""
    assert tensor is not None
    return tensor


def refused(*cases: tuple[str, Callable[[], object]]) -> None:
    """Each call raises an error of the package whose message matches."""
    for message, call in cases:
        with pytest.raises(DiffeoCalibError, match=message):
            call()


def warned(call: Callable[..., T], *arguments: Any, **options: Any) -> tuple[T, list[str]]:
    """What a call returns, and the warnings on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call(*arguments, **options)
    return found, [str(one.message) for one in caught]


def says(*parts: str) -> str:
    """Pattern of a message that holds all parts, in any order."""
    return "(?s)" + "".join(f"(?=.*{re.escape(part)})" for part in parts)


def in_order(text: str) -> str:
    """Pattern of a message that holds the parts between " ... " one after another."""
    return ".*".join(map(re.escape, text.split(" ... ")))
