"""Model files that earlier versions wrote: the same predictions, to rounding.

The files in data/ were written at commit 29d55d1, before the package had its present folders and names.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import diffeo_calib as dc
from diffeo_calib.robots import elastic_rr

DATA = Path(__file__).parent / "data"


@pytest.fixture
def expected() -> dict[str, Any]:
    return json.loads((DATA / "format_3.json").read_text(encoding="utf-8"))


def test_a_robot(expected: dict[str, Any]) -> None:
    model, said = dc.load(DATA / "robot_format_3.safetensors"), expected["robot"]
    assert isinstance(model, dc.CalibratedKinematics)
    for found, value in zip(model.predict(said["q"]), (said["mean"], said["covariance"]), strict=True):
        torch.testing.assert_close(found, torch.tensor(value, dtype=torch.float64), rtol=1e-9, atol=1e-13)
    assert model.report == said["report"]
    assert model.summary is not None
    assert model.summary.rows == 20


def test_a_map_with_control_points(expected: dict[str, Any]) -> None:
    model, said = dc.load(DATA / "map_format_3.safetensors", elastic_rr.nominal), expected["map"]
    x, y = (torch.tensor(said[name], dtype=torch.float64) for name in ("x", "y"))
    torch.testing.assert_close(model(x), y, rtol=0, atol=1e-13)
    assert len(model.x) == 16  # pyright: ignore[reportAttributeAccessIssue]


def test_saved_again_it_is_the_same_file(expected: dict[str, Any], tmp_path: Path) -> None:
    dc.save(dc.load(DATA / "robot_format_3.safetensors"), tmp_path / "again")
    again = dc.load(tmp_path / "again")
    q = torch.tensor(expected["robot"]["q"], dtype=torch.float64)
    assert torch.equal(again(q), dc.load(DATA / "robot_format_3.safetensors")(q))
