"""The options about devices that measure no position. Imports nothing slow."""

from __future__ import annotations

from typing import Annotated

import typer

from diffeo_calib.common.errors import InputError

Reading = Annotated[
    list[str] | None,
    typer.Option(
        "--reading",
        metavar="KIND=COLUMN",
        help="What a device reported of a ball on the tool; repeat for more kinds: distance=COLUMN (ball bar), "
        "displacement=COLUMN (distance with an unknown zero: wire, interferometer), height=COLUMN (dial gauge, touched "
        "plane; a number in place of the column holds for all rows), or image=U,V,FX,FY,CX,CY (pixels, focal lengths "
        "and principal point of a camera); or corners=CAMERA.yaml (or =WIDTH,HEIGHT of unknown cameras) for the corners "
        "of a printed board, see `images`. --session names the fixed point, plane or camera of each row.",
    ),
]


def check_session(session: str | None, *, register: bool) -> None:
    """Raise InputError for set-ups beside --register, which finds one place of the device."""
    if session is not None and register:
        fix = "leave --register out: errors of every set-up are those in the place where it fits best; or register one"
        raise InputError.of("--session beside --register", fix=fix)
