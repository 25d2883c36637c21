"""`diffeo-calib export`: files that agree with the Python functions, and the accuracy that each keeps."""

from pathlib import Path

import pytest
import torch
from command_bank import Command, Outcome
from export_bank import configurations, own_poses
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm

OLD = Path(__file__).parents[1] / "interop" / "data" / "robot_format_3.safetensors"


@pytest.fixture
def path(arm: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("model") / "model.safetensors"
    dc.save(arm.model, found)
    return found


def row(done: Outcome, label: str) -> list[float]:
    (line,) = [line for line in done.out.splitlines() if line.startswith(f"│ {label} ")]
    return [float(cell) for cell in line.split("│")[2:-1] if cell.strip()]


def test_a_corrected_urdf(arm: Case, path: Path, command: Command, tmp_path: Path) -> None:
    model, done = arm.model, command("export", path, "--urdf", tmp_path / "new.urdf")
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
    assert f"rigid kinematics from the {rigid.how}" in done.out
    place = " ".join(f"{1e3 * value:.3f}" for value in rigid.geometry.base[:3, 3].tolist())
    assert f"their robot base in the measuring frame: {place} mm" in done.out
    (tmp_path / "own.urdf").write_text(model.robot.source or "")
    assert "is the robot's own URDF; name another" in command("export", path, "--urdf", tmp_path / "own.urdf").error


@pytest.mark.slow
def test_all_files_of_one_command(arm: Case, path: Path, command: Command, tmp_path: Path) -> None:
    """The same bytes as the Python functions write, and one row for each in the printed table."""
    model, ours, theirs = arm.model, tmp_path / "ours", tmp_path / "theirs"
    for folder in (ours, theirs):
        folder.mkdir()
    done = command(
        *("export", path, "--urdf", ours / "a.urdf", "--dh", ours / "dh.csv", "--dh-convention", "craig"),
        *("--joint-offsets", ours / "o.csv", "--correction-tables", ours / "t.csv", "--length", "mm", "--angle", "deg"),
    )
    assert (done.code, done.err.strip()) == (0, "")
    interop = dc.interop
    rigid = interop.rigid_kinematics(model, transmission=True)  # for use together with the correction tables
    interop.write_urdf(rigid.geometry, theirs / "a.urdf")
    interop.write_dh(rigid.geometry, theirs / "dh.csv", "craig", length="mm", angle="deg")
    interop.write_joint_offsets(model, theirs / "o.csv", length="mm", angle="deg")
    interop.write_correction_tables(model, theirs / "t.csv", length="mm", angle="deg")
    for name in ("a.urdf", "dh.csv", "o.csv", "t.csv"):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes(), name
    offsets = interop.best_joint_offsets(model).rigid
    with_tables, alone = row(done, "--urdf, --dh and --correction-tables"), row(done, "--urdf, --dh alone")
    assert with_tables[:2] == pytest.approx([1e3 * rigid.rms, 1e3 * rigid.largest], abs=1e-4)
    assert row(done, "--joint-offsets")[:2] == pytest.approx([1e3 * offsets.rms, 1e3 * offsets.largest], abs=1e-4)
    assert with_tables[0] < min(alone[0], row(done, "--correction-tables, nominal")[0])
    for words in ("reading + offset is the joint value", "a controller adds the correction", "nothing is known beyond"):
        assert words in done.out
    assert "DH rows with Hayati's beta, next to parallel axes: elbow_joint" in done.out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--urdf a.urdf --tool 0,0,1", "--tool without --c or --torch or --onnx"),
        ("--dh d.csv --dh-convention khalil", "'khalil' is not one of"),
        ("--dh same --joint-offsets same", "same is the file of --dh"),
        ("--c u.c --joint-offsets u.h", "--c (its header) u.h is the file of --joint-offsets"),
        ("", "name at least one file to write: --urdf"),
        ("--urdf a.urdf --ur-kinematics ur.yaml", "expected shoulder_pan_joint, shoulder_lift_joint"),
    ],
)
def test_wrong_options(words: str, message: str, path: Path, command: Command, tmp_path: Path) -> None:
    command.monkeypatch.chdir(tmp_path)
    done = command("export", path, *words.split())
    assert done.code in (1, 2)
    assert message in " ".join(done.err.split())
    assert list(tmp_path.iterdir()) == []


def test_old_files_need_the_urdf(command: Command, tmp_path: Path) -> None:
    new, urdf = tmp_path / "new.urdf", tmp_path / "arm.urdf"
    SimulatedArm(seed=1).write_urdf(urdf)
    done = command("export", OLD, "--urdf", new)
    assert done.code == 1
    assert "does not hold the URDF that it was fitted with" in done.error
    assert "--robot URDF" in done.error
    assert not new.exists()
    done = command.ran("export", OLD, "--urdf", new, "--robot", urdf, silent=True)
    assert "from the projection of the model" in done.out
    assert dc.load_urdf(new, "base_link", "flange").n == 6
