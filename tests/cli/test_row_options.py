"""Readings, payloads and rows of several kinds on the command line."""

import json
from pathlib import Path

import pytest
import torch
from command_bank import Command
from kind_bank import UNITS, kind_named, table_options
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.tables import measured_table
from diffeo_calib.measurements.csv.sensors import ReadingColumns


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("distance=bar", ReadingColumns("distance", ("bar",))),
        ("distance=7", ReadingColumns("distance", ("7",))),  # a column of this name
        ("distance=7.0", ReadingColumns("distance", 7.0)),
        ("displacement=wire", ReadingColumns("distance", ("wire",), offset_std=1.0)),
        ("height=0", ReadingColumns("height", 0.0)),
        ("image=u, v,900,910,320.5,-2", ReadingColumns("image", ("u", "v"), None, 0.0, (900.0, 910.0, 320.5, -2.0))),
    ],
)
def test_options_become_columns(text: str, columns: ReadingColumns, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a;b;7\n10;20;100\n20;30;400\n")
    rows = Rows(reading=[text], length="mm", angle="deg", sep=";", decimal=",")
    assert measured_table(tmp_path / "t.csv", rows).table.readings == (columns,)


def test_set_ups_are_evaluated_each_in_its_place(command: Command, tmp_path: Path) -> None:
    """The device moves by 100 mm before the rows of b: errors stay what they are, and so does the spread in sockets."""
    kind, path = kind_named("mixture"), tmp_path / "t.csv"
    tracked, resting = kind.data.parts
    later, away = torch.arange(len(tracked)) % 2, torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    moved = tracked.shifted(later[:, None, None] * away).with_sessions(["ab"[day] for day in later.tolist()])
    written = []
    for rows in (kind.data, dc.Measurements.joined([moved, resting])):
        options = table_options(kind.written(rows, path))
        done = command.ran("evaluate", kind.file, path, *UNITS, *options, "--json", tmp_path / "e.json")
        written.append(json.loads((tmp_path / "e.json").read_text())["results"])
    assert "the frames of 2 sessions were found from these rows, 12 numbers in all" in " ".join(done.out.split())
    still, placed = written
    assert placed["kinds"]["socket"] == still["kinds"]["socket"]
    assert placed["errors"]["all"]["rows"] == len(tracked)
    assert sum(own["rows"] for own in placed["errors"]["in_sessions"].values()) == len(tracked)
    assert placed["errors"]["all"]["rms_m"] <= still["errors"]["all"]["rms_m"]
    a, b = (torch.tensor(placed["session_transforms"][name], dtype=torch.float64)[:3, 3] for name in "ab")
    assert_close(b - a, away, rtol=0, atol=2e-3)


@pytest.mark.slow
def test_models_with_payloads_ask_for_them(tmp_path: Path, command: Command) -> None:
    kind = kind_named("payloads")
    assert f"; payload {kind.model.payload:g}" in repr(kind.model)
    table, options = kind.table("new")
    at = options.index("--payload")
    without, out = [*options[:at], *options[at + 2 :]], ["-o", tmp_path / "out"]
    for words in (
        ["evaluate", kind.file, table, *without],
        ["evaluate", kind.file, table, *without, "--report", tmp_path / "out"],
        ["recalibrate", kind.file, table, *without, *out],
        ["predict", kind.file, table, *UNITS, *out],
        ["correct", kind.file, table, *UNITS, *out],
    ):
        assert "payload" in command.failed(*words)
