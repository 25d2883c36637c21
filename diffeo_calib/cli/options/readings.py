"""The option about devices that measure no position. Imports nothing slow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from diffeo_calib.common.errors import InputError

Reading = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        metavar="KIND=COLUMN",
        help="What a device reported of a ball on the tool, if no position was measured: distance=COLUMN (ball bar), "
        "displacement=COLUMN (distance with an unknown zero: wire, interferometer), height=COLUMN (dial gauge, touched "
        "plane; a number in place of the column holds for all rows), or image=U,V,FX,FY,CX,CY (pixels, focal lengths "
        "and principal point of a camera). --session names the fixed point, plane or camera of each row.",
    ),
]
REFUSED = (
    *("position", "socket", "distance", "distance_std", "rotation", "convention", "rotation_angle", "lever"),
    *("camera_on_tool", "std", "rotation_std", "payload", "controls", "figure", "report", "register", "residuals"),
)
"""Options that say something about measured positions."""


def check_readings(given: Mapping[str, Any]) -> bool:
    """Whether the options, by name, describe readings; InputError for options that do not go with them."""
    if not given["reading"]:
        return False
    if len(given["reading"]) > 1:
        fix = "fit one kind of reading; several devices of a kind are named by --session"
        raise InputError.of("--reading", expected="one of them", got=len(given["reading"]), fix=fix)
    others = ["--" + name.replace("_", "-") for name in REFUSED if given.get(name)]
    if others:
        fix = "leave it out: a table of readings holds no positions"
        raise InputError.of(f"{', '.join(others)} beside --reading", fix=fix)
    return True


def check_session(session: str | None, *, register: bool) -> None:
    """Raise InputError for set-ups beside --register, which finds one place of the device."""
    if session is not None and register:
        fix = "leave --register out: errors of every set-up are those in the place where it fits best; or register one"
        raise InputError.of("--session beside --register", fix=fix)
