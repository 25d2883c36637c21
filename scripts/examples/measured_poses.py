"""Calibrate with measured poses: a tracker that sees orientation too, or a camera.

    python scripts/examples/measured_poses.py

A pose is kept as three points at a small distance (the lever) from its origin, so that one model gives positions and
orientations. Here the poses are simulated; from a table they are read by

    dc.read_measurements("poses.csv", robot, ["x", "y", "z"], length="mm", angle="deg",
                         rotation=["rx", "ry", "rz"], convention="XYZ", rotation_angle="deg")

A camera on the tool that sees a fixed board measures poses of the board: read them with `camera_on_tool=True`, and
`diffeo_calib.kinematics.tool.HandEye.of(result.model)` has camera and board with their deviations.
"""

from __future__ import annotations

from dataclasses import replace

import torch

import diffeo_calib as dc
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.robots import SimulatedArm

LEVER = 0.1  # m: an error of 1 mrad counts like one of 0.1 mm


def simulated_poses(rows: int) -> tuple[dc.Chain, dc.Measurements]:
    """An arm with a frame on its tool, whose poses (N, 4, 4) are measured."""
    arm = SimulatedArm(seed=1, markers=3)
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, 3] = arm.truth.tool[0]
    arm.truth = replace(arm.truth, tool=mark_points(frame[None], LEVER)[0])
    q, points = arm.measure(rows, seed=2)
    poses = poses_from_marks(points, LEVER)
    return arm.nominal, dc.Measurements.from_poses(q, poses, arm.nominal.joint_names, lever=LEVER)


def main() -> None:
    """Calibrate with 100 poses and test on 100 others."""
    robot, data = simulated_poses(200)
    train, test = data.split(0.5, seed=0)
    result = dc.calibrate(robot, train)
    for name, kinematics in result.stages.items():
        errors = dc.evaluate(kinematics, test)
        print(f"{name:24} {1e3 * errors.rms:7.4f} mm, {errors.orientation.rms:.5f} degrees RMS held out")

    poses, covariance = result.model.predict_poses(test.q)  # (N, 4, 4), (N, 6, 6): shifts in m, turns in rad
    deviations = covariance.diagonal(dim1=-2, dim2=-1).sqrt().mean(0)
    print(f"first pose:\n{poses[0].numpy().round(4)}")
    print(f"predicted deviations: {1e3 * deviations[:3].mean():.4f} mm, {deviations[3:].mean().rad2deg():.5f} degrees")


if __name__ == "__main__":
    main()
