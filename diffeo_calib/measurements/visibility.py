"""Markers that are hidden in some rows: NaN for x, y and z, an empty cell for each of them in a file.

A row without any marker, a marker without any row, and a marker with one or two coordinates are mistakes. The same
holds for measured frames on several tips, which are hidden as a whole.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import real_tensor
from diffeo_calib.common.errors import InputError, MeasurementError, few
from diffeo_calib.measurements.pose_frames import body_names, seen_bodies
from diffeo_calib.measurements.sockets import NO_SOCKET
from diffeo_calib.measurements.table_checks import copied, deviations


def seen_markers(points: Tensor) -> Tensor:
    """Which markers were seen: (N, P, 3) -> (N, P) boolean."""
    return ~points.isnan().any(2)


def visible_markers(data: Any) -> Tensor:
    """Which markers of some measurements were seen, (N, P) boolean; the ball, the last one, where it was in sockets."""
    seen = seen_markers(data.points)
    if data.sockets is not None:
        seen[:, -1] = data.socket.to(seen.device) != NO_SOCKET
    return seen


def hidden_words(visible: Tensor) -> list[str]:
    """Such as ``12 of 300 sightings hidden`` for (N, P) markers; nothing if all were seen."""
    hidden = int((~visible).sum())
    return [f"{hidden} of {visible.numel()} sightings hidden"] * bool(hidden)


def hidden_lines(data: Any) -> list[str]:
    """A sentence about hidden markers, or frames, of some measurements; none if all were seen."""
    hidden = (~seen_bodies(data)).sum(0).tolist()
    counts = [f"{name} in {count}" for name, count in zip(body_names(data), hidden, strict=True) if count]
    return [f"hidden in some of {len(data)} rows: {few(counts)} of them"] * bool(counts)


def marker_places(points: object) -> Tensor:
    """A checked copy (N, P, 3) of positions (N, P, 3) or (N, 3), NaN where a marker is hidden.

    Raises:
        MeasurementError: wrong shape, infinite values, a marker with some of its coordinates, a row without markers.
    """
    shapes, fix = (("N", "P", 3), ("N", 3)), "pass x, y and z of every marker, in metres"
    try:
        raw = real_tensor(points, "points").detach()
    except InputError as error:
        raise MeasurementError(str(error)) from None
    if raw.ndim != 3 or raw.shape[1] < 2 or not bool(raw.isnan().any()):
        places = copied(raw, "points", *shapes, fix=fix)
        return places.reshape(len(places), -1, 3)  # (N, 3) -> (N, 1, 3)
    empty = raw.isnan()
    places = copied(raw.masked_fill(empty, 0.0), "points", *shapes, fix=fix)
    _check_whole(empty)
    _check_rows_seen(empty.all(2))
    return places.masked_fill(empty, torch.nan)


def marker_deviations(std: object, places: Tensor, name: str = "std") -> Tensor | None:
    """Standard deviations (N, P, 3) of markers, NaN where they are hidden; given ones may be missing there.

    Args:
        std: one for all, (N,), (N, P) or (N, P, 3), m; None if they are not known.
        places: (N, P, 3) m, NaN where hidden.
        name: of the argument, for messages.
    """
    empty = places.isnan()
    if std is None or not bool(empty.any()):
        return deviations(std, name, places)
    given = real_tensor(std, name).detach().to(places.device)
    if given.ndim >= 2 and given.shape == places.shape[: given.ndim]:
        given = given.masked_fill(empty if given.ndim == 3 else empty.all(2), 1.0)
    found = deviations(given, name, places)
    return None if found is None else found.masked_fill(empty, torch.nan)


def check_every_marker_seen(data: Any) -> None:
    """Raise MeasurementError for a marker, or frame, that no row shows: nothing can be found out about it."""
    never = (~seen_bodies(data)).all(0).nonzero()[:, 0].tolist()
    if never:
        more = f" (and {len(never) - 1} more)" * (len(never) > 1)
        what = f"{body_names(data)[never[0]]}{more} is hidden in all {len(data)} rows"
        fix = f"leave {'this marker' if data.lever is None else 'it'} out, or use rows that show it"
        raise MeasurementError.of(what, expected="some row that shows it", fix=fix)


def _check_whole(empty: Tensor) -> None:
    """Refuse markers with one or two coordinates: (N, P, 3) boolean."""
    half = (empty.any(2) & ~empty.all(2)).nonzero()
    if len(half):
        row, marker = half[0].tolist()
        got = ", ".join(axis for axis, missing in zip("xyz", empty[row, marker].tolist(), strict=True) if missing)
        what = f"`points`, row {row}, marker {marker}" + f" (and {len(half) - 1} more)" * (len(half) > 1)
        expected = "three finite numbers, or NaN for all three of a hidden marker"
        raise MeasurementError.of(what, expected=expected, got=f"NaN for {got} only", fix="repair these rows")


def _check_rows_seen(hidden: Tensor) -> None:
    """Refuse rows without any marker: (N, P) boolean."""
    rows = hidden.all(1).nonzero()[:, 0].tolist()
    if rows:
        what = f"`points`, row {few(rows)}: no marker was seen"
        raise MeasurementError.of(what, expected="at least one in every row", fix="leave these rows out")
