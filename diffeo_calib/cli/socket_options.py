"""The options about a ball in sockets, in place of measured positions. Imports nothing slow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import typer

from diffeo_calib.common.errors import InputError

Position = Annotated[
    list[str] | None,
    typer.Option(
        "--position",
        metavar="X,Y,Z",
        help="The three position columns of a marker; repeat for more markers. Required without --socket.",
    ),
]
Socket = Annotated[
    str | None,
    typer.Option(
        "--socket",
        metavar="PLACE,SOCKET",
        help="Columns that name the socket in which a ball on the tool rested, if no position was measured.",
    ),
]
Distance = Annotated[
    list[str] | None,
    typer.Option(
        "--distance",
        metavar="A,B=LENGTH",
        help="Known distance between two sockets, in the unit of --length; repeat for more.",
    ),
]
DistanceStd = Annotated[
    float | None, typer.Option("--distance-std", help="Standard deviation of these distances, in the unit of --length.")
]


def check_place(
    position: list[str] | None,
    socket: str | None,
    distance: list[str] | None,
    distance_std: float | None,
    refused: Mapping[str, object],
) -> None:
    """Raise an error unless either positions or sockets are named.

    Args:
        position, socket, distance, distance_std: the options. refused: others that do not go with sockets, by name.
    """
    if socket is None:
        if not position:
            raise typer.BadParameter("name the position columns, or those of --socket", param_hint="--position")
        if distance or distance_std is not None:
            raise InputError.of("--distance without --socket", fix="name the columns of the sockets too")
        return
    given = [name for name, value in {"position": position, **refused}.items() if value]
    if given:
        names = ", ".join("--" + name.replace("_", "-") for name in given)
        fix = "leave it out: with a ball in sockets no position is measured"
        raise InputError.of(f"{names} beside --socket", fix=fix)
