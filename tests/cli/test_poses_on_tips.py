"""Poses of both hands of a small robot, some of them hidden: from the table through all commands and the model."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest
from command_bank import FORMAT, Command
from server_bank import Server
from table_bank import held, says
from torch.testing import assert_close
from two_arms_bank import HANDS, TwoArms, robot

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import points_of_frames

pytestmark = pytest.mark.slow

ROWS, HIDDEN = 32, 5
UNITS = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]
TABLE = [*(word for side in HANDS for word in ("--position", f"{side}_x,{side}_y,{side}_z"))]
TABLE += [*(word for side in HANDS for word in ("--rotation", f"{side}_rx,{side}_ry,{side}_rz"))]
TABLE += [*UNITS, "--convention", "rotvec", "--rotation-angle", "deg"]


@dataclass(frozen=True)
class Case:
    """A fit from the command line, in its folder, and rows that it has not seen."""

    folder: Path
    arms: TwoArms
    new: dc.Measurements
    printed: str

    @property
    def path(self) -> Path:
        return self.folder / "arms.safetensors"

    @property
    def model(self) -> dc.CalibratedKinematics:
        loaded = dc.load(self.path)
        assert isinstance(loaded, dc.CalibratedKinematics)
        return loaded


@pytest.fixture(scope="module")
def case(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("two_arms")
    arms = TwoArms(robot(folder))
    data, new = arms.measured(ROWS, HIDDEN), arms.measured(60)
    write_measurements(folder / "poses.csv", data, FORMAT)
    write_measurements(folder / "new.csv", new, FORMAT)
    chain = ["--robot", folder / "two_arms.urdf", "--base", "base"]
    chain += [word for side in HANDS for word in ("--tip", side)]
    files = ["-o", folder / "arms.safetensors", "--report", folder / "report.html"]
    done = server(["fit", folder / "poses.csv", *chain, *TABLE, "--holdout", 0, *files])
    assert (done.code, done.err.strip()) == (0, "")
    return Case(folder, arms, new, done.out)


def test_fit_says_where_frames_are_and_what_was_hidden(case: Case) -> None:
    printed = " ".join(case.printed.split())
    hidden = f"hidden in some of {ROWS} rows: the frame on 'left' in 3, the frame on 'right' in 2 of them"
    assert hidden in printed
    places = case.model.measured_frame[:, :3, 3]
    for side, place in zip(HANDS, 1e3 * places, strict=True):
        words = " ".join(f"{value:.3f}" for value in place.tolist())
        assert f"measured frame in the frame of '{side}': {words} mm" in printed
    assert_close(places, case.arms.frames[:, :3, 3], rtol=0, atol=2e-3)


def test_predictions_are_read_back_without_errors(case: Case, command: Command, tmp_path: Path) -> None:
    done = command("predict", case.path, case.folder / "new.csv", *UNITS, "-o", tmp_path / "p.csv")
    assert (done.code, done.err.strip()) == (0, "")
    options = shlex.split(" ".join(done.out.split()).split("read these poses with ")[1])
    again = command("evaluate", case.path, tmp_path / "p.csv", *UNITS, *options)
    assert again.code == 0
    row = next(line for line in again.out.splitlines() if "60 in all" in line)
    assert all(float(cell) == 0 for cell in row.split("│")[2:-2])  # the last one is the expected RMS


def test_wrong_pose_of_one_hand_is_named(case: Case, command: Command, tmp_path: Path) -> None:
    poses = held(case.new.poses).clone()
    poses[7, 1, :3, 3] += 0.01
    wrong = dc.Measurements.from_poses(case.new.q, poses, case.new.joint_names, on=HANDS)
    write_measurements(tmp_path / "wrong.csv", wrong, FORMAT)
    done = command("evaluate", case.path, tmp_path / "wrong.csv", *TABLE)
    assert "row 9, right: 17.2" in done.out
    assert "the frame on 'right' alone is off, the other poses of this row fit" in " ".join(done.out.split())


# --- bad input ----------------------------------------------------------------------------------------------------


def test_other_tips_and_other_kinds_are_refused(case: Case) -> None:
    with pytest.raises(MeasurementError, match=says("poses are on other tips", "['left', 'right']")):
        dc.evaluate(case.model, case.new.with_tips(HANDS[::-1]))
    with pytest.raises(InputError, match=says("do not have the same markers", "(60, 3, 3)")):
        dc.evaluate(case.model, dc.Measurements.from_poses(case.new.q, held(case.new.poses)[:, 0]))
    points = points_of_frames(held(case.new.frames), 0.1)
    with pytest.raises(InputError, match="the model was calibrated with poses"):
        dc.evaluate(case.model, dc.Measurements(case.new.q, points))
    with pytest.raises(MeasurementError, match=says("has 2 tips", "from_poses(..., on=[...])")):
        dc.calibrate(case.arms.nominal, case.new.with_tips(None))
