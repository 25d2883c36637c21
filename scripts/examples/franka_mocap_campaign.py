"""A script for a Franka arm and a motion capture system that feeds a campaign through a pipe, pose by pose.

    python scripts/examples/franka_mocap_campaign.py

The campaign is started by the script, which writes rows to its standard input and reads the answers from its standard
output, one JSON object a line (described in diffeo_calib/campaign/feeds.py). A body of markers on the hand gives poses:
the mean of many frames while the arm stands. Arm and cameras are simulated; their real calls stand beside.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import diffeo_calib as dc

# x, y, z [m] and rotation about x [rad] of the joints, as in the maker's published kinematics
ORIGINS = np.array(
    [
        *([0, 0, 0.333, 0], [0, 0, 0, -np.pi / 2], [0, -0.316, 0, np.pi / 2], [0.0825, 0, 0, np.pi / 2]),
        *([-0.0825, 0.384, 0, -np.pi / 2], [0, 0, 0, np.pi / 2], [0.088, 0, 0, np.pi / 2]),
    ]
)
LOWER = [-2.8, -1.7, -2.8, -3.0, -2.8, 0.0, -2.8]
UPPER = [2.8, 1.7, 2.8, -0.1, 2.8, 3.7, 2.8]
JOINTS = [f"fr3_joint{k}" for k in range(1, 8)]
CAMPAIGN = """csv = "run.csv"
robot = "fr3.urdf"
base = "link0"
tip = "link7"
position = ["x,y,z"]
rotation = "qx,qy,qz,qw"
convention = "quat_xyzw"
length = "mm"
angle = "rad"
"""
ROWS, FIRST_POSES = 30, 14


def urdf(origins: np.ndarray) -> str:
    """An arm of seven joints about z."""
    links = "".join(f'<link name="link{k}"/>' for k in range(8))
    joints = "".join(
        f'<joint name="{JOINTS[k]}" type="revolute"><parent link="link{k}"/><child link="link{k + 1}"/>'
        f'<origin xyz="{x} {y} {z}" rpy="{turn} 0 0"/><axis xyz="0 0 1"/>'
        f'<limit lower="{LOWER[k]}" upper="{UPPER[k]}" velocity="2" effort="80"/></joint>'
        for k, (x, y, z, turn) in enumerate(origins)
    )
    return f'<robot name="fr3">{links}{joints}</robot>'


class Robot:
    """The arm. Real: a `franky.Robot(IP)`, or a node of franka_ros2."""

    def __init__(self, random: np.random.Generator) -> None:
        Path("true.urdf").write_text(urdf(ORIGINS + 5e-4 * random.standard_normal(ORIGINS.shape)))
        self.chain = dc.load_urdf("true.urdf", "link0", "link7")
        self.q = np.zeros(7)

    def move(self, q: np.ndarray) -> None:
        """Go there and stand still. Real: `robot.move(franky.JointMotion(q))`."""
        self.q = q

    def joints(self) -> np.ndarray:
        """Where the arm stands, rad. Real: `robot.current_joint_state.position`."""
        return self.q


class Cameras:
    """The motion capture system. Real: its stream of rigid bodies, such as a NatNet client or the Vicon DataStream."""

    def __init__(self, robot: Robot, random: np.random.Generator) -> None:
        self.robot, self.random = robot, random
        self.turn, self.shift = Rotation.from_rotvec([0.3, -0.8, 2.0]), np.array([1500.0, -400.0, 900.0])

    def frame(self) -> tuple[np.ndarray, Rotation]:
        """Place [mm] and orientation of the body in one frame."""
        pose = self.robot.chain.tip_poses(torch.from_numpy(self.robot.q[None])).numpy().reshape(4, 4)
        noise = Rotation.from_rotvec(3e-4 * self.random.standard_normal(3))
        place = self.turn.apply(1e3 * (pose[:3, :3] @ [0.03, 0.02, 0.12] + pose[:3, 3])) + self.shift
        turned = noise * self.turn * Rotation.from_matrix(pose[:3, :3])
        return place + 0.1 * self.random.standard_normal(3), turned

    def measure(self, frames: int = 50) -> dict[str, float]:
        """The mean over some frames."""
        places, turns = zip(*(self.frame() for _ in range(frames)), strict=True)
        place, turn = np.mean(places, 0), Rotation.concatenate(turns).mean().as_quat()
        return dict(zip(["x", "y", "z", "qx", "qy", "qz", "qw"], [*place.tolist(), *turn.tolist()], strict=True))


def asked(campaign: subprocess.Popen[str], row: dict[str, Any]) -> dict[str, Any]:
    """Send an object and read the answer."""
    assert campaign.stdin is not None
    assert campaign.stdout is not None
    campaign.stdin.write(json.dumps(row) + "\n")
    campaign.stdin.flush()
    return json.loads(campaign.stdout.readline())


def main() -> None:
    """Measure some poses at random, then those that the campaign asks for."""
    random = np.random.default_rng(0)
    Path("fr3.urdf").write_text(urdf(ORIGINS))
    Path("campaign.toml").write_text(CAMPAIGN)
    words = ["campaign", "campaign.toml", "--stdin", "--accepted", "accepted.csv"]
    command = [sys.executable, "-m", "diffeo_calib", *words]
    robot = Robot(random)
    cameras = Cameras(robot, random)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as campaign:
        answer = asked(campaign, {})
        for number in range(ROWS):
            while number >= FIRST_POSES and not answer["next"]:  # the first model takes some seconds
                time.sleep(0.2)
                answer = asked(campaign, {})
            pose = random.uniform(LOWER, UPPER) if number < FIRST_POSES else [*answer["next"][0].values()]
            robot.move(np.asarray(pose))
            answer = asked(campaign, dict(zip(JOINTS, robot.joints().tolist(), strict=True)) | cameras.measure())
            print(answer.get("text") or answer["error"])
        end = json.loads(campaign.communicate()[0])
    print(f"{end['accepted_rows']} of {end['rows']} rows, {end['expected_error_mm']:.2f} mm expected")


if __name__ == "__main__":
    main()
