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
        help="The three position columns of a marker; repeat for more markers. Required without --socket or --reading.",
    ),
]
Socket = Annotated[
    str | None,
    typer.Option(
        "--socket",
        metavar="PLACE,SOCKET",
        help="Columns that name the socket in which a ball on the tool rested, in rows without a position.",
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

WITH_POSITIONS = ("session", "std")
"""Options that rows in sockets allow for the measured positions beside them."""


def check_place(
    position: list[str] | None,
    socket: str | None,
    distance: list[str] | None,
    distance_std: float | None,
    refused: Mapping[str, object],
) -> None:
    """Raise an error unless positions or sockets are named, and only what goes with both if both are.

    Args:
        position, socket, distance, distance_std: the options. refused: others that do not go with sockets, by name.
    """
    if socket is None:
        if not position:
            raise typer.BadParameter(
                "name the position columns, or those of --socket or --reading", param_hint="--position"
            )
        if distance or distance_std is not None:
            raise InputError.of("--distance without --socket", fix="name the columns of the sockets too")
        return
    if distance and distance_std is None:
        fix = (
            "say how well the distances are known, in the unit of --length: 0.03 mm for a block measured with a caliper"
        )
        raise InputError.of("--distance without --distance-std", fix=fix)
    beside = WITH_POSITIONS if position else ()
    given = [name for name, value in refused.items() if value and name not in beside]
    if given:
        names = ", ".join("--" + name.replace("_", "-") for name in given)
        fix = "leave it out; rows with a ball in sockets have neither positions nor other columns than the joints"
        if position:
            fix = "leave it out; rows in sockets go with rows of measured positions alone"
        if given == ["residuals"]:
            fix = "leave it out; residuals are those of measured positions, and where a socket is was not measured"
            fix += ": pass a table of the measured positions alone" * bool(position)
        raise InputError.of(f"{names} beside --socket", fix=fix)
