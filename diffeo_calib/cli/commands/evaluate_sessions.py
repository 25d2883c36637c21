"""`diffeo-calib evaluate --session`: errors of rows of several set-ups, each placed where it fits best."""

from __future__ import annotations

from pathlib import Path

from diffeo_calib.cli.commands.evaluate import accept_new, judge, residual_rows, show, write_residuals
from diffeo_calib.cli.console import plain, say
from diffeo_calib.cli.models import load_kinematics, provenance_lines
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import evaluate, rows_used_in_fit, warn_outside_range
from diffeo_calib.kinematics.session_places import SessionPlaces, place_sessions
from diffeo_calib.kinematics.socket_errors import with_markers_of
from diffeo_calib.measurements.table import Measurements


def run(model: Path, source: MeasuredTable, *, limit: float | None = None, residuals: Path | None = None) -> None:
    """Print errors of all rows, of the rows of the fit, of the other rows and of every session.

    Args:
        model: its file. source: the table. limit: largest RMS error of new rows, m, that is good enough.
        residuals: file for the error of every row, in the frame of the model.

    Raises:
        MeasurementError: too few rows of a session, or errors that say nothing about the robot.
    """
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    measured = source.read(kinematics.robot)
    data, places = placed(kinematics, with_markers_of(kinematics, measured))
    errors, used = evaluate(kinematics, data), rows_used_in_fit(kinematics, data.q)
    if residuals is not None:
        rows = residual_rows(kinematics, data, used, source.table.per_metre, markers=measured.markers)
        write_residuals(residuals, [rows], source)
    masks = {} if places is None else {name: places.session == k for k, name in enumerate(places.names)}
    show(errors, used, model, residuals, masks)
    say_places(places)
    warn_outside_range(kinematics, data.q)
    judge(kinematics, data, errors)
    if limit is not None:
        accept_new(errors, used, limit)


def placed(model: CalibratedKinematics, data: Measurements) -> tuple[Measurements, SessionPlaces | None]:
    """Measurements in the frame of a model, and where their sessions are; unchanged without sessions."""
    if data.session is None:
        return data, None
    places = place_sessions(model, data)
    return places.data, places


def say_places(places: SessionPlaces | None) -> None:
    """Print and record where the frames of sessions were found."""
    if places is not None:
        transforms = zip(places.names, places.transforms, strict=True)
        record.add(session_transforms=dict(transforms))
        for line in places.sentences():
            say(plain(line))
