"""`diffeo-calib plan`: first poses, next poses and poses to measure again, as tables that `fit` reads."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import torch
from command_bank import FORMAT, Command, Site

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import read_joints

UNITS = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]


def planned(path: Path, robot: dc.Chain) -> tuple[torch.Tensor, list[int]]:
    with path.open(newline="") as file:
        ranks = [int(row["rank"]) for row in csv.DictReader(file, delimiter=";")]
    return read_joints(path, replace(FORMAT, joints=robot)), ranks


def test_first_poses_of_a_cell(site: Site, command: Command, tmp_path: Path) -> None:
    output = tmp_path / "poses.csv"
    cell = ["--tracker", "2500,300,600,0,0,1,40", "--floor", 100]
    cell += ["--range", "waist_joint=-60:90"]
    cell += ["--column", "600,0,80,400", "--marker", "50,0,100", "--draw", 200]
    done = command.ran("plan", *site.robot(), "-n", 25, "-o", output, *UNITS, *cell)
    robot = site.arm.nominal
    q, ranks = planned(output, robot)
    assert q.shape == (25, 6)
    assert sorted(ranks) == list(range(1, 26))
    tracker = dc.Tracker((2.5, 0.3, 0.6), (0.05, 0.0, 0.1), half_angle=math.radians(40))
    ranges = {"waist_joint": (-math.pi / 3, math.pi / 2)}
    drawn = dc.candidates(robot, 200, ranges=ranges, tracker=tracker, floor=0.1, column=(0.6, 0, 0.08, 0.4))
    expected = dc.plan(robot, drawn, 25, marker=(0.05, 0.0, 0.1))
    torch.testing.assert_close(q, expected.q, rtol=0, atol=1e-8)
    rms = float(expected.expected_rms[20])
    for shown in (rms, math.hypot(rms, expected.noise_rms)):  # of the model, and held out
        assert f" {1e3 * shown:.3f}" in done.out
    assert "25 of 200 configurations written to" in done.out


def test_poses_to_measure_again(site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path) -> None:
    first, again = tmp_path / "next.csv", tmp_path / "again.csv"
    file = site.folder / "model.safetensors"
    done = command.ran("plan", file, "-n", 6, "-o", first, *UNITS, "--candidates", site.csv)
    q, _ = planned(first, model.robot)
    torch.testing.assert_close(q, dc.plan(model, site.data.q, 6).q, rtol=0, atol=1e-8)
    done = command(
        *("plan", file, "-n", 6, "-o", again, *UNITS, "--candidates", site.csv),
        *("--free", "base", "--measured", first, "--target-poses", first),
    )
    assert done.code == 0, done.err
    expected = dc.plan(model, site.data.q, 6, free="base", measured=q, target=q)
    torch.testing.assert_close(planned(again, model.robot)[0], expected.q, rtol=0, atol=1e-8)
    done = command("plan", file, "-n", 4, "-o", again, *UNITS, "--candidates", site.csv, "--free", "base")
    rms = dc.plan(model, site.data.q, 4, free="base").expected_rms
    assert rms[2] > 0.01 > rms[3]
    assert "fewer than 3 poses do not show where the measuring device is now" in done.out
    assert f"{1e3 * float(rms[0]):.3f}" not in done.out  # its place, and no error of the robot
