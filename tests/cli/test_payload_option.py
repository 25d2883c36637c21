"""Masses on the command line: missing ones, impossible ones, and a number for all rows; the matrix has the rest."""

from pathlib import Path

import numpy as np
import pytest
import torch
from command_bank import Command
from kind_bank import UNITS, kind_named
from torch.testing import assert_close

pytestmark = pytest.mark.slow


def test_models_with_payloads_ask_for_them(tmp_path: Path, command: Command) -> None:
    kind = kind_named("payloads")
    table, options = kind.table("new")
    at = options.index("--payload")
    without, out = [*options[:at], *options[at + 2 :]], ["-o", tmp_path / "out"]
    for words in (
        ["evaluate", kind.file, table, *without],
        ["report", kind.file, table, *without, *out],
        ["recalibrate", kind.file, table, *without, *out],
        ["predict", kind.file, table, *UNITS, *out],
        ["correct", kind.file, table, *UNITS, *out],
    ):
        refused = command(*words)
        assert refused.code == 1
        assert "payload" in refused.error


def test_a_mass_that_is_a_number_holds_for_all_rows(tmp_path: Path, command: Command) -> None:
    kind = kind_named("payloads")
    done = command("predict", kind.file, kind.table("new")[0], *UNITS, "--payload", "4", "-o", tmp_path / "p.csv")
    assert done.code == 0, done.err
    written = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True)
    places = torch.from_numpy(np.stack([written[axis] for axis in "xyz"], 1)) / 1e3
    assert_close(places, kind.model.with_payload(4.0)(kind.new.q).detach()[:, 0], rtol=0, atol=1e-9)


def test_masses_that_cannot_be(tmp_path: Path, command: Command) -> None:
    kind = kind_named("payloads")
    table, options = kind.table("new")
    text = table.read_text().splitlines()
    cells = text[2].split(",")
    cells[text[0].split(",").index("payload")] = "-5"
    (tmp_path / "t.csv").write_text("\n".join([*text[:2], ",".join(cells), *text[3:]]) + "\n")
    done = command("evaluate", kind.file, tmp_path / "t.csv", *options)
    assert "line 3, column 'payload': expected a mass of 0 or more, got '-5'" in done.error
