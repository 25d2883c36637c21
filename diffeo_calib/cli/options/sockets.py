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


def check_place(given: Mapping[str, object]) -> None:
    """Raise an error unless positions, sockets or readings are named, or for distances without sockets.

    Args:
        given: the options by name.
    """
    if not any(given.get(name) for name in ("position", "socket", "reading")):
        raise typer.BadParameter(
            "name the position columns, or those of --socket or --reading", param_hint="--position"
        )
    if given.get("socket") is None:
        if given.get("distance") or given.get("distance_std") is not None:
            raise InputError.of("--distance without --socket", fix="name the columns of the sockets too")
    elif given.get("distance") and given.get("distance_std") is None:
        what, fix = (
            "say how well the distances are known, in the unit of --length:",
            "0.03 mm for a block measured with a caliper",
        )
        raise InputError.of("--distance without --distance-std", fix=f"{what} {fix}")
