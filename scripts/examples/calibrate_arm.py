"""Calibrate a robot from Python, step by step, on a simulated elastic arm watched by a laser tracker.

    python scripts/examples/calibrate_arm.py [FOLDER]

Everything is written to FOLDER (a temporary one by default). Replace the first two lines of `main` by your own URDF and
table, and the rest stays as it is.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm


def main(folder: Path) -> None:
    """Calibrate, look at what was found, use the model."""
    # A robot and its measurements; yours come from dc.load_urdf(...) and dc.read_measurements(...).
    arm = SimulatedArm(seed=0)
    robot = arm.nominal
    data = dc.Measurements(*arm.measure(200, seed=0), robot.joint_names)  # q (N, n) in rad, points (N, P, 3) in m

    # Hold rows out: errors on rows that were fitted say little. Repeated configurations stay together.
    train, test = data.split(0.7, seed=0)

    # Geometry, gravity sag, phi, psi and noise, all chosen from the data.
    result = dc.calibrate(robot, train)
    print(result.status)
    for name, kinematics in result.stages.items():
        print(f"{name:24} {1e3 * dc.evaluate(kinematics, test).rms:7.4f} mm RMS held out")

    # What explains how much, and which rows look wrong (none is dropped; outliers weigh less).
    for part in result.parts:
        print(f"  {part.name:36} {1e3 * part.displacement:7.4f} mm")
    for outlier in result.outliers:
        print(f"  row {outlier.number}: {1e3 * outlier.distance:.3f} mm off; {outlier.reason}")

    # Use the model: positions, exact Jacobian, uncertainty of a new measurement, joint values for a target.
    model, q = result.model, test.q
    positions = model(q)  # (N, P, 3) m, in the measuring frame
    jacobian = model.jacobian(q)  # (N, P, 3, n) m/rad
    _, covariance = model.predict(q)  # (N, P, 3, 3) m^2
    reached = model.inverse(positions, start=q + 0.01)  # (N, n) rad
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt().mean()
    print(f"Jacobian {tuple(jacobian.shape)}, predicted deviation {1e3 * deviation:.4f} mm per coordinate")
    print(f"inverse: {1e9 * (model(reached) - positions).norm(dim=-1).max():.1e} nm from the targets")

    # One file; loading executes nothing.
    path = folder / "robot.safetensors"
    dc.save(model, path)
    print(f"saved to {path}, loaded again: {dc.load(path)}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
