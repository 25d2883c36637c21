"""`diffeo-calib export`: files that agree with the Python functions, and the accuracy that each keeps."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from command_bank import Command, Outcome, Site
from export_bank import configurations, own_poses

import diffeo_calib as dc

OLD = Path(__file__).parents[1] / "interop" / "data" / "robot_format_3.safetensors"


@pytest.fixture(scope="session")
def path(fitted: Outcome, site: Site) -> Path:
    """A model that `fit` wrote."""
    assert fitted.code == 0
    return site.folder / "model.safetensors"


def row(done: Outcome, label: str) -> list[float]:
    """The numbers of one row of the printed table, mm."""
    (line,) = [line for line in done.out.splitlines() if line.startswith(f"│ {label} ")]
    return [float(cell) for cell in line.split("│")[2:-1] if cell.strip()]


def test_a_corrected_urdf(path: Path, model: dc.CalibratedKinematics, command: Command, tmp_path: Path) -> None:
    done = command("export", path, "--urdf", tmp_path / "new.urdf")
    assert (done.code, done.err.strip()) == (0, "")
    rigid = dc.interop.rigid_kinematics(model)
    chain = dc.load_urdf(tmp_path / "new.urdf", "base_link", "flange")
    q = configurations(chain)
    torch.testing.assert_close(chain(q), own_poses(rigid.geometry, q), rtol=0, atol=1e-12)
    left_out = rigid.validated[rigid.how]
    assert model.summary is not None
    expected = [rigid.rms, rigid.largest, left_out, (left_out**2 + model.summary.leave_one_out_rms**2) ** 0.5]
    assert row(done, "--urdf") == pytest.approx([1e3 * value for value in expected], abs=1e-4)
    assert row(done, "(the model itself)") == pytest.approx([1e3 * model.summary.leave_one_out_rms], abs=1e-4)
    assert row(done, "nominal robot, registered")[0] > row(done, "--urdf")[0]
    assert f"joint origins from the {rigid.how}" in done.out
    assert "no gravity sag" in done.out
    place = " ".join(f"{1e3 * value:.3f}" for value in rigid.geometry.base[:3, 3].tolist())
    assert f"its robot base in the measuring frame: {place} mm" in done.out


def test_what_it_promises_for_new_measurements_holds(path: Path, site: Site, command: Command, tmp_path: Path) -> None:
    """On the rows that `fit` held out."""
    done = command("export", path, "--urdf", tmp_path / "new.urdf")
    model = dc.load(path)
    assert isinstance(model, dc.CalibratedKinematics)
    _, test = site.data.split(0.7, seed=0)
    found = dc.evaluate(dc.interop.rigid_kinematics(model).geometry.points, test).rms
    assert row(done, "--urdf")[3] == pytest.approx(1e3 * found, rel=0.3)


def test_old_files_need_the_urdf(site: Site, command: Command, tmp_path: Path) -> None:
    new = tmp_path / "new.urdf"
    done = command("export", OLD, "--urdf", new)
    assert done.code == 1
    assert "does not hold the URDF that it was fitted with" in done.error
    assert "--robot URDF" in done.error
    assert not new.exists()
    done = command("export", OLD, "--urdf", new, "--robot", site.urdf)
    assert (done.code, done.err.strip()) == (0, "")
    assert "from the projection of the model" in done.out
    assert dc.load_urdf(new, "base_link", "flange").n == 6


def test_wrong_robots_and_places(path: Path, site: Site, command: Command, tmp_path: Path) -> None:
    other, new = tmp_path / "other.urdf", tmp_path / "new.urdf"
    other.write_text(site.urdf.read_text().replace("elbow_joint", "knee_joint"))
    done = command("export", path, "--urdf", new, "--robot", other)
    assert done.code == 1
    assert "got waist_joint, shoulder_joint, knee_joint" in done.error
    for target, words in (
        (other, "is the file of --robot"),
        (path, "is the file of MODEL"),
        (tmp_path, "is a folder"),
        (tmp_path / "none" / "new.urdf", "there is no folder"),
    ):
        done = command("export", path, "--urdf", target, "--robot", other)
        assert done.code == 1
        assert words in done.error
    before = other.read_bytes()
    assert other.read_bytes() == before
    assert command("export", tmp_path / "no_model", "--urdf", new).code == 1
    assert command("export", path, "--urdf", new, "--robot", tmp_path / "none.urdf").code == 1
    assert not new.exists()


def test_at_least_one_file(path: Path, command: Command) -> None:
    done = command("export", path)
    assert done.code == 2
    assert "name at least one file to write: --urdf" in done.err
