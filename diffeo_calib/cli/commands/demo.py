"""`diffeo-calib demo`: a simulated arm to calibrate."""

from __future__ import annotations

import shlex
from pathlib import Path

from diffeo_calib.cli.console import say
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

POSITION = ("measurement_x", "measurement_y", "measurement_z")


def simulate(folder: Path, rows: int, seed: int) -> list[str]:
    """Write the arm and its measurements, print the command that calibrates it, and return the command's arguments."""
    arm = SimulatedArm(seed=seed)
    urdf, csv = folder / "arm.urdf", folder / "measurements.csv"
    arm.write_urdf(urdf)
    data = Measurements(*arm.measure(rows, seed=seed), arm.nominal.joint_names)
    write_measurements(csv, data, TableFormat("mm", "deg"), position=POSITION)
    lines = [
        ["fit", csv, "--robot", urdf, "--base", arm.nominal.base, "--tip", arm.nominal.tip],
        ["--position", ",".join(POSITION), "--length", "mm", "--angle", "deg"],
        ["-o", folder / "model.safetensors", "--figure", folder / "calibration.png"],
        ["--report", folder / "report.html"],
    ]
    command = [[str(argument) for argument in line] for line in lines]
    say(f"{rows} simulated measurements written to {csv}. Now running:\n")
    say("  diffeo-calib " + " \\\n      ".join(shlex.join(line) for line in command) + "\n")
    return [argument for line in command for argument in line]
