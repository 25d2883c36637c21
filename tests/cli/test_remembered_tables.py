"""What a model remembers of its table, sessions and devices, and what commands make of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from command_bank import Command
from kind_bank import kind_named

import diffeo_calib as dc
from diffeo_calib.cli.options import Rows, Units
from diffeo_calib.cli.tables import rows_in_table

UNITS = Units(length="mm", angle="deg")


def test_kinds_without_columns_are_left_out(tmp_path: Any) -> None:
    rows = Rows(
        position=["x,y,z"], reading=["distance=wire", "image=u,v,9,9,1,1"], socket="place,socket", session="day"
    )
    rows = replace(rows, distance=["0,1=50"], distance_std=0.03)
    path = tmp_path / "t.csv"
    path.write_text("q1,x,y,z\n1,2,3,4\n")
    found, missing = rows_in_table(path, rows, UNITS)
    assert found == Rows(position=["x,y,z"])
    assert missing == ["--socket", "--reading distance=wire", "--reading image=u,v,9,9,1,1"]
    path.write_text("q1,u,v,day\n1,2,3,4\n")
    assert rows_in_table(path, rows, UNITS)[0] == Rows(reading=["image=u,v,9,9,1,1"], session="day")
    path.write_text("q1,a\n1,2\n")
    assert rows_in_table(path, rows, UNITS) == (rows, [])  # a table of other columns: the reader says so


def test_programs_are_read_in_the_units_of_the_fit(command: Command, tmp_path: Any) -> None:
    """A model that `fit` made knows them; of another one they are to be stated."""
    kind = kind_named("positions")
    path = tmp_path / "q.csv"
    path.write_text("\n".join(",".join(map(str, r)) for r in [kind.robot.joint_names, *kind.q(2).rad2deg().tolist()]))
    refused = command("correct", kind.file, path, "-o", tmp_path / "c.csv")
    assert refused.code == 1
    assert "--length" in refused.err
    made = kind.model.provenance
    assert made is not None
    told = replace(made, command="diffeo-calib fit t.csv --position x,y,z --length mm --angle deg")
    dc.save(kind.model.with_provenance(told), tmp_path / "m.safetensors")
    done = command("correct", tmp_path / "m.safetensors", path, "-o", tmp_path / "c.csv")
    assert done.code == 0, done.err
