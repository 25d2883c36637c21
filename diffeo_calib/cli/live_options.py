"""The options of `diffeo-calib campaign` alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from diffeo_calib.cli.options import option


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """How to follow a campaign."""

    target: str | None = option("End when the error is below this with 95 % probability: 0.15mm.", "LENGTH")
    stdin: bool = option(
        "Append rows from standard input to CSV, one JSON object a line: see campaign/feeds.py.",
        default=False,
    )
    json_lines: bool = option(
        "Print verdicts, expected errors and next poses as JSON, one object a line.", default=False
    )
    bag: Path | None = option("Append the stops of a ROS 2 bag to CSV, at their times; see `record`.", "BAG")
    seen: str | None = option("Topic of --bag: stamped points, poses or transforms that a device measured.", "TOPIC")
    joint_states: str = option("Topic of --bag: joint states.", "TOPIC", default="/joint_states")
    speed: float = option("How many times faster --bag is played than it was recorded.", min=1e-3, default=1.0)
    once: bool = option("Judge the rows that are there, and do not wait for more.", default=False)
    candidates: Path | None = option("Table of poses that can be measured; within the joint limits by default.", "CSV")
    page: str | None = option("Show the campaign to this machine's browser at this port; 0 for any.", "[HOST:]PORT")
    next: int = option("Number of poses that are proposed after each row.", min=0, default=1)
    accepted: Path | None = option("Table of the accepted rows to write when the campaign ends, for `fit`.", "CSV")
