"""Tables and lines about a calibration: errors, what each part explains, rows that look wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table
from torch import Tensor

from diffeo_calib.calibration.findings import Outlier, Part
from diffeo_calib.cli.console import plain
from diffeo_calib.measurements.pose_frames import POINTS, middles
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.sensors.errors import Evaluation

MOST_OUTLIERS = 10
"""Most lines about single rows."""


def error_table(errors: Evaluation, of: str, *columns: str, expected: bool = False) -> Table:
    """An empty table of errors in their own unit, and of orientation errors if there are any, with leading columns.

    Args:
        errors: of the kind to show. of: whose they are, the end of the title. expected: whether to add a column.
    """
    title = f"{errors.title} in {errors.shown[0]} {of}"
    angles = errors.angles is not None
    table = Table(title=title + ", orientation errors in deg" * angles, title_justify="left")
    for column in columns:
        table.add_column(column)
    for unit in ("", " deg")[: 1 + angles]:
        for column in ("RMS", "median", "95 %", "max"):
            table.add_column(column + unit, justify="right")
    if expected:
        table.add_column("expected RMS", justify="right")
    return table


def add_errors(table: Table, errors: Evaluation, *labels: str, expected: float | None = None) -> None:
    """Add a row of errors in their own unit, of orientations in degrees if there are any, and the expected RMS."""
    per_unit = errors.shown[1]
    values = [per_unit * one for one in (errors.rms, errors.median, errors.p95, errors.max)]
    angles = (errors.angle_rms, errors.angle_median, errors.angle_p95, errors.angle_max)
    values += [angle for angle in angles if angle is not None]
    values += [] if expected is None else [per_unit * expected]
    table.add_row(*labels, *(f"{value:.4f}" for value in values))


def parts_table(parts: Sequence[Part]) -> Table:
    """How much each part of a model explains."""
    table = Table(title="What explains how much (RMS over the training rows; parts may cancel)", title_justify="left")
    table.add_column("part")
    table.add_column("displacement, mm", justify="right")
    table.add_column("angle, mrad (prismatic: mm)", justify="right")
    for part in parts:
        angle = "" if part.angle is None else f"{1e3 * part.angle:.4f}"
        table.add_row(plain(part.name), f"{1e3 * part.displacement:.4f}", angle)
    return table


def outlier_lines(outliers: Sequence[Outlier], rows: int, what: str = "training rows") -> Iterator[str]:
    """Sentences about rows that look wrong, the worst first; ``what`` the ``rows`` are."""
    if not outliers:
        return
    flagged = len({outlier.row for outlier in outliers})
    kept = "" if outliers[0].weight is None else "; none was dropped"
    yield f"{flagged} of {rows} {what} look wrong (numbers are lines of the file){kept}:"
    for outlier in outliers[:MOST_OUTLIERS]:
        marker = "" if outlier.marker is None else f", marker {outlier.marker}"
        marker = marker if outlier.tip is None else f", {plain(outlier.tip)}"
        weight = "" if outlier.weight is None else f", weight {outlier.weight:.2g}"
        yield f"  row {outlier.number}{marker}: {1e3 * outlier.distance:.3f} mm off{weight}; {outlier.reason}"
    if len(outliers) > MOST_OUTLIERS:
        yield f"  and {len(outliers) - MOST_OUTLIERS} more"


def placement_lines(geometry: Geometry, *, poses: bool, ball: bool = False) -> Iterator[str]:
    """Where the robot's base was found in the measuring frame, and the markers in their tips' frames.

    Args:
        geometry: as refined with the deformations.
        poses: whether the markers are the points of measured frames, three of each.
        ball: whether the last one of several is a ball that rested in sockets.
    """
    base = geometry.base
    place, turn = 1e3 * base[:3, 3], rotation_numbers(base[None, :3, :3], "rotvec", angle="deg")[0]
    yield f"robot base in the measuring frame: {_triple(place)} mm, rotation vector {_triple(turn)} deg"
    markers, tips = (middles(geometry.tool[None])[0], geometry.on[::POINTS]) if poses else (geometry.tool, geometry.on)
    for k, (marker, tip) in enumerate(zip(markers, tips, strict=True)):
        what = "measured frame" if poses else "marker" + f" {k}" * (len(markers) > 1 + ball)
        what = "ball" if ball and k == len(markers) - 1 > 0 else what
        yield f"{what} in the frame of '{tip}': {_triple(1e3 * marker)} mm"


def _triple(values: Tensor) -> str:
    return " ".join(f"{value:.3f}" for value in values.tolist())
