"""The names of columns that the page of makers lists are known to `init`."""

import re
from pathlib import Path

import pytest

from diffeo_calib.cli.guesses import bodies_in, guess_joints

PAGE = Path(__file__).parents[2] / "scripts/docs/pages/howto/makers.md"
ROBOTS = PAGE.read_text(encoding="utf-8").split("\n## ")[1]
SERIES = {
    maker: names.removesuffix(",...").split(",") for maker, names in re.findall(r"\n\| ([^|]*) \| `([^`]*)`", ROBOTS)
}
PLACES = ["X [mm]", "Y [mm]", "Z [mm]"]


@pytest.mark.parametrize("maker", SERIES)
def test_joints_of_a_maker_are_found_beside_their_speeds(maker: str) -> None:
    own = [name for name in SERIES[maker] if name != "timestamp"]
    joints = [name.removesuffix(".pos") if "." in name else f"j{k}" for k, name in enumerate(own, 1)]
    joints = ["q1", "q2"] if maker.startswith("ROS") else joints
    columns = [*SERIES[maker], *(f"d{name}" for name in own), *PLACES]
    assert guess_joints(columns, joints)[0].names == own
    assert [own.place for own in bodies_in(columns)] == [PLACES]


def test_every_maker_is_tested() -> None:
    assert len(SERIES) == ROBOTS.count("\n| ") - 1 >= 11
