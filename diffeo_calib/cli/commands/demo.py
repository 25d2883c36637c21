"""`diffeo-calib demo`: a simulated arm to calibrate."""

from __future__ import annotations

import shlex

from diffeo_calib.cli.app import app
from diffeo_calib.cli.console import say
from diffeo_calib.cli.options import Command
from diffeo_calib.cli.record import make_folder
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

POSITION = ("measurement_x", "measurement_y", "measurement_z")


def run(given: Command) -> None:
    """Write an arm and its measurements, and calibrate it by a command that is printed."""
    make_folder(folder := given.output)
    arm = SimulatedArm(seed=given.seed)
    urdf, csv = folder / "arm.urdf", folder / "measurements.csv"
    arm.write_urdf(urdf)
    data = Measurements(*arm.measure(given.rows, seed=given.seed), arm.nominal.joint_names)
    write_measurements(csv, data, TableFormat("mm", "deg"), position=POSITION)
    lines = [
        ["fit", csv, "--robot", urdf, "--base", arm.nominal.base, "--tip", arm.nominal.tip],
        ["--position", ",".join(POSITION), "--length", "mm", "--angle", "deg"],
        ["-o", folder / "model.safetensors", "--figure", folder / "calibration.png"],
        ["--report", folder / "report.html"],
    ]
    command = [list(map(str, line)) for line in lines]
    say(f"{given.rows} simulated measurements written to {csv}. Now running:\n")
    say("  diffeo-calib " + " \\\n      ".join(map(shlex.join, command)) + "\n")
    app([word for line in command for word in line])
