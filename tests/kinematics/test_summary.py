"""The summary of a calibration: as a dictionary, from dictionaries of every age, and in model files."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from math import inf, isnan, nan
from pathlib import Path
from typing import Any

import pytest
from product_bank import Case
from safetensors import safe_open

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.provenance import Summary

SUMMARY = Summary(
    registration_rms=8e-4,
    geometry_rms=4e-4,
    diffeomorphic_rms=6e-5,
    leave_one_out_rms=1.1e-4,
    outliers=2,
    noise_degrees_of_freedom=7.5,
    coupling_residual=1e-6,
    end_residual=2e-6,
    energy=640.0,
    status="converged",
    scales="given",
    rows=60,
    parts={"geometry": 3e-4, "task space": 1e-5},
    effective_parameters=88.0,
)
ENTRIES = {
    "registration rms [m]": 8e-4,
    "geometry rms [m]": 4e-4,
    "diffeomorphic rms [m]": 6e-5,
    "leave-one-out rms [m]": 1.1e-4,
    "outliers": 2,
    "noise degrees of freedom": 7.5,
    "coupling residual": 1e-6,
    "end residual": 2e-6,
    "energy": 640.0,
    "status": "converged",
    "scales": "given",
    "rows": 60,
    "geometry [m]": 3e-4,
    "task space [m]": 1e-5,
    "effective parameters": 88.0,
}
"""As model files of version 3 hold them."""


def test_entries_are_named_with_their_units() -> None:
    assert list(SUMMARY.to_dict().items()) == list(ENTRIES.items())
    assert Summary.from_dict(ENTRIES) == SUMMARY


def test_gaussian_noise_and_what_is_unknown() -> None:
    gaussian = replace(SUMMARY, noise_degrees_of_freedom=inf, effective_parameters=None)
    entries = gaussian.to_dict()
    assert entries["noise degrees of freedom"] == "infinite"
    assert "effective parameters" not in entries
    assert Summary.from_dict(json.loads(json.dumps(entries))) == gaussian
    coarse = Summary.from_dict(replace(SUMMARY, coupling_residual=nan).to_dict())
    assert isnan(coarse.coupling_residual)


def test_the_first_files_of_version_3_knew_less() -> None:
    old = {k: v for k, v in ENTRIES.items() if k not in ("noise degrees of freedom", "effective parameters")}
    found = Summary.from_dict(old)
    assert found == replace(SUMMARY, noise_degrees_of_freedom=None, effective_parameters=None)
    assert found.to_dict() == old


@pytest.mark.parametrize("name", ["outliers", "energy", "status", "scales", "rows"])
def test_a_missing_entry_is_named(name: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"the summary has no entry '{name}'")):
        Summary.from_dict({k: v for k, v in ENTRIES.items() if k != name})


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("rows", 60.0, "a whole number, got 60.0"),
        ("rows", True, "a whole number, got True"),
        ("energy", "much", "a number, got 'much'"),
        ("energy", None, "a number, got None"),
        ("geometry [m]", "0.1", "a number, got '0.1'"),
        ("status", 3, "text, got 3"),
    ],
)
def test_a_wrong_value_is_explained(name: str, value: Any, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        Summary.from_dict(ENTRIES | {name: value})
    assert str(caught.value) == f"the entry {name!r} of the summary: expected {expected}."


def test_an_unknown_entry_is_named() -> None:
    with pytest.raises(InputError, match=r"an entry of the summary: expected coupling residual, .* got 'note'"):
        Summary.from_dict(ENTRIES | {"note": "mine"})


def header(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["diffeo_calib"])


@pytest.mark.parametrize(
    "summary", [SUMMARY, replace(SUMMARY, noise_degrees_of_freedom=None, effective_parameters=None), None]
)
def test_a_model_file_holds_the_summary(summary: Summary | None, arm: Case, tmp_path: Path) -> None:
    """Format version 3: readers of any age find the entries they know."""
    path = tmp_path / "model.safetensors"
    dc.save(dc.CalibratedKinematics(arm.robot, arm.model.map, summary), path)
    assert header(path)["format"] == 3
    assert header(path)["report"] == ({} if summary is None else summary.to_dict())
    again = dc.load(path)
    assert isinstance(again, dc.CalibratedKinematics)
    assert again.summary == summary
    assert again.report == ({} if summary is None else summary.to_dict())
