"""Fetching the public UR10 data: everything but the network."""

import hashlib
import json
import math
from pathlib import Path

import get_ur10_data
import pytest
import torch
from robot_data import find, read

import diffeo_calib as dc

JOINTS = ";".join(f"{name}_joint" for name in get_ur10_data.JOINTS)
ROWS = [f"{0.1 * k:.1f};0,2;0,3;0,4;0,5;{0.2 * k:.1f};10{k},5;2;3;10;20;30".replace(".", ",") for k in range(4)]
POSITION = "measurement_x;measurement_y;measurement_z;measurement_rx;measurement_ry;measurement_rz"
TABLE = "\n".join([f"{JOINTS};{POSITION}", *ROWS, ""]).encode()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A small table instead of the published one."""
    monkeypatch.setattr(get_ur10_data, "SHA256", hashlib.sha256(TABLE).hexdigest())
    source = tmp_path / "copy" / get_ur10_data.FILE
    source.parent.mkdir()
    source.write_bytes(TABLE)
    return source


def test_writes_what_the_benchmark_reads(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From a file or its folder; files that are there are never changed."""
    folder = tmp_path / "new" / "data"
    own = folder / "ipa_ur10"
    get_ur10_data.main([str(folder), "--from", str(small)])
    said = capsys.readouterr().out
    assert get_ur10_data.REPOSITORY in said
    assert "MIT licence" in said
    assert {path.name for path in own.iterdir()} == {get_ur10_data.FILE, "LICENSE.md", "dataset.json", "ur10.urdf"}
    assert (own / get_ur10_data.FILE).read_bytes() == TABLE
    assert "Christian Landgraf" in (own / "LICENSE.md").read_text()
    data = read(own, find(folder)["ipa_ur10"])
    assert data.measurements.points[1, 0].tolist() == pytest.approx([0.1015, 2e-3, 3e-3])
    assert data.measurements.q[1, [0, 5]].tolist() == pytest.approx([0.1, 0.2])
    rows = zip(get_ur10_data.LENGTHS, get_ur10_data.TWISTS, get_ur10_data.OFFSETS, strict=True)
    q = torch.linspace(-3.0, 3.0, 60, dtype=torch.float64).reshape(10, 6)
    torch.testing.assert_close(data.robot(q), dc.from_dh([*rows], "standard")(q), rtol=0, atol=1e-14)
    torch.testing.assert_close(data.robot.limits[:, 1], torch.full((6,), 2 * math.pi, dtype=torch.float64))
    before = (own / "dataset.json").stat().st_mtime_ns
    get_ur10_data.main([str(folder), "--from", str(small.parent)])  # again: nothing to do
    assert (own / "dataset.json").stat().st_mtime_ns == before
    capsys.readouterr()
    (own / "dataset.json").write_text("{}")
    with pytest.raises(SystemExit, match="exists with other contents"):  # printed on stderr with exit code 1
        get_ur10_data.main([str(folder), "--from", str(small)])
    assert (own / "dataset.json").read_text() == "{}"


def test_the_published_file(ur10_folder: Path, tmp_path: Path) -> None:
    get_ur10_data.main([str(tmp_path), "--from", str(ur10_folder.parent)])
    written = read(tmp_path / "ipa_ur10", json.loads((tmp_path / "ipa_ur10" / "dataset.json").read_text()))
    assert len(written.measurements) == 632
    published = read(ur10_folder, find(ur10_folder.parent, ["ipa_ur10"])["ipa_ur10"])
    q = written.measurements.q[:5]
    apart = written.robot(q)[:, :3, 3].norm(dim=1) - published.robot(q)[:, :3, 3].norm(dim=1)
    assert float(apart.abs().max()) < 1e-6
