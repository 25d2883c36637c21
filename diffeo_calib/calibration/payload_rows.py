"""The payloads of a campaign, as the nominal map of its rows needs them."""

from __future__ import annotations

from diffeo_calib.common.errors import InputError, MeasurementError, listed, sentence, warn_user
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.payload import Payload
from diffeo_calib.robots.tree import Tree


def payload_of_rows(robot: Tree, data: Measurements) -> Payload | None:
    """The masses that the robot carried, the largest of which counts as one; None if they are not known.

    Raises:
        MeasurementError: no mass at all, or a robot with several tips and no link named.
        InputError: a link that is no tip and no load of the robot.

    Warns:
        DiffeoCalibWarning: the payload never changes.
    """
    if data.payload is None:
        return None
    largest = float(data.payload.max())
    if largest == 0:
        raise MeasurementError.of("all payloads are 0", fix="leave them out")
    if data.payload_at is None and len(robot.tips) > 1:
        fix = "name its link: with_payload(masses, at=...)"
        raise MeasurementError.of(f"the payload of a robot with the tips {listed(robot.tips)}", fix=fix)
    link = robot.tip if data.payload_at is None else data.payload_at
    if link not in robot.ends:
        fix = "load the robot with it as a further `load`"
        raise InputError.of("the link of the payload", expected=listed(list(robot.ends)), got=link, fix=fix)
    if bool((data.payload == largest).all()):
        fix = "measure with different payloads if the robot will carry others"
        what = (
            f"all rows carry the same payload ({largest:g}): its sag cannot be told from that under the robot's weight"
        )
        warn_user(sentence(what, fix=fix))
    return Payload(link, data.payload, largest)
