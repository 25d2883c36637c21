"""Residuals of tables of every kind, and the pictures of their reports."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import Command
from kind_bank import FREE, UNITS, kind_named, marked

import diffeo_calib as dc
from diffeo_calib.kinematics.evaluation import place, residuals

DRAWN = ("positions", "ball in sockets", "images")
"""Kinds whose pictures differ."""


@pytest.mark.parametrize("name", marked())
def test_residuals_are_measured_minus_predicted(name: str) -> None:
    """Their sizes are the errors, and every row has as many as its table says."""
    kind = kind_named(name)
    data: Any = kind.source.rows
    found = residuals(kind.model, place(kind.model, data), data)
    assert sum(map(len, found.index.values())) == len(data)
    for one in found.values():
        assert one.away is not None
        torch.testing.assert_close(one.away.norm(dim=-1), one.errors, equal_nan=True)
    half = torch.arange(len(data)) % 2 == 0
    some = found.rows(half)
    assert sum(len(one.errors) for one in some.values()) == int(half.sum())
    lines = list(found.lines())
    assert [entry["row"] for entry in lines] == sorted(entry["row"] for entry in lines)


@pytest.mark.parametrize("name", marked(*DRAWN))
def test_a_drawn_report(name: str, tmp_path: Path) -> None:
    """Errors of each kind by stage, in its unit; tests/test_matrix.py leaves those of all kinds undrawn."""
    kind, path = kind_named(name), tmp_path / "page.html"
    dc.write_report(kind.model, path, kind.data if name in FREE else kind.new)
    text = path.read_text()
    for heading in ("How good", "Where", "Why", "Can I trust it", "Repeatability", "Record"):
        assert f">{heading}</h2>" in text
    for caption in ("Expected error of positions by stage", "Where to measure next", "Geometry corrections"):
        assert caption in text
    assert ("No position was measured" in text) == (name in FREE)
    assert ("RMS [px]" in text) == (name == "images")


@pytest.mark.parametrize("name", marked("hidden markers", "mixture"))
def test_commands_expect_the_same_error(name: str, command: Command, tmp_path: Path) -> None:
    kind, out = kind_named(name), tmp_path / "out"
    table, options = kind.table("new")
    found = {
        name: command(verb, *given, "--json", tmp_path / name)
        for name, (verb, *given) in {
            "evaluate": ("evaluate", kind.file, table, *options),
            "report": ("evaluate", kind.file, "--report", out),
            "plan": ("plan", kind.file, *UNITS, "-n", 3, "--draw", 50, "--sensor", "tracker", "-o", out),
        }.items()
    }
    expected = kind.result.expected
    for verb, done in found.items():
        assert done.code == 0, done.err
        numbers = json.loads((tmp_path / verb).read_text())["results"]["expected_error"]
        assert numbers["expected_error_m"] == pytest.approx(expected.workspace, rel=1e-6)
        assert numbers["with_open_places_m"] == pytest.approx(expected.whole, rel=1e-6)
