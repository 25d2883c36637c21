"""`diffeo-calib demo`: a simulated arm to calibrate, or the elastic arm of the paper's section 5."""

from __future__ import annotations

import math
import shlex
from pathlib import Path

from diffeo_calib.cli.console import err, exit_on_interrupt, interrupts, progress_bar, say
from diffeo_calib.cli.record import record
from diffeo_calib.fitting.fit import fit
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.paper.figures import TEST_ROWS, mean_error, paper_figures, section_5
from diffeo_calib.robots import elastic_rr
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


def run_paper(folder: Path) -> None:
    """Fit the elastic arm of the paper and draw its figures."""
    with exit_on_interrupt(), progress_bar() as progress:
        result = fit(section_5(), progress=interrupts.watching(progress, err.print))
    say(f"256 measurements of the elastic RR arm, sigma 0.01: energy (16) {result.energy:.6e}, {result.status}")
    say(
        f"coupling residual {result.coupling_residual:.1e}, end residual {result.end_residual:.1e}, "
        f"{result.seconds:.2f} s (the paper: 470 s on 12 cores)"
    )
    nominal, calibrated = mean_error(elastic_rr.nominal), mean_error(result.model)
    record.add(energy=result.energy, nominal_m=nominal, calibrated_m=calibrated, status=result.status)
    say(
        f"mean error in {TEST_ROWS} other configurations: nominal {nominal:.2e}, calibrated {calibrated:.2e}, "
        f"{math.log10(nominal / calibrated):.2f} orders of magnitude less"
    )
    for path in paper_figures(result.model, folder):
        say(f"figure: {path}")
