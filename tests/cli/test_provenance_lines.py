"""`diffeo-calib fit --note`, and what `evaluate` and `predict` say about a model's origin."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from command_bank import TABLE, Command, Outcome, Site

import diffeo_calib as dc

NOTE = "arm 7 [left], spring check; serial 4711 é"


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_a_note_travels_with_the_model(site: Site, command: Command, tmp_path: Path) -> None:
    path = tmp_path / "noted.safetensors"
    done = command(*site.fit(site.csv, path, "--note", NOTE, "--holdout", "0"))
    assert done.code == 0
    model = dc.load(path)
    assert isinstance(model, dc.CalibratedKinematics)
    assert model.provenance is not None
    assert model.provenance.note == NOTE
    said = command("evaluate", path, site.csv, *TABLE)
    assert (
        f"to robot 'simulated_arm', 40 rows, table sha256 {model.provenance.table_sha256[:12]}...; note: {NOTE}"
        in said.out
    )


def test_commands_say_where_the_model_comes_from(
    fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path
) -> None:
    assert fitted.code == 0
    assert model.provenance is not None
    assert model.provenance.table_sha256 == hashlib.sha256(site.csv.read_bytes()).hexdigest()
    line = model.provenance.sentence(model.robot.name, 28)
    path, units = site.folder / "model.safetensors", TABLE[2:]
    for arguments in (["evaluate", path, site.csv, *TABLE], ["predict", path, site.csv, *units, "-o", tmp_path / "p"]):
        done = command(*arguments)
        assert (done.code, done.err.strip()) == (0, "")
        assert line in done.out
