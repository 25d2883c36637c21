"""A script for a robot of Universal Robots and a laser tracker that feeds a campaign through a pipe, pose by pose.

    python scripts/examples/ur_tracker_campaign.py

This script starts the campaign, moves the robot to the pose that it proposes, measures, sends the row and prints the
verdict; a row that looks wrong is measured again. With `--page 8000` among the campaign's words, a browser shows it.
Robot and tracker are simulated; their real calls stand beside. The lines that are sent and answered are described in
diffeo_calib/campaign/feeds.py.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from diffeo_calib.robots import SimulatedArm

CAMPAIGN = """csv = "run.csv"
robot = "robot.urdf"
base = "base_link"
tip = "flange"
position = ["x,y,z"]
length = "mm"
angle = "deg"
"""
FIRST_POSES = 14
TOUCHED_AT = 20
"""At this row somebody touches the simulated tracker's target."""


class Robot:
    """The robot. Real: `rtde_control.RTDEControlInterface(IP)` and `rtde_receive.RTDEReceiveInterface(IP)`."""

    def __init__(self, arm: SimulatedArm) -> None:
        self.arm, self.q = arm, arm.sample(1)[0]

    def move(self, pose: dict[str, float]) -> None:
        """Go there and stand still. Real: `control.moveJ(q)`, and a second of patience."""
        self.q = torch.tensor([pose[name] for name in self.arm.nominal.joint_names], dtype=torch.float64).deg2rad()

    def joints(self) -> dict[str, float]:
        """Where the robot stands, deg. Real: `receive.getActualQ()`."""
        return dict(zip(self.arm.nominal.joint_names, self.q.rad2deg().tolist(), strict=True))


class Tracker:
    """The tracker. Real: the maker's interface, such as a Leica's emScon or LMF: one stationary measurement."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.count = robot, 0
        self.random = torch.Generator().manual_seed(0)

    def measure(self) -> dict[str, float]:
        """The target, mm."""
        self.count += 1
        point = self.robot.arm.true_points(self.robot.q[None])[0, 0]
        noise = self.robot.arm.noise * torch.randn(3, generator=self.random, dtype=torch.float64)
        noise[2] += 2e-2 * (self.count == TOUCHED_AT)
        return dict(zip("xyz", (1e3 * (point + noise)).tolist(), strict=True))


class Feed:
    """The pipes to a campaign."""

    def __init__(self, campaign: subprocess.Popen[str]) -> None:
        self.campaign = campaign

    def send(self, row: dict[str, Any]) -> dict[str, Any]:
        """Send an object; the answer, after what the campaign says of its own."""
        assert self.campaign.stdin is not None
        assert self.campaign.stdout is not None
        self.campaign.stdin.write(json.dumps(row) + "\n")
        self.campaign.stdin.flush()
        answer: dict[str, Any] = {}
        while answer.get("id") != row.get("id") or not answer.keys() & {"rows", "error"}:
            answer = json.loads(self.campaign.stdout.readline())
        return answer


def measured(feed: Feed, robot: Robot, tracker: Tracker, number: int) -> dict[str, Any]:
    """Measure where the robot stands; what the campaign answers."""
    answer = feed.send({"id": number, **robot.joints(), **tracker.measure()})
    print(answer.get("text") or answer["error"])
    return answer


def main() -> None:
    """Measure until the campaign has reached its target."""
    arm = SimulatedArm(seed=3)
    arm.write_urdf("robot.urdf")
    Path("campaign.toml").write_text(CAMPAIGN)
    words = ["campaign", "campaign.toml", "--stdin", "--tolerance", "0.3mm"]
    command = [sys.executable, "-m", "diffeo_calib", *words]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as campaign:
        robot, feed = Robot(arm), Feed(campaign)
        tracker, answer = Tracker(robot), feed.send({})
        number = answer["rows"]  # a program that starts again counts on
        first = [dict(zip(arm.nominal.joint_names, q, strict=True)) for q in arm.sample(FIRST_POSES).rad2deg().tolist()]
        while not answer.get("target_reached"):
            while not (first or answer["next"]):  # the first model takes some seconds, a robot about as long to move
                time.sleep(0.2)
                answer = feed.send({})
            robot.move(first.pop() if first else answer["next"][0])
            answer = measured(feed, robot, tracker, number)
            number += 1
            if answer.get("fits") is False:
                answer = measured(feed, robot, tracker, number)
                number += 1
        print(f"{answer['accepted_rows']} of {answer['rows']} rows, {answer['expected_error_mm']:.2f} mm expected")
        campaign.communicate()


if __name__ == "__main__":
    main()
