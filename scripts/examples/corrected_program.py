"""From a calibrated model to corrected commands: a tool that was never measured, checked on the true robot.

    python scripts/examples/corrected_program.py

The arm is simulated, so that its true kinematics are known. On the command line the same is

    diffeo-calib correct model.safetensors program.csv --length m --angle rad --tool measured:0.1,-0.1,0.2 \\
        --position x,y,z --frame measuring -o corrected.csv
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.robots import SimulatedArm

LEVER = 0.1
TOOL = torch.eye(4, dtype=torch.float64)  # in the measured frame, m
TOOL[:3, 3] = torch.tensor([0.1, -0.1, 0.2], dtype=torch.float64)


def measured_arm() -> tuple[SimulatedArm, Tensor]:
    """An arm whose tracker sees a frame on its tool, and where that frame really is on the tip: (4, 4)."""
    arm = SimulatedArm(seed=1, markers=3)
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, 3] = arm.truth.tool[0]
    arm.truth = replace(arm.truth, tool=mark_points(frame[None], LEVER)[0])
    return arm, frame


def main() -> None:
    """Calibrate with 100 poses, then correct 200 commands."""
    arm, frame = measured_arm()
    robot = arm.nominal
    q, points = arm.measure(160, seed=2)
    data = dc.Measurements.from_poses(q, poses_from_marks(points, LEVER), robot.joint_names, lever=LEVER)
    train, test = data.split(100 / 160, seed=0)
    model = dc.calibrate(robot, train).model
    print(f"held-out error: {1e3 * dc.evaluate(model, test).rms:.3f} mm RMS")

    # The program: joint values from nominal inverse kinematics, for points of a workpiece that the tracker measured.
    program = arm.sample(200, seed=3)
    targets = (arm.truth.base @ robot(program) @ frame @ TOOL)[:, :3, 3]
    found = dc.compensate(model, targets, program, tool=model.measured_frame @ TOOL, frame="measuring")
    print("status of the rows:", ", ".join(f"{count} {name}" for name, count in found.counts.items()))
    print(f"largest correction: {float(found.correction.abs().max().rad2deg()):.3f} degrees")

    arm.truth = replace(arm.truth, tool=(frame @ TOOL)[None, :3, 3])
    for name, commands in (("as programmed", program), ("corrected", found.q)):
        miss = (arm.true_points(commands)[:, 0] - targets)[found.reached].norm(dim=1)
        print(f"true error of the tool, {name:13}: {1e3 * float(miss.square().mean().sqrt()):.3f} mm RMS")


if __name__ == "__main__":
    main()
