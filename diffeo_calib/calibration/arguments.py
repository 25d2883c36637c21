"""Arguments of a calibration that are refused."""

from __future__ import annotations

from typing import Literal

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.common.checks import check_count
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.payload import check_same_load
from diffeo_calib.robots.tree import Tree

Controls = int | Literal["auto", "all"]
Table = Measurements | Readings | Observations
"""Measured rows of any kind."""


def check_arguments(robot: object, measurements: object, hyperparameters: object) -> None:
    """Raise InputError for arguments of the wrong kind."""
    tables = Measurements, Readings, Observations
    kinds = ((robot, "robot", (Tree,)), (measurements, "measurements", tables))
    for given, name, allowed in (*kinds, (hyperparameters, "hyperparameters", (Hyperparameters, type(None)))):
        if not isinstance(given, allowed):
            expected = " or ".join(f"a dc.{kind.__name__}" for kind in allowed if kind is not type(None))
            raise InputError.of(f"`{name}`", expected=expected, got=type(given).__name__)
    if isinstance(hyperparameters, Hyperparameters) and isinstance(robot, Tree):
        got = len(hyperparameters.transmission_amplitude), len(hyperparameters.compliance)
        if got != (robot.n, robot.moving):
            expected = f"scales of {robot.n} joints, {robot.moving} of them moving"
            raise InputError.of("`hyperparameters`", expected=expected, got=f"{got[0]} and {got[1]}")


def check_controls(controls: Controls, measurements: Table) -> None:
    """Raise InputError unless this is a number of configurations, 'auto' or 'all'."""
    if not isinstance(controls, str):
        check_count(controls, "`controls`", most=len(measurements))
        check_same_load(measurements.payload, "`controls`", controls, fix="leave `controls` out, or pass fewer rows")
    elif controls not in ("auto", "all"):
        raise InputError.of("`controls`", expected="a number, 'auto' or 'all'", got=as_written(controls))
