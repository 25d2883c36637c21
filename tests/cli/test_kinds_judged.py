"""Tables of every kind judged by every verb: `evaluate` in Python and as a command, figures and reports."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from command_bank import Command, leave_undrawn
from kind_bank import FREE, KINDS, UNITS, Kind, kind_named, marked

import diffeo_calib as dc
from diffeo_calib.kinematics.evaluation import place, residuals
from diffeo_calib.sensors.errors import Evaluation, Evaluations

DRAWN = ("positions", "poses", "several tips", "sessions", "ball in sockets", "images", "several kinds")
"""Kinds whose pictures differ."""
NUMBERS: dict[str, int] = {}
"""How many are found from the rows that are judged: a model knows the places of the devices of its fit."""


@pytest.fixture(params=marked(*KINDS), scope="module")
def kind(request: pytest.FixtureRequest) -> Kind:
    return kind_named(request.param)


def all_rows(kind: Kind) -> dc.Measurements:
    return kind.source.golden.rows  # pyright: ignore[reportReturnType]


def test_evaluate_in_python(kind: Kind) -> None:
    """Each kind has its own errors, in its own unit, and says what was found from its rows."""
    found = dc.evaluate(kind.model, all_rows(kind))
    several = kind.name == "mixture" or isinstance(kind.data, dc.Observations)
    assert isinstance(found, Evaluations if several else Evaluation)
    for one in found.values() if isinstance(found, Evaluations) else [found]:
        assert one.unit == {"image": "px", "inclination": "mrad"}.get(one.kind, "m")
        assert one.what == {"socket": "spread", "position": "errors", "pose": "errors"}.get(one.kind, "readings")
        assert 0 < one.median < (1e-3 if one.unit == "m" else 5.0)
        assert len(one.devices) == len(one.errors)
    if kind.name in NUMBERS:
        assert found.numbers == NUMBERS[kind.name]
        assert f"{found.numbers} numbers in all were found" in found.placed[-1]
    elif kind.name not in ("ball in sockets", "mixture"):
        assert found.numbers == 0
    if several:
        assert isinstance(found, Evaluations)
        assert found.rms == next(iter(found.values())).rms


def test_residuals_are_measured_minus_predicted(kind: Kind) -> None:
    """Their sizes are the errors, and every row has as many as its table says."""
    data = all_rows(kind)
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


def test_report_and_figure_of_new_rows(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every kind has its page; errors of each kind by stage, in its unit."""
    path = tmp_path / "page.html"
    if kind.name not in DRAWN:
        leave_undrawn(monkeypatch)
    data = kind.data if kind.name in (*FREE, "mixture", "several kinds", "sessions") else kind.new
    dc.write_report(kind.model, path, data)
    text = path.read_text()
    for heading in ("How good", "Where", "Why", "Can I trust it", "Repeatability", "Record"):
        assert f">{heading}</h2>" in text
    for caption in ("Expected error of positions by stage", "Where to measure next", "Geometry corrections"):
        assert caption in text
    if kind.name in FREE:
        assert "No position was measured" in text
    if kind.name == "images":
        assert "RMS [px]" in text


@pytest.mark.parametrize("name", marked("hidden markers", "mixture"))
def test_commands_expect_the_same_error(name: str, command: Command, tmp_path: Path) -> None:
    kind, out = kind_named(name), tmp_path / "out"
    table, options = kind.table("new")
    found = {
        verb: command(verb, *given, "--json", tmp_path / verb)
        for verb, given in {
            "evaluate": (kind.file, table, *options),
            "report": (kind.file, "-o", out),
            "plan": (kind.file, *UNITS, "-n", 3, "--draw", 50, "--sensor", "tracker", "-o", out),
        }.items()
    }
    expected = kind.result.expected
    for verb, done in found.items():
        assert done.code == 0, done.err
        numbers = json.loads((tmp_path / verb).read_text())["results"]["expected_error"]
        assert numbers["expected_error_m"] == pytest.approx(expected.workspace, rel=1e-6)
        assert numbers["with_open_places_m"] == pytest.approx(expected.whole, rel=1e-6)
